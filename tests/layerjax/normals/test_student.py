"""Facets with Student-t slopes: densities and areas against scipy, samplers, limits, transports."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import betainc, gammaln

import layerjax as lj
from layerjax.directions import split
from layerjax.normals import facets
from layerjax.normals.student import power_integral, power_rest, power_share
from layerjax.normals.widths import StudentWidth
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from tests.helpers.derivatives import with_slopes
from tests.helpers.interfaces import pairs
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

KIND = "gtr"
MIRROR = (0.01, 20.0)  # of index 1 reflects 0.9999 of the light
GAMMAS = [1.75, 2.0, 3.3, 40.0]
density = jax.jit(facets.density, static_argnums=2)
twice_projected_area = jax.jit(facets.twice_projected_area, static_argnums=3)
sample = jax.jit(facets.sample, static_argnums=4)
reflection_pdf = jax.jit(facets.reflection_pdf, static_argnums=3)
masking_of = jax.jit(facets.masking, static_argnums=2)


def tailed(alpha, gamma):
    return StudentWidth(jnp.asarray(alpha), jnp.asarray(gamma))


def masking(cosine, alpha, gamma):
    """Smith's G1 by the marginal density of slopes, Student-t with 2 gamma - 2 degrees of freedom, in numpy."""
    g = gamma - 1.0
    a = cosine / np.sqrt(np.maximum(1.0 - cosine**2, 1e-30)) / alpha
    level = np.exp(gammaln(gamma - 0.5) - gammaln(gamma)) * np.sqrt(g / np.pi)
    beyond = level * g / (2.0 * gamma - 3.0) * (1.0 + a * a / g) ** (1.5 - gamma)  # integral of p from a on
    rest = 0.5 * (1.0 - betainc(0.5, g, a * a / (g + a * a)))
    return a / (a * (1.0 - rest) + beyond)


def drawn_energies(theta, alpha, gamma, index, draws=400_000):
    """Energies that facets reflect and refract, and their errors: slopes are drawn, and weighed by what is seen."""
    random = np.random.default_rng(7)
    radius = alpha * np.sqrt((gamma - 1.0) * (random.random(draws) ** (-1.0 / (gamma - 1.0)) - 1.0))
    phi = 2.0 * np.pi * random.random(draws)
    m = np.stack([radius * np.cos(phi), radius * np.sin(phi), np.ones(draws)], axis=-1)
    m = m / np.linalg.norm(m, axis=-1, keepdims=True)
    wi = np.array([np.sin(theta), 0.0, np.cos(theta)])
    c = m @ wi
    seen = np.maximum(c, 0.0) / m[:, 2] / wi[2] * masking(wi[2], alpha, gamma)  # its mean is 1
    root = np.sqrt(index**2 - 1.0 + np.maximum(c, 1e-9) ** 2 + 0j)
    s, p = (c - root) / (c + root), (index**2 * c - root) / (index**2 * c + root)
    level = 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)
    up = np.clip(2.0 * c * m[:, 2] - wi[2], -1.0, 1.0 - 1e-12)
    eta = np.real(index)
    bent = np.sqrt(np.maximum(1.0 - (1.0 - c * c) / eta**2, 0.0))
    down = np.clip(-((c / eta - bent) * m[:, 2] - wi[2] / eta), -1.0, 1.0 - 1e-12)
    parts = [
        seen * level * np.where(up > 0, masking(np.maximum(up, 1e-9), alpha, gamma), 0.0),
        seen * (1.0 - level) * np.where(down > 0, masking(np.maximum(down, 1e-9), alpha, gamma), 0.0),
    ]
    return [(part.mean(), part.std() / np.sqrt(draws)) for part in parts]


@pytest.mark.parametrize("k", [0.5, 1.0, 2.3, 20.0, 77.0, 78.0])
def test_powers_of_the_cosine_are_integrated(k):
    t = np.concatenate([[0.0], np.geomspace(1e-8, 0.5 * np.pi - 1e-9, 300)])
    share, rest = (jax.jit(f)(np.sin(t), np.cos(t), k) for f in (power_share, power_rest))
    np.testing.assert_allclose(share, betainc(0.5, 0.5 * (k + 1.0), np.sin(t) ** 2), rtol=1e-9, atol=1e-12)
    exact = betainc(0.5 * (k + 1.0), 0.5, np.cos(t) ** 2)
    np.testing.assert_allclose(rest, exact, atol=2e-8)  # its argument rounds to 1
    whole = 0.5 * np.sqrt(np.pi) * np.exp(gammaln(0.5 * (k + 1.0)) - gammaln(0.5 * k + 1.0))
    np.testing.assert_allclose(power_integral(jnp.asarray(k)), whole, rtol=1e-11)


