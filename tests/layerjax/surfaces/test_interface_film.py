"""Thin films on dielectric interfaces: against sums of Airy, from both sides, smooth and rough, solved and walked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count
from layerjax import fresnel
from layerjax.stack import simplify

RANDOM = np.random.default_rng(1)
NUMBER = 4000
COSINE = RANDOM.uniform(1e-3, 1.0, NUMBER)
IOR, FILM_IOR = RANDOM.uniform(0.3, 3.0, NUMBER), RANDOM.uniform(0.4, 2.5, NUMBER)
PHASE = RANDOM.uniform(0.0, 30.0, NUMBER)
RGB = (610.0, 550.0, 465.0)
FILM = lj.ThinFilm([2.0, 2.05, 2.1], 120.0, RGB)
COARSE = lj.AddingDoubling(nodes=8, modes=8)
WI = lj.direction(0.6, 0.0)
UP, ALL = lj.direction([0.3, 0.6, 1.2], [2.5, 3.0, 0.5]), lj.direction([0.3, 0.6, 1.2, 2.8], [2.5, 3.0, 0.5, 3.0])


def airy(cosine, ior, film_ior, phase):
    """Reflectance and transmittance: all reflections within the film, summed by amplitude for each polarisation."""
    sine2 = 1.0 - cosine**2
    indices = [1.0 + 0j, film_ior + 0j, ior + 0j]
    q1, q2, q3 = (np.sqrt(n * n - sine2) for n in indices)  # of the wave vectors, decaying downwards
    turn = np.exp(1j * phase * q2)
    shares = []
    for parallel in (False, True):
        y1, y2, y3 = (q / n**2 if parallel else q for q, n in zip((q1, q2, q3), indices, strict=True))
        r12, r23, t12, t23 = (y1 - y2) / (y1 + y2), (y2 - y3) / (y2 + y3), 2 * y1 / (y1 + y2), 2 * y2 / (y2 + y3)
        below = 1.0 + r12 * r23 * turn**2
        transmitted = np.abs(t12 * t23 * turn / below) ** 2 * y3.real / y1.real
        shares.append((np.abs((r12 + r23 * turn**2) / below) ** 2, transmitted))
    return np.mean(shares, axis=0)


@jax.jit
def reflectance(cosine, ior, film_ior, phase):
    return fresnel.dielectric(cosine, ior, film=fresnel.Film(film_ior, phase))


GRADIENT = jax.jit(jax.vmap(jax.grad(reflectance, argnums=(0, 1, 2, 3))))


# ---- one facet ----


def test_reflectance_and_transmittance_are_sums_of_airy():
    numbers = tuple(map(jnp.asarray, (COSINE, IOR, FILM_IOR, PHASE)))
    expected, passed = airy(COSINE, IOR, FILM_IOR, PHASE)
    found = reflectance(*numbers)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    refracted, exists = fresnel.cosine_of_refraction(numbers[0], numbers[1])
    assert 0.2 < np.mean(exists) < 0.9
    assert np.mean(FILM_IOR**2 < 1.0 - COSINE**2) > 0.1  # evanescent in the film
    np.testing.assert_array_equal(found[~exists], 1.0)
    film = fresnel.Film(*numbers[2:])
    through = jax.jit(fresnel.dielectric_transmittance)(numbers[0], numbers[1], refracted, film)[exists]
    np.testing.assert_allclose(through, passed[exists], rtol=1e-10, atol=1e-290)  # also where little tunnels
    np.testing.assert_allclose(found[exists] + through, 1.0, atol=1e-13)
    single = reflectance(*(jnp.asarray(x, jnp.float32) for x in numbers))
    assert np.quantile(np.abs(single - expected), 0.99) < 1e-4


def test_both_sides_see_the_same():
    cosine, ior = jnp.asarray(COSINE), jnp.asarray(IOR)
    film = fresnel.Film(jnp.asarray(FILM_IOR), jnp.asarray(PHASE))
    refracted, exists = fresnel.cosine_of_refraction(cosine, ior)
    above = fresnel.dielectric(cosine, ior, film=film)
    below = fresnel.dielectric(refracted, 1.0 / ior, film=film.seen_from(ior))
    np.testing.assert_allclose(above[exists], below[exists], atol=1e-11)


def test_a_film_of_no_thickness_is_none():
    bare = fresnel.dielectric(COSINE, IOR)
    np.testing.assert_allclose(reflectance(COSINE, IOR, FILM_IOR, 0.0 * PHASE), bare, atol=1e-13)
    assert reflectance(*map(jnp.asarray, (0.0, 1.0, 1.3, 0.0))) == 0.0  # grazing light on no interface at all

    def stack(film):
        return lj.Stack([lj.Interface(1.5, 0.3, film=film)], lj.Lambertian(0.5))

    def program(film):
        return count(lambda wi, wo: lj.evaluate(stack(film), wi, wo, COARSE), WI, UP)

    assert program(None) == program(lj.ThinFilm(1.8, 0.0, RGB[0]))
    assert sum(program(None).values()) < sum(program(lj.ThinFilm(1.8, 9.0, RGB[0])).values())


def test_slopes_are_right_and_finite_at_all_ends():
    point = [jnp.asarray(x[:400]) for x in (COSINE, IOR, FILM_IOR, PHASE)]
    away = np.abs(IOR[:400] ** 2 - 1.0 + COSINE[:400] ** 2) > 0.01  # from the critical angle
    found = GRADIENT(*point)
    for place in range(4):
        up, down = ([x + s * (place == k) for k, x in enumerate(point)] for s in (1e-6, -1e-6))
        expected = (airy(*map(np.asarray, up))[0] - airy(*map(np.asarray, down))[0]) / 2e-6
        np.testing.assert_allclose(found[place][away], expected[away], rtol=1e-4, atol=1e-5)
    ends = np.meshgrid([0.0, 1e-8, 0.6, 1.0], [0.3, 0.8, 1.0, 1.5], [0.8, 1.0, 1.5], [0.0, 1e-3, 1.0, 300.0])
    for dtype in (np.float64, np.float32):
        at = [jnp.asarray(x.ravel(), dtype) for x in ends]
        value = reflectance(*at)
        assert np.all((value >= 0.0) & (value <= 1.0))
        assert all(np.isfinite(slope).all() for slope in GRADIENT(*at))


# ---- smooth interfaces ----


def test_a_quarter_wave_coating_reflects_nothing_at_its_wavelength():
    index = np.sqrt(1.5)
    film = lj.ThinFilm(index, 550.0 / 4.0 / index, RGB)
    mirrored, passed = lj.specular(lj.Stack([lj.Interface(1.5, film=film)]), lj.direction([0.0, np.pi], 0.0))
    assert np.all(mirrored[:, 1] < 1e-15)  # from above and from below
    np.testing.assert_allclose(passed[:, 1], 1.0, atol=1e-15)
    assert np.all((mirrored[:, [0, 2]] > 1e-4) & (mirrored[:, [0, 2]] < 0.04))


def test_a_smooth_pane_loses_nothing():
    """Coated on both faces, with a haze that absorbs nothing; and in closed form without."""
    wi = lj.direction([0.1, 0.9, 1.4, 2.5], 0.0)
    faces = lj.Interface(1.52, film=FILM), lj.Interface(1.0, film=FILM)
    clear = lj.specular(lj.Stack(faces), wi)
    np.testing.assert_allclose(clear[0] + clear[1], 1.0, atol=1e-13)
    for c, wavelength in enumerate(RGB):
        level, _ = airy(np.abs(wi[:, 2]), 1.52, FILM.ior[c], 2.0 * np.pi * 120.0 / wavelength)
        np.testing.assert_allclose(clear[0][:, c], 2.0 * level / (1.0 + level), rtol=1e-11)
    hazy = lj.Stack([faces[0], lj.Medium(0.7), faces[1]])
    whole = sum((*lj.albedo(hazy, wi, COARSE), *lj.specular(hazy, wi)))
    np.testing.assert_allclose(whole, 1.0, atol=1e-3)  # as without the films; 1e-6 with 16 nodes


@pytest.mark.slow
def test_draws_of_a_coated_pane_bring_its_energy():
    stack = lj.Stack([lj.Interface(1.52, film=FILM), lj.Medium(0.7), lj.Interface(1.0, film=FILM)])
    wi = jnp.broadcast_to(WI, (20_000, 3))
    _, _, weight = lj.sample(stack, wi, jax.random.key(0), COARSE)
    error = np.std(weight, axis=0) / np.sqrt(len(weight))
    assert np.all(np.abs(np.mean(weight, axis=0) - 1.0) < 4.5 * error + 1e-3)


# ---- rough interfaces, in stacks ----


def test_every_facet_has_the_film_s_reflectance():
    """Of what it reflects from either side, and of what it passes either way."""
    filmed, bare = (lj.Stack([lj.Interface(1.5, 0.3, film=film)]) for film in (FILM, None))
    inside = lj.direction([2.8, 2.3], [3.0, 2.9])
    first = lj.AddingDoubling(orders="first")
    for wi, wo, ior in ((WI, UP, 1.5), (-WI, -UP, 1 / 1.5), (WI, inside, 1.5), (inside, WI, 1.5)):
        ratio = lj.evaluate(filmed, wi, wo, first) / lj.evaluate(bare, wi, wo, first)
        reflects = wi is not inside and wo is not inside
        normal = np.asarray(wi + wo if reflects else WI + 1.5 * inside)
        cosine = np.abs(np.sum(normal * (wi if reflects else WI), axis=-1)) / np.linalg.norm(normal, axis=-1)
        of_bare = fresnel.dielectric(cosine, ior)
        for c, wavelength in enumerate(RGB):
            index = 1.0 if ior > 1.0 else 1.5
            shares = airy(cosine, ior, FILM.ior[c] / index, index * 2.0 * np.pi * 120.0 / wavelength)
            expected = shares[0] / of_bare if reflects else shares[1] / (1.0 - of_bare)
            np.testing.assert_allclose(ratio[..., c], expected, rtol=1e-9)


def test_a_traced_thickness_of_0_is_that_of_no_film_and_has_its_slope():
    @jax.jit
    def values(thickness):
        film = lj.ThinFilm(1.9, thickness, RGB)
        return lj.evaluate(lj.Stack([lj.Interface(1.5, 0.3, film=film)], lj.Lambertian(0.5)), WI, UP, COARSE)

    bare = lj.evaluate(lj.Stack([lj.Interface(1.5, 0.3)], lj.Lambertian(0.5)), WI, UP, COARSE)
    np.testing.assert_allclose(values(0.0), jnp.broadcast_to(bare, (3, 3)), rtol=1e-12)
    assert np.abs(values(80.0) / bare - 1.0).min() > 0.01
    slope = jax.jit(jax.jacfwd(values))(80.0)
    np.testing.assert_allclose(slope, (values(80.01) - values(79.99)) / 0.02, rtol=1e-5)
    assert np.abs(slope).min() > 1e-5


def test_gradients_by_all_numbers_of_a_film():
    """Known numbers, and elements that have programs of their own."""

    def mean(ior, thickness, wavelengths):
        film = lj.ThinFilm(ior, thickness, wavelengths)
        return jnp.mean(lj.evaluate(lj.Stack([lj.Interface(1.5, film=film), lj.Medium(0.5)]), WI, UP, COARSE))

    point = jnp.asarray([2.0, 2.1]), jnp.asarray(80.0), jnp.asarray([610.0, 465.0])
    found = jax.grad(mean, argnums=(0, 1, 2))(*point)
    for place, size in enumerate((1e-5, 1e-3, 1e-3)):
        for k in range(found[place].size):
            step = size * (jnp.arange(found[place].size) == k).reshape(found[place].shape)
            up, down = ([x + s * step if place == at else x for at, x in enumerate(point)] for s in (1.0, -1.0))
            expected = (mean(*up) - mean(*down)) / (2.0 * size)
            np.testing.assert_allclose(np.ravel(found[place])[k], expected, rtol=1e-5, atol=1e-9)


def test_a_map_of_thicknesses_is_its_texels():
    def stack(thickness):
        film = lj.ThinFilm(2.0, thickness, RGB)
        return lj.Stack([lj.Interface(1.5, 0.3, film=film)], lj.Lambertian(0.5))

    thicknesses = (0.0, 80.0, 200.0, 300.0)
    found = lj.evaluate(stack(np.array(thicknesses)), WI, UP[0], COARSE)
    np.testing.assert_allclose(found, [lj.evaluate(stack(one), WI, UP[0], COARSE) for one in thicknesses], rtol=1e-10)


AGREEMENT = {
    "paint": (lj.Stack([lj.Interface(1.5, 0.3, film=FILM)], lj.Lambertian([0.7, 0.5, 0.3])), UP),
    "hazy slab": (
        lj.Stack(
            [lj.Interface(1.5, 0.3, film=FILM), lj.Medium([0.5, 0.7, 0.3], 0.9), lj.Interface(1.0, 0.2, film=FILM)]
        ),
        ALL,
    ),
    "one side of a slab": (lj.Stack([lj.Interface(1.5, 0.3), lj.Interface(1.2, 0.2, "beckmann", film=FILM)]), ALL),
    "smooth pane": (
        lj.Stack([lj.Interface(1.5, film=FILM), lj.Medium([0.5, 0.7, 0.3], 0.9), lj.Interface(1.0, film=FILM)]),
        ALL,
    ),
    "rough under smooth": (
        lj.Stack([lj.Interface(1.3, film=FILM), lj.Interface(1.7, 0.3, film=FILM)], lj.Lambertian([0.7, 0.5, 0.3])),
        UP,
    ),
    "three films on metal": (
        lj.Stack(
            [lj.Interface(1.5, 0.3, film=FILM), lj.Interface(1.3, 0.4, film=FILM), lj.Interface(1.6, 0.3, film=FILM)],
            lj.Conductor(0.2, 3.0, 0.4),
        ),
        UP,
    ),
    "brushed": (lj.Stack([lj.Interface(1.5, 0.2, alpha_y=0.4, film=FILM)], lj.Lambertian([0.7, 0.5, 0.3])), UP),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", AGREEMENT)
def test_solver_and_walk_agree(name):
    """Within five standard errors of the walk, and what nodes leave."""
    stack, wo = AGREEMENT[name]
    exact = lj.evaluate(stack, WI, wo, lj.AddingDoubling())
    mean, error = lj.evaluate_with_error(stack, WI, wo, lj.RandomWalk(paths=30_000), key=jax.random.key(0))
    assert np.all(np.abs(exact - mean) < 5.0 * error + 0.002 * exact)
    assert np.median(error / mean) < 0.05
    assert np.min(np.ptp(np.asarray(mean), axis=-1) / np.mean(mean, axis=-1)) > 0.03  # channels differ


# ---- what there is, and what there is not ----


def test_thick_films_get_more_nodes():
    def nodes(thickness):
        film = lj.ThinFilm(1.6, thickness, RGB)
        return lj.choose_transport(lj.Stack([lj.Interface(1.5, 0.3, film=film)], lj.Lambertian(0.5)), WI, UP).nodes

    assert nodes(100.0) == 6
    assert nodes(3000.0) == 24


def test_a_film_between_equal_indices_stays():
    pellicle = lj.Stack([lj.Interface(1.0, film=lj.ThinFilm(1.5, 300.0, RGB)), lj.Interface(1.0)])
    assert len(simplify(pellicle).layers) == 1
    assert simplify(pellicle).layers[0].film is not None
    assert simplify(lj.Stack([lj.Interface(1.0, film=lj.ThinFilm(1.5, 0.0, RGB))])).layers == ()
    mirrored, passed = lj.specular(pellicle, WI)
    expected = [airy(np.cos(0.6), 1.0, 1.5, 2.0 * np.pi * 300.0 / wavelength) for wavelength in RGB]
    np.testing.assert_allclose(np.stack([mirrored, passed], -1), expected, rtol=1e-10)


def test_rough_films_between_equal_indices_are_refused():
    """Their facets reflect, but refract nothing: the rest is a delta."""
    above, inside = lj.Interface(1.0, 0.3, film=FILM), lj.Interface(1.3, 0.3, "beckmann", film=FILM)
    for stack, message in (
        (lj.Stack([above]), r"layers\[0\]\.ior: 1 is the index above it, and its facets have a film"),
        (lj.Stack([above], lj.Lambertian(0.5)), r"layers\[0\]\.ior: 1 is"),
        (lj.Stack([lj.Medium(1.0), lj.Interface(1.3), inside]), r"layers\[2\]\.ior: 1\.3 is"),
    ):
        for call in (
            lambda stack: lj.evaluate(stack, WI, WI, COARSE),
            lambda stack: lj.albedo(stack, WI, lj.RandomWalk(paths=64), key=jax.random.key(0)),
            lambda stack: lj.sample(stack, WI, jax.random.key(0), COARSE),
            lambda stack: lj.specular(stack, WI),
            lambda stack: lj.goniophotometer(stack, WI, key=jax.random.key(0), paths=64),
        ):
            with pytest.raises(ValueError, match=message):
                call(stack)
    with pytest.raises(ValueError, match=r"layers\[1\]\.ior: 1\.4 is"):  # of a map
        lj.specular(lj.Stack([lj.Interface(np.array([1.5, 1.4])), lj.Interface(1.4, 0.3, film=FILM)]), WI)
    # a film without thickness is none, and next to it light is refracted
    assert simplify(lj.Stack([lj.Interface(1.0, 0.3, film=lj.ThinFilm(1.5, 0.0, RGB))])).layers == ()
    near = lj.Stack([lj.Interface(1.01, 0.3, film=FILM)])
    energies = np.sum([*lj.albedo(near, WI, lj.AddingDoubling(nodes=24, modes=4)), *lj.specular(near, WI)], axis=0)
    assert np.all((energies > 0.9) & (energies < 1.0))


def test_it_counts_channels_and_is_shown():
    stack = lj.Stack([lj.Interface(1.5, 0.3, film=FILM)])
    assert stack.channels == 3
    assert repr(stack.layers[0].film) in repr(stack)
    assert eval(repr(stack), vars(lj)).layers[0].film.thickness_nm == 120.0
    with pytest.raises(ValueError, match="number of channels"):
        lj.Stack([lj.Interface(1.5, 0.3, film=FILM)], lj.Lambertian([0.5, 0.4]))


def test_what_cannot_be_is_named():
    paint = lj.Stack([lj.Medium(0.1, 0.0), lj.Interface(1.5, 0.3, film=FILM)], lj.Lambertian(0.5))
    smooth = lj.Stack([lj.Interface(1.5, film=FILM)], lj.Conductor(0.2, 3.0, 0.3))
    coat = lj.Stack([lj.Interface(1.5, 0.3, film=FILM)], lj.Conductor(0.2, 3.0, 0.3))
    up = lj.direction(0.3, 0.0)
    many = lj.AddingDoubling(nodes=4, modes=4, facet_multiple_scattering=True)
    for call, message in (
        (lambda: lj.evaluate(smooth, up, up, lj.Statistical()), r"layers\[0\]\.film: Statistical carries no ThinFilm"),
        (lambda: lj.evaluate(coat, up, up, lj.ENDF()), r"layers\[0\]\.film: ENDF carries no ThinFilm on an Interface"),
        (lambda: lj.evaluate(paint, up, up, lj.WeidlichWilkie()), r"layers\[1\]\.film: WeidlichWilkie carries no"),
        (lambda: lj.evaluate(paint, up, up, many), r"layers\[1\]\.film: AddingDoubling\(facet.* on a rough Interface"),
        (
            lambda: lj.evaluate(
                paint, up, up, lj.RandomWalk(paths=64, facet_multiple_scattering=True), key=jax.random.key(0)
            ),
            r"layers\[1\]\.film: RandomWalk\(facet.* on a rough Interface",
        ),
        (lambda: lj.Interface(1.5, film=1.8), r"Interface\.film: 1\.8 is not a ThinFilm or None"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert np.all(np.isfinite(lj.evaluate(smooth, up, up, many)))
