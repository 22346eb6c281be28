"""Thin films: against transfer matrices in complex numbers, on every facet, under coats; and indices by wavelength."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count
from layerjax import fresnel

RANDOM = np.random.default_rng(0)
NUMBER = 4000
COSINE = RANDOM.uniform(1e-3, 1.0, NUMBER)
IOR, FILM = RANDOM.uniform(0.3, 3.0, NUMBER), RANDOM.uniform(0.5, 2.5, NUMBER)
K = np.where(RANDOM.uniform(size=NUMBER) < 0.5, 0.0, RANDOM.uniform(0.0, 8.0, NUMBER))
PHASE = RANDOM.uniform(0.0, 30.0, NUMBER)
REFLECTANCE = jax.jit(fresnel.thin_film)
GRADIENT = jax.jit(jax.vmap(jax.grad(fresnel.thin_film, argnums=(0, 1, 2, 3, 4))))
RGB = (610.0, 550.0, 465.0)
METAL = {"ior": [0.2, 0.9, 1.1], "k": [3.9, 2.5, 2.4], "alpha": 0.3}


def transfer_matrix(cosine, ior, k, film_ior, phase, above=1.0):
    """Reflectance and transmittance by the matrices of both polarisations, as in Born & Wolf 1.6, at one wavelength."""
    sine2 = (above**2) * (1.0 - cosine**2)
    indices = [above + 0j, film_ior + 0j, ior + 1j * k]
    normal = [np.sqrt(n * n - sine2 + 0j) for n in indices]  # of the wave vectors, decaying downwards
    normal = [np.where(q.imag < 0, -q, q) for q in normal]
    shares = []
    for parallel in (False, True):
        admittance = [q / n**2 if parallel else q for q, n in zip(normal, indices, strict=True)]
        delta, y = phase * normal[1], admittance[1]
        field = np.cos(delta) - 1j * np.sin(delta) / y * admittance[2]
        flow = -1j * y * np.sin(delta) + np.cos(delta) * admittance[2]
        below = np.abs(admittance[0] * field + flow) ** 2
        reflected = np.abs(admittance[0] * field - flow) ** 2 / below
        shares.append((reflected, 4.0 * admittance[0].real * admittance[2].real / below))
    return np.mean(shares, axis=0)


def test_reflectance_is_that_of_transfer_matrices():
    found = REFLECTANCE(*map(jnp.asarray, (COSINE, IOR, K, FILM, PHASE)))
    expected, passed = transfer_matrix(COSINE, IOR, K, FILM, PHASE)
    np.testing.assert_allclose(found, expected, atol=1e-11)  # the matrices lose digits where the film reflects totally
    lossless = (K == 0.0) & (IOR**2 > 1.0 - COSINE**2)
    np.testing.assert_allclose((found + passed)[lossless], 1.0, atol=1e-11)
    single = REFLECTANCE(*(jnp.asarray(x, jnp.float32) for x in (COSINE, IOR, K, FILM, PHASE)))
    # a phase of 100 is known to 6e-6 in single precision, and dips of 1 are as narrow as a thousandth of a fringe
    assert np.quantile(np.abs(single - expected), 0.99) < 1e-4


def test_a_film_of_no_thickness_is_none():
    bare = fresnel.conductor(COSINE, IOR, K)
    np.testing.assert_allclose(REFLECTANCE(COSINE, IOR, K, FILM, 0.0 * PHASE), bare, atol=1e-13)
    wi, wo = lj.direction(jnp.linspace(0.1, 1.4, 50), 0.0), lj.direction(jnp.linspace(0.2, 1.3, 50), 2.0)

    def program(film):
        return count(lambda wi, wo: lj.evaluate(lj.Stack([], lj.Conductor(**METAL, film=film)), wi, wo), wi, wo)

    assert program(None) == program(lj.ThinFilm(1.8, 0.0, RGB))
    assert sum(program(None).values()) < sum(program(lj.ThinFilm(1.8, 100.0, RGB)).values())


def test_slopes_are_right_and_finite_at_all_ends():
    point = [jnp.asarray(x[:400]) for x in (COSINE, IOR, K + 0.1, FILM, PHASE)]
    found = GRADIENT(*point)
    for place in range(5):
        # a step of 1e-6 leaves 1e-12 of the third derivative, up to (2 phase)^3, and 1e-10 of rounding
        up, down = ([x + s * (place == k) for k, x in enumerate(point)] for s in (1e-6, -1e-6))
        expected = (transfer_matrix(*map(np.asarray, up))[0] - transfer_matrix(*map(np.asarray, down))[0]) / 2e-6
        np.testing.assert_allclose(found[place], expected, rtol=1e-4, atol=1e-5)
    ends = np.meshgrid([0.0, 1e-8, 0.6, 1.0], [0.3, 0.8, 1.0, 1.5], [0.0, 3.0], [0.8, 1.0, 1.5], [0.0, 1.0, 40.0])
    for dtype in (np.float64, np.float32):
        at = [jnp.asarray(x.ravel(), dtype) for x in ends]
        value = REFLECTANCE(*at)
        assert np.all((value >= 0.0) & (value <= 1.0))
        assert all(np.isfinite(slope).all() for slope in GRADIENT(*at))


def test_every_facet_has_the_film_s_reflectance():
    film = lj.ThinFilm([2.3, 2.4, 2.6], 120.0, RGB)
    wi, wo = lj.direction(0.3, 0.0), lj.direction([0.2, 0.8, 1.3], [3.0, 2.0, 0.4])
    half = np.asarray(wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    cosine, values = half @ np.asarray(wi), {}
    for name, one in {"film": film, "bare": None}.items():
        values[name] = lj.evaluate(lj.Stack([], lj.Conductor(**METAL, film=one)), wi, wo)
    for c, wavelength in enumerate(RGB):
        n, k = METAL["ior"][c], METAL["k"][c]
        with_film = transfer_matrix(cosine, n, k, film.ior[c], 2.0 * np.pi * 120.0 / wavelength)[0]
        bare = transfer_matrix(cosine, n, k, 1.0, 0.0)[0]
        np.testing.assert_allclose(values["film"][:, c] / values["bare"][:, c], with_film / bare, rtol=1e-10)


def test_under_a_coat_indices_and_wavelength_are_those_of_the_coat():
    base = lj.Conductor(0.9, 2.5, 0.3, film=lj.ThinFilm(2.4, 120.0, 550.0)).relative_to(1.5)
    cosine = np.linspace(0.05, 1.0, 20)
    expected, _ = transfer_matrix(cosine, 0.9, 2.5, 2.4, 2.0 * np.pi * 120.0 / 550.0, above=1.5)
    np.testing.assert_allclose(base.reflectance(jnp.asarray(cosine))[0], expected, rtol=1e-11)


def test_a_map_of_thicknesses_is_its_texels():
    def stack(thickness):
        return lj.Stack([], lj.Conductor(**METAL, film=lj.ThinFilm(2.4, thickness, RGB)))

    wi, wo, thicknesses = lj.direction(0.3, 0.0), lj.direction(0.4, 3.0), (0.0, 80.0, 200.0, 300.0)
    found = lj.evaluate(stack(np.array(thicknesses)), wi, wo)
    np.testing.assert_allclose(found, [lj.evaluate(stack(one), wi, wo) for one in thicknesses], rtol=1e-12)


@pytest.mark.slow
def test_solver_and_walk_agree():
    """Metal with a film, under a coat: within four standard errors of the walk, and what nodes leave."""
    film = lj.ThinFilm(2.4, 150.0, RGB)
    stack = lj.Stack([lj.Interface(1.5, 0.2)], lj.Conductor(**METAL, film=film))
    wi, wo = lj.direction(0.6, 0.0), lj.direction([0.3, 0.6, 1.2], [2.5, 3.0, 0.5])
    exact = lj.evaluate(stack, wi, wo, lj.AddingDoubling())
    mean, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=100_000), key=jax.random.key(0))
    bare = lj.evaluate(lj.Stack(stack.layers, lj.Conductor(**METAL)), wi, wo, lj.AddingDoubling())
    assert np.all(np.abs(exact - mean) < 4.0 * error + 0.005 * exact)
    assert np.max(np.abs(bare / exact - 1.0)) > 0.1  # what is compared is no small change


def test_what_cannot_be_is_named():
    filmed = lj.Stack([], lj.Conductor(**METAL, film=lj.ThinFilm(1.8, 100.0, RGB)))
    up = lj.direction(0.3, 0.0)
    for call, message in (
        (lambda: lj.evaluate(filmed, up, up, lj.Statistical()), r"base\.film: Statistical carries no ThinFilm"),
        (lambda: lj.evaluate(filmed, up, up, lj.ENDF()), r"base\.film: ENDF carries no ThinFilm"),
        (lambda: lj.Conductor(**METAL, film=1.8), r"Conductor\.film: 1\.8 is not a ThinFilm or None"),
        (lambda: lj.ThinFilm(1.8, 6000.0, RGB), r"ThinFilm\.thickness_nm: 6000 is outside \[0, 5000\]"),
        (
            lambda: lj.Stack([], lj.Conductor(0.2, 3.0, 0.3, film=lj.ThinFilm([1.8] * 2, 1.0, RGB))),
            "number of channels",
        ),
        (
            lambda: lj.metal("unobtainium", "rgb"),
            "metal: the name .unobtainium. is not one of aluminium, chromium, copper",
        ),
        (lambda: lj.metal("gold", "xyz"), "wavelengths_nm: 'xyz' is neither numbers nor \"rgb\""),
        (lambda: lj.metal("gold", 50.0), r"wavelengths_nm: 50 is outside the table of gold, 18\d\.\d to 193\d"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


# ---- indices by wavelength ----


def test_metals_are_as_published():
    """Values of the tables at their own wavelengths, and their normal reflectance in words of every handbook."""
    # Johnson & Christy 1972, Tables I: gold at 2.26 eV, silver at 2.26 eV; Rakic 1995: aluminium at 563.57 nm
    for name, wavelength, n, k in (
        ("gold", 548.6, 0.43, 2.455),
        ("silver", 548.6, 0.06, 3.586),
        ("copper", 548.6, 1.02, 2.577),
        ("aluminium", 563.57, 1.0728, 6.7839),
    ):
        np.testing.assert_allclose(np.ravel(lj.metal(name, wavelength)), [n, k], rtol=1e-6)
    for name in ("aluminium", "chromium", "copper", "gold", "iron", "nickel", "silver", "titanium", "tungsten"):
        n, k = lj.metal(name, np.linspace(250.0, 1930.0, 50))
        assert n.shape == k.shape == (50,)
        assert np.all((n > 0.01) & (n < 10.0) & (k > 0.0) & (k < 20.0))
    red, green, blue = fresnel.conductor(jnp.ones(3), *lj.metal("gold", "rgb"))
    assert red > 0.9 > green > 0.7 > blue
    assert np.min(fresnel.conductor(jnp.ones(3), *lj.metal("silver", "rgb"))) > 0.95


def test_dispersion_formulas_give_the_makers_figures():
    """N-BK7 by Schott's sheet, at the lines d, F and C; its Abbe number is 64.17."""
    b, c = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    d, f, red = lj.sellmeier([587.5618, 486.1327, 656.2725], b, c)
    np.testing.assert_allclose([d, f, red], [1.51680, 1.52238, 1.51432], atol=5e-6)
    assert (d - 1.0) / (f - red) == pytest.approx(64.17, abs=0.01)
    np.testing.assert_allclose(lj.cauchy([500.0, 1000.0], 1.5, 0.004, 1e-4), [1.5 + 0.016 + 0.0016, 1.5041])