@pytest.mark.parametrize("gamma", [1.75, 1.9, 2.0, 3.3, 12.0, 40.0])
@pytest.mark.parametrize("alpha", [1.0, 0.3, 0.01])
def test_it_is_normalised_and_masking_is_exact(alpha, gamma):
    x, w = np.polynomial.legendre.leggauss(200)
    y = 0.25 * (x + 1.0) * np.pi  # a half angle: the tangent of the polar angle goes like a power of its tangent
    slope = alpha * np.tan(y) ** 3
    measure = 0.25 * np.pi * w * 3.0 * alpha * np.tan(y) ** 2 / np.cos(y) ** 2
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    m = jnp.asarray(slope * cosine), jnp.zeros(slope.shape), jnp.asarray(cosine)
    found = density(m, tailed(alpha, gamma), KIND)
    whole = np.where(cosine > 1e-6, found * cosine**4 * 2.0 * np.pi * slope, 0.0) * measure
    beyond = (1.0 + 1e12 / alpha**2 / (gamma - 1.0)) ** (1.0 - gamma)  # of normals with a cosine below 1e-6
    np.testing.assert_allclose(np.sum(whole) + beyond, 1.0, atol=1e-7)
    for theta in (1e-3, 0.2, 0.9, 1.4, 1.55, 1.5707):
        w = split(lj.direction(theta, 0.3))
        found = masking_of(w, tailed(alpha, gamma), KIND)
        np.testing.assert_allclose(found, masking(np.cos(theta), alpha, gamma), rtol=1e-9)


def test_it_is_ggx_at_2_and_nears_beckmann():
    w = split(lj.direction(np.linspace(0.0, 1.57, 200), 0.3))
    u1, u2 = (jnp.asarray(u) for u in np.random.default_rng(0).random((2, 200)))
    for alpha in (jnp.asarray(a) for a in (1.0, 0.3, 0.003)):
        same, most = tailed(alpha, 2.0), tailed(alpha, 40.0)
        np.testing.assert_allclose(density(w, same, KIND), density(w, alpha, "ggx"), rtol=1e-9)
        for part, exact in ((same, "ggx"), (most, "beckmann")):
            areas = (twice_projected_area(w[2], w, a, k) for a, k in ((part, KIND), (alpha, exact)))
            np.testing.assert_allclose(*areas, rtol=1e-9 if exact == "ggx" else 1.2e-2)  # to first order 3 / (8 gamma)
        # draws of other numbers, but with the same density: what u1 and u2 are for one is known for the other
        v = split(lj.direction(0.8, 0.1))
        m = sample(v, same, u1, u2, KIND)
        pdf = reflection_pdf(m, v, same, KIND)
        np.testing.assert_allclose(pdf, reflection_pdf(m, v, alpha, "ggx"), rtol=1e-9)
    # the density along the normal is the same; at one alpha it is exp(-1) in the limit, less 1 / (2 gamma) of that
    at = density(split(lj.direction(np.arctan(0.3), 0.0)), tailed(0.3, 40.0), KIND)
    limit = density(split(lj.direction(np.arctan(0.3), 0.0)), jnp.asarray(0.3), "beckmann")
    np.testing.assert_allclose(at / limit, 1.0 - 0.5 / 40.0, atol=1e-3)


