"""Phase functions: Rayleigh against published values, and one that is made here, which nothing else knows of.

Whatever keeps the contract is carried by the transports that carry any medium, and refused by name by the others.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import layerjax as lj
from layerjax._parameters import parameter
from layerjax._shapes import channel_count
from layerjax.directions import add, combine, dot, frame, half_vector, join, normalize, reflect, scale, split
from layerjax.phase.contract import deflect
from layerjax.phase.moments import moments_by_quadrature


class Schlick(lj.PhaseFunction):
    """p = (1 - k^2) / (4 pi (1 - k cos)^2), cos that of deflection (Blasi, Le Saec & Schlick 1993)."""

    k: jax.Array = parameter("Schlick.k", limits=(-0.99, 0.99))

    def pdf(self, wi, wo):
        return (1.0 - self.k**2) / (4.0 * jnp.pi * (1.0 + self.k * dot(wi, wo)) ** 2)

    def sample(self, wi, u1, u2):
        cosine = (2.0 * u1 + self.k - 1.0) / (2.0 * self.k * u1 - self.k + 1.0)
        return deflect(wi, cosine, jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), 2.0 * jnp.pi * u2)

    def moments(self, count):
        return moments_by_quadrature(self.pdf, count, jnp.result_type(self.k))


class Ellipsoid(lj.PhaseFunction):
    """Mirrors with the normals of any ellipsoid S = M M' (Heitz et al. 2015, Eqs. 4, 5 and 12), written as matrices.

    M: the directions of its axes, each as long as the area seen along it.
    """

    m: jax.Array

    @property
    def is_axisymmetric(self):
        return False

    def mirror(self):
        return Ellipsoid(self.m * jnp.array([[1.0], [1.0], [-1.0]]))

    def cross_section(self, w):
        return jnp.linalg.norm(join(w) @ self.m, axis=-1)

    def pdf(self, wi, wo):
        h = join(half_vector(wi, wo)[0])
        squared = jnp.sum((h @ jnp.linalg.inv(self.m).T) ** 2, axis=-1)
        normals = 1.0 / (jnp.pi * jnp.abs(jnp.linalg.det(self.m)) * squared**2)
        return normals / (4.0 * self.cross_section(wi))

    def sample(self, wi, u1, u2):
        v = normalize(split(join(wi) @ self.m))
        radius, phi = jnp.sqrt(u1), 2.0 * jnp.pi * u2
        tangent, bitangent = frame(v)
        local = add(
            combine(radius * jnp.cos(phi), tangent, radius * jnp.sin(phi), bitangent), scale(jnp.sqrt(1 - u1), v)
        )
        return reflect(wi, normalize(split(join(local) @ self.m.T)))


def ellipsoid(*lengths):
    """Axes of these lengths, the last along `TILT`."""
    axis = np.array(TILT)
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return Ellipsoid(jnp.asarray(np.stack([across, np.cross(axis, across), axis], axis=-1) * lengths))


TILT = (0.48, 0.36, 0.8)
IMITATED = {
    "surface": (lj.SGGX("surface", 0.5, TILT), ellipsoid(0.5, 0.5, 1.0)),
    "fiber": (lj.SGGX("fiber", 0.4, TILT), ellipsoid(1.0, 1.0, 0.4)),
}
RAYLEIGH = lj.Rayleigh()
PHASES = {"Rayleigh": RAYLEIGH, "Schlick": Schlick(0.5), "Schlick, backward": Schlick(-0.4)}
WI = lj.direction(0.7, 0.3)
WO = lj.direction(np.array([0.2, 1.0, 1.4, 2.0, 2.8, 2.4]), np.array([0.0, 2.0, 3.4, 1.0, 3.0, 5.0]))
DRAWS, SIGNIFICANCE = 20_000, 1e-4
SOLVER = lj.AddingDoubling(nodes=24, modes=16)

each = pytest.mark.parametrize("phase", PHASES.values(), ids=PHASES)


def by_cosine(phase, cosine):
    """p where light along z is turned by that angle."""
    wi = tuple(jnp.full(np.shape(cosine), x) for x in (0.0, 0.0, -1.0))
    wo = (jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), jnp.zeros_like(cosine), jnp.asarray(cosine))
    return np.asarray(phase.pdf(wi, wo))


def moments(phase, count):
    """Means of Legendre polynomials of the cosine of deflection."""
    x, w = np.polynomial.legendre.leggauss(64)
    p = 2.0 * np.pi * w * by_cosine(phase, x)
    return np.array([np.sum(p * np.polynomial.legendre.Legendre.basis(n)(x)) for n in range(count)])


def test_rayleigh_by_hand():
    expected = np.array([2.0, 1.25, 1.0, 1.25, 2.0]) * 3.0 / (16.0 * np.pi)
    np.testing.assert_allclose(by_cosine(RAYLEIGH, np.array([-1.0, -0.5, 0.0, 0.5, 1.0])), expected, rtol=1e-14)
    np.testing.assert_allclose(moments(RAYLEIGH, 5), [1.0, 0.0, 0.1, 0.0, 0.0], atol=1e-14)


@each
def test_they_are_normalised_symmetric_and_resolved_by_their_rule(phase):
    np.testing.assert_allclose(moments(phase, 1), 1.0, rtol=1e-12)
    wi = split(WI)
    spread = tuple(x[None] for x in wi)
    total = sum(jnp.sum(phase.pdf(spread, wo) * weight) for wo, weight in phase.rule(wi, 32))
    np.testing.assert_allclose(total, 1.0, rtol=1e-9)
    wo = split(WO)
    kernel, back = phase.kernel(wi, wo, None), phase.kernel(wo, wi, None)
    np.testing.assert_allclose(kernel, back, rtol=1e-14)
    np.testing.assert_allclose(phase.kernel(tuple(-x for x in wi), tuple(-x for x in wo), None), back, rtol=1e-14)


@each
def test_draws_follow_p(phase):
    """By the distribution of the deflection, and of the azimuth about the direction of travel, which is uniform."""
    u = jax.random.uniform(jax.random.key(1), (2, DRAWS))
    wi = split(WI)
    wo = phase.sample(tuple(jnp.full(DRAWS, x) for x in wi), *u)
    np.testing.assert_allclose(dot(wo, wo), 1.0, rtol=1e-12)
    cosine = -np.asarray(dot(wi, wo))
    x, w = np.polynomial.legendre.leggauss(32)

    def below(c):
        half = 0.5 * (np.asarray(c)[..., None] + 1.0)
        return np.sum(2.0 * np.pi * half * w * by_cosine(phase, half * (x + 1.0) - 1.0), axis=-1)

    assert scipy.stats.kstest(cosine, below).pvalue > SIGNIFICANCE
    across = np.array([np.sin(0.3), -np.cos(0.3), 0.0])
    along = np.cross(across, WI)
    azimuth = np.arctan2(*(np.asarray(wo).T @ axis for axis in (across, along)))
    assert scipy.stats.kstest(azimuth, "uniform", (-np.pi, 2.0 * np.pi)).pvalue > SIGNIFICANCE


def test_the_walk_draws_the_same_deflection_from_the_same_number():
    u = jnp.linspace(0.0, 1.0, 1001)
    cosine, sine = RAYLEIGH.deflection(u)
    np.testing.assert_allclose((cosine**3 + 3.0 * cosine + 4.0) / 8.0, u, atol=1e-14)
    np.testing.assert_allclose(cosine**2 + sine**2, 1.0, rtol=1e-14)
    wo = RAYLEIGH.sample(split(jnp.broadcast_to(WI, (1001, 3))), u, u)
    np.testing.assert_allclose(-dot(split(WI), wo), cosine, atol=1e-14)


COSINE, VIEWED = 0.080442, np.array([0.018014, 0.538263, 0.981986, -0.018014, -0.538263, -0.981986])
PUBLISHED = {
    (0.2, 0.5): ([5.35063e-2, 4.41791e-2], [1.61796e-1, 2.11501e-2, 7.86713e-3, 2.57685e-2, 2.00778e-2, 7.71897e-3]),
    (0.2, 1.0): ([1.25561e-1, 1.06123e-1], [3.47678e-1, 4.87120e-2, 1.89387e-2, 6.77603e-2, 4.64061e-2, 1.86027e-2]),
    (5.0, 0.5): ([6.24730e-2, 2.51683e-4], [1.62566e-1, 2.45786e-2, 1.01498e-2, 1.32472e-5, 3.97168e-5, 1.70004e-4]),
    (5.0, 1.0): ([2.25915e-1, 2.68008e-2], [3.64010e-1, 8.26993e-2, 4.92370e-2, 3.79276e-3, 7.69337e-3, 1.05950e-2]),
}
"""Problem 2 of DISORT's tests, after Table 1 of Sweigart (1970): flux up and down, and radiance at phi = 0, of slabs of
(thickness, albedo) under a beam of flux pi across itself. Made with 16 streams: 1e-3 beside the horizon."""


@jax.jit
def slab_of_rayleigh(thickness, albedo):
    prepared = lj.prepare(lj.Stack([lj.Medium(thickness, albedo, RAYLEIGH)]), SOLVER)
    wi, wo = lj.direction(np.arccos(COSINE), np.pi), lj.direction(np.arccos(VIEWED), 0.0)
    return jnp.ravel(jnp.stack(lj.albedo(prepared, wi))), lj.evaluate(prepared, wi, wo)[:, 0]


@pytest.mark.parametrize("slab", PUBLISHED)
def test_published_rayleigh_slabs(slab):
    (flux, radiance), (energy, values) = PUBLISHED[slab], slab_of_rayleigh(*slab)
    np.testing.assert_allclose(energy * np.pi * COSINE, flux, rtol=5e-4)
    np.testing.assert_allclose(values * np.pi * COSINE, radiance, rtol=2e-3)


@each
def test_single_scattering_is_a_quadrature_over_depth(phase):
    thickness, albedo = 1.3, 0.8
    values = lj.evaluate(lj.Stack([lj.Medium(thickness, albedo, phase)]), WI, WO, lj.SingleScattering())[:, 0]
    x, w = np.polynomial.legendre.leggauss(40)
    depth, weight = 0.5 * thickness * (x + 1.0), 0.5 * thickness * w
    mu_i, mu_o = float(WI[2]), np.asarray(WO[:, 2])[:, None]
    way_out = np.where(mu_o > 0, depth, thickness - depth) / np.abs(mu_o)
    collided = np.sum(weight * np.exp(-depth / mu_i - way_out), axis=-1) / (mu_i * np.abs(mu_o[:, 0]))
    expected = albedo * by_cosine(phase, -np.asarray(WO @ WI)) * collided
    np.testing.assert_allclose(values, expected, rtol=1e-10)


@each
def test_the_albedo_of_one_collision_is_the_mean_of_its_draws(phase):
    stack = lj.Stack([lj.Medium(1.3, 0.8, phase)])
    _, _, weight = lj.sample(stack, jnp.broadcast_to(WI, (DRAWS, 3)), jax.random.key(2), lj.SingleScattering())
    error = np.std(weight) / np.sqrt(DRAWS)
    assert abs(np.mean(weight) - np.sum(np.ravel(lj.albedo(stack, WI, lj.SingleScattering())))) < 4.0 * error


COATED = "Schlick twice, Rayleigh under a coat"
STACKS = {
    "Rayleigh on paint": lj.Stack([lj.Medium(1.0, 0.9, RAYLEIGH)], lj.Lambertian(0.4)),
    COATED: lj.Stack(
        [
            lj.Medium(0.6, 0.95, Schlick(0.5)),
            lj.Interface(1.4, 0.5),
            lj.Medium(0.7, 0.9, RAYLEIGH, 0.3),
            lj.Medium(0.5, 0.9, Schlick(-0.4)),
        ]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Rayleigh on paint", COATED])
def test_the_solver_agrees_with_the_walk(name):
    stack = STACKS[name]
    wo = WO[:3] if stack.base is not None else WO
    values, errors = lj.evaluate_with_error(stack, WI, wo, lj.RandomWalk(paths=1 << 14), key=jax.random.key(3))
    solved, coarse = lj.evaluate_with_error(stack, WI, wo, SOLVER)
    assert (errors < 0.04 * values).all()
    np.testing.assert_array_less(np.abs(values - solved), 4.0 * errors + coarse)


def both_sides(count):
    """Directions of light and view, from above and from below."""
    random = np.random.default_rng(4)
    theta, phi = np.arccos(random.uniform(-0.95, 0.95, (2, count))), random.uniform(0.0, 2.0 * np.pi, (2, count))
    return lj.direction(theta[0], phi[0]), lj.direction(theta[1], phi[1])


TILTED_SOLVER = lj.AddingDoubling(ordinates=(4, 8))


@pytest.mark.slow
@pytest.mark.parametrize("kind", IMITATED)
@pytest.mark.parametrize(
    "transport",
    [lj.SingleScattering(), TILTED_SOLVER, lj.RandomWalk(paths=2000)],
    ids=["SingleScattering", "AddingDoubling", "RandomWalk"],
)
def test_an_axis_that_leans_is_carried_as_the_built_in_it_imitates(transport, kind):
    """Draws of the two from one number differ by a turn about the light: a walk agrees within its errors alone."""
    wi, wo = both_sides(40)
    stacks = [lj.Stack([lj.Medium(0.8, 0.9, phase), lj.Medium(0.5, 0.9, RAYLEIGH)]) for phase in IMITATED[kind]]
    if not transport.random:
        values, imitated = (lj.evaluate(stack, wi, wo, transport) for stack in stacks)
        np.testing.assert_allclose(values, imitated, rtol=1e-9)
        return
    (values, errors), (imitated, others) = (
        lj.evaluate_with_error(stack, wi, wo, transport, key=jax.random.key(n)) for n, stack in enumerate(stacks)
    )
    apart = (values - imitated) / np.hypot(errors, others)
    assert np.abs(apart).max() < 5.0
    assert scipy.stats.chi2.sf(np.sum(apart**2), apart.size) > SIGNIFICANCE


@pytest.mark.slow
def test_three_axes_of_different_lengths():
    """What no built-in has: reciprocal, its draws carry its energy, and upside down it is its mirror image."""
    phase, (wi, wo) = ellipsoid(0.3, 0.6, 1.0), both_sides(200)
    stack = lj.Stack([lj.Medium(0.8, 0.9, phase), lj.Medium(0.5, 0.9, RAYLEIGH)])
    one = lj.SingleScattering()
    values = lj.evaluate(stack, wi, wo, one)
    np.testing.assert_allclose(values, lj.evaluate(stack, wo, wi, one), rtol=1e-10)
    turned = lj.Stack([stack.layers[1], lj.Medium(0.8, 0.9, phase.mirror())])
    flip = np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(values, lj.evaluate(turned, wi * flip, wo * flip, one), rtol=1e-10)
    _, _, weight = lj.sample(stack, jnp.broadcast_to(WI, (DRAWS, 3)), jax.random.key(2), one)
    error = np.std(weight) / np.sqrt(DRAWS)
    assert abs(np.mean(weight) - np.sum(np.ravel(lj.albedo(stack, WI, one)))) < 4.0 * error


@pytest.mark.slow
def test_the_solver_agrees_with_the_walk_on_three_axes():
    stack = lj.Stack([lj.Medium(0.8, 1.0, ellipsoid(0.5, 0.7, 1.0))])
    solver = lj.AddingDoubling(ordinates=(8, 16))
    near, far = lj.albedo(stack, WI, solver)
    lost = 1.0 - float(near[0] + far[0] + lj.unscattered(stack, WI)[0])
    assert abs(lost) < 2e-3
    values, errors = lj.evaluate_with_error(stack, WI, WO, lj.RandomWalk(paths=1 << 15), key=jax.random.key(3))
    solved, coarse = lj.evaluate_with_error(stack, WI, WO, solver)
    np.testing.assert_array_less(np.abs(values - solved), 4.0 * errors + coarse)


@pytest.mark.parametrize(
    "transport", [lj.SingleScattering(), pytest.param(lj.AddingDoubling(nodes=6, modes=6), marks=pytest.mark.slow)]
)
def test_derivatives_agree_with_differences(transport):
    def value(p):
        layers = [lj.Medium(p[0], p[1], RAYLEIGH), lj.Medium(p[2], 0.7, Schlick(p[3]))]
        return jnp.sum(lj.evaluate(lj.Stack(layers), WI, WO, transport))

    p, step = jnp.array([0.8, 0.9, 0.5, 0.3]), 1e-5
    gradient, at = jax.jit(jax.grad(value))(p), jax.jit(jax.vmap(value))
    differences = (at(p + step * jnp.eye(4)) - at(p - step * jnp.eye(4))) / (2.0 * step)
    np.testing.assert_allclose(gradient, differences, rtol=1e-7)


@pytest.mark.parametrize("transport", [lj.Statistical(), lj.SpongeCake()], ids=["Statistical", "SpongeCake"])
@pytest.mark.parametrize("phase", [RAYLEIGH, Schlick(0.5)], ids=["Rayleigh", "Schlick"])
def test_transports_of_some_kinds_say_so(transport, phase):
    name, kind = type(transport).__name__, type(phase).__name__
    absent = lj.Medium(0.0)  # layers keep the names that they were given
    with pytest.raises(ValueError, match=rf"layers\[1\]: {name} .* no {kind} medium \(.*AddingDoubling and RandomWalk"):
        lj.prepare(lj.Stack([absent, lj.Medium(1.0, 0.9, phase)], lj.Lambertian(0.5)), transport)


def test_a_range_of_ones_own():
    with pytest.raises(ValueError, match=r"Schlick\.k: 1 is outside \[-0\.99, 0\.99\]"):
        Schlick(1.0)
    assert lj.RANGES["Schlick.k"] == (-0.99, 0.99)
    with pytest.raises(ValueError, match=r"Medium\.phase: the class Rayleigh is not a HenyeyGreenstein"):
        lj.Medium(1.0, phase=lj.Rayleigh)


def test_numbers_of_a_phase_function_are_no_channels():
    class Table(Schlick):
        weights: jax.Array = None

    assert channel_count(lj.Stack([lj.Medium(1.0, [0.5, 0.6, 0.7], Table(0.5, jnp.ones(7)))])) == 3