@pytest.mark.parametrize("gamma", GAMMAS)
def test_normals_are_drawn_as_they_are_seen(gamma):
    """Both numbers are the cumulative shares of two angles, of the slopes against and across, in scipy."""
    alpha, k = 0.4, 2.0 * gamma - 3.0
    u1, u2 = np.random.default_rng(1).random((2, 500))
    for theta in (1e-3, 0.7, 1.3, 1.569):
        wi = split(lj.direction(theta, 0.9))
        m = sample(wi, tailed(alpha, gamma), jnp.asarray(u1), jnp.asarray(u2), KIND)
        size = alpha * np.sqrt(gamma - 1.0)
        p = -(np.cos(0.9) * m[0] + np.sin(0.9) * m[1]) / m[2] / size
        q = -(np.cos(0.9) * m[1] - np.sin(0.9) * m[0]) / m[2] / size
        across = q / np.sqrt(1.0 + p * p + q * q)
        share = 0.5 + 0.5 * np.sign(across) * betainc(0.5, 0.5 * k + 1.0, across**2)
        np.testing.assert_allclose(share, u2, atol=2e-8)
        whole = 0.5 * np.sqrt(np.pi) * np.exp(gammaln(0.5 * (k + 1.0)) - gammaln(0.5 * k + 1.0))
        z, planar = np.cos(theta), size * np.sin(theta)
        below = z * (1.0 + np.sign(p) * betainc(0.5, 0.5 * (k + 1.0), p * p / (1.0 + p * p)))
        below += planar * (1.0 + p * p) ** (-0.5 * k) / (k * whole)
        area = twice_projected_area(wi[2], wi, tailed(alpha, gamma), KIND)
        assert np.quantile(np.abs(below / area - u1), 0.99) < 1e-8
        assert np.max(np.abs(below / area - u1)) < 3e-5


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "gamma", "theta"), [(0.9, 1.75, 0.7), (0.4, 3.0, 1.4), (0.4, 40.0, 0.0)])
def test_a_conductor_is_sampled_as_it_says(alpha, gamma, theta):
    stack, wi = lj.Stack([], lj.Conductor(*MIRROR, alpha, KIND, gamma=gamma)), lj.direction(theta, 0.4)
    wo, _, weight = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(11))
    above = wo[:, 2] > 0
    probability, total = chi_square(wo[above], lambda w: jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w), 0.0))
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, np.mean(above), atol=5e-3)
    energy, _ = lj.albedo(stack, wi)
    assert abs(np.mean(weight) - energy[0]) < 4.5 * np.std(weight) / np.sqrt(DRAWS) + 3e-4
    assert weight.max() < 1.0 + 1e-9  # normals are drawn as they are seen: what is left is masking, and Fresnel's share


@pytest.mark.slow
@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_energies_are_those_of_draws(ior):
    """By the quadrature of facets, as the solver and `lj.albedo` take them."""
    for theta, alpha, gamma in ((0.6, 1.0, 1.75), (1.2, 0.1, 40.0), (1.2, 0.6, 2.4), (1.3, 0.3, 1.9)):
        stack = lj.Stack([lj.Interface(ior, alpha, KIND, gamma=gamma)])
        found = lj.albedo(stack, lj.direction(theta, 0.4), lj.AddingDoubling(nodes=8, modes=4))
        for share, (mean, error) in zip(found, drawn_energies(theta, alpha, gamma, ior), strict=True):
            assert abs(share[0] - mean) < 4.0 * error + 2e-4


def test_energies_of_a_conductor_are_those_of_draws():
    index = MIRROR[0] + 1j * MIRROR[1]
    for theta, alpha, gamma in ((0.0, 0.3, 1.75), (0.7, 1.0, 2.5), (1.3, 0.05, 40.0), (1.3, 0.6, 1.8)):
        stack = lj.Stack([], lj.Conductor(*MIRROR, alpha, KIND, gamma=gamma))
        found, _ = lj.albedo(stack, lj.direction(theta, 0.3))
        (mean, error), _ = drawn_energies(theta, alpha, gamma, index)
        assert abs(found[0] - mean) < 4.0 * error + 2e-4
        assert found[0] < 1.0


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
def test_values_draws_and_slopes_are_finite(dtype):
    random = np.random.default_rng(8)
    wi, wo, ior, alpha = pairs(random, 2000, [1e-4, 0.01, 0.3, 1.0], dtype)
    gamma = random.choice([1.75, 2.0, 5.0, 40.0], 2000).astype(dtype)
    u = tuple(random.choice([0.0, 1.0 - 1e-7, *random.random(200)], (3, 2000)).astype(dtype))

    def everything(wi, wo, ior, alpha, gamma, u):
        below, width = (wo[0], wo[1], -wo[2]), StudentWidth(alpha, gamma)
        reflected = interface_reflection(wi, wo, ior, width, KIND)
        passed = interface_transmission(wi, below, ior, width, KIND)
        drawn, _ = interface_sample(wi, ior, width, *u, KIND)
        return jnp.stack([reflected, passed, interface_pdf(reflected, wi, wo, ior, width, KIND), *drawn])

    slopes_of = jax.jit(jax.vmap(with_slopes(everything, (0, 1, 2, 3, 4), "forward")))
    values, slopes = slopes_of(wi, wo, ior, alpha, gamma, u)
    for leaf in jax.tree.leaves((values, slopes)):
        assert np.isfinite(leaf).all()
    assert (values[:, :3] >= 0).all()


@pytest.mark.parametrize("gamma", [1.75, 2.0, 7.0, 40.0])
def test_slopes_of_values_and_draws_are_differences(gamma):
    wi, wo = lj.direction(0.7, 0.2), lj.direction(0.5, 2.9)

    def values(numbers):
        alpha, gamma, theta = numbers
        f = lj.evaluate(lj.Stack([], lj.Conductor(0.2, 3.0, alpha, KIND, gamma=gamma)), wi, wo)[0]
        m = facets.sample(
            split(lj.direction(theta, 0.3)), StudentWidth(alpha, gamma), jnp.asarray(0.3), jnp.asarray(0.8), KIND
        )
        return jnp.stack([f, *m])

    slope_of, values_of = jax.jit(jax.jacfwd(values)), jax.jit(jax.vmap(values))
    for alpha, theta in ((0.1, 1.5), (0.8, 0.4)):
        at = jnp.array([alpha, gamma, theta])
        step = 1e-6 * np.diag(at)
        found = slope_of(at)
        expected = (values_of(at + step) - values_of(at - step)) / (2.0 * np.diag(step)[:, None])
        np.testing.assert_allclose(found, expected.T, rtol=2e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([lj.Interface(1.5, 0.3, KIND, gamma=1.8)], lj.Lambertian(0.6)),
        lj.Stack(
            [lj.Interface(1.5, 0.3, KIND, gamma=8.0), lj.Medium(0.3, 0.8)],
            lj.Conductor(0.2, 3.9, 0.3, KIND, gamma=2.5),
        ),
        lj.Stack([lj.Interface(1.5, 0.2, KIND, gamma=3.0), lj.Interface(1.0, 0.4)]),
        lj.Stack([lj.Interface(1.5, 0.3, KIND, alpha_y=0.5, tangent=0.4, gamma=3.0)], lj.Lambertian(0.6)),
    ],
    ids=["paint", "metal", "slab", "two widths"],
)
def test_solver_and_walk_agree(stack):
    wi = lj.direction(0.6, 0.0)
    theta, phi = np.array([0.3, 0.6, 1.2]), np.array([2.5, 3.0, 0.5])
    wo = lj.direction(theta if stack.base is not None else np.pi - theta, phi)
    exact = lj.evaluate(stack, wi, wo, lj.AddingDoubling())
    mean, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=60_000), key=jax.random.key(0))
    assert np.all(np.abs(exact - mean) < 4.0 * error + 0.005 * exact)


def test_two_equal_widths_are_one():
    wi, wo = (split(lj.direction(*angles)) for angles in ((0.7, 0.2), (0.5, 2.9)))
    one, two = tailed(0.3, 3.0), facets.width_of(jnp.asarray(0.3), jnp.asarray(0.3), jnp.asarray(0.7), jnp.asarray(3.0))
    u = jnp.asarray(0.3), jnp.asarray(0.8)
    for f in (
        lambda width: density(wi, width, KIND),
        lambda width: twice_projected_area(wi[2], wi, width, KIND),
        lambda width: jnp.stack(sample(wi, width, *u, KIND)),
        lambda width: reflection_pdf(wo, wi, width, KIND),
    ):
        np.testing.assert_allclose(f(two), f(one), rtol=1e-9)


def test_others_refuse_it_by_name():
    stack = lj.Stack([lj.Interface(1.5, 0.3, KIND, gamma=3.0)], lj.Lambertian(0.6))
    for transport in (
        lj.Statistical(),
        lj.WeidlichWilkie(),
        lj.AddingDoubling(facet_multiple_scattering=True),
        lj.RandomWalk(facet_multiple_scattering=True),
    ):
        with pytest.raises(ValueError, match=r'layers\[0\].distribution: .* carries no "gtr" normals; Adding'):
            lj.prepare(stack, transport)
    metal = lj.Stack([], lj.Conductor(*MIRROR, 0.3, KIND, gamma=3.0))
    with pytest.raises(ValueError, match=r'base.distribution: ENDF carries no "gtr" normals; Adding'):
        lj.prepare(metal, lj.ENDF())
    for make, message in (
        (lambda: lj.Interface(1.5, 0.3, KIND), r'Interface\.gamma: not given, "gtr" normals need it'),
        (lambda: lj.Interface(1.5, 0.3, gamma=3.0), r'Interface\.gamma: given with "ggx" normals'),
        (lambda: lj.Conductor(*MIRROR, 0.3, KIND, gamma=1.5), r"Conductor\.gamma: 1\.5 is outside \[1\.75, 40\]"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
