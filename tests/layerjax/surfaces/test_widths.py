"""Facets of two widths: normals by quadrature, energies by draws in numpy, symmetries, samplers, transports.

Values beside Mitsuba's are in `tests/layerjax/transport/test_peers_transport.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.normals import facets
from layerjax.normals.widths import Widths
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from tests.helpers.derivatives import with_slopes
from tests.helpers.interfaces import pairs, sphere
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

KINDS = ["ggx", "beckmann"]
BRUSHED = Widths(jnp.asarray(0.3), jnp.asarray(0.7), jnp.asarray(0.4))
MIRROR = (0.01, 20.0)
COARSE = lj.AddingDoubling(ordinates=(6, 8))


def metal(alpha, alpha_y, tangent=None, kind="ggx"):
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha, kind, alpha_y=alpha_y, tangent=tangent))


def coated(alpha=0.3, alpha_y=0.5, tangent=0.4):
    return lj.Stack(
        [lj.Interface(1.5, alpha, alpha_y=alpha_y, tangent=tangent)], lj.Conductor(0.2, 3.0, 0.4, alpha_y=0.3)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_they_are_normalised_and_masking_conserves_area(kind):
    m, weight = sphere(600)
    density = np.where(m[..., 2] > 0, facets.density(split(jnp.asarray(m)), BRUSHED, kind), 0.0)
    np.testing.assert_allclose(np.sum(density * m[..., 2] * weight), 1.0, rtol=1e-9)
    for theta, phi in ((0.2, 0.3), (0.9, 1.5), (1.4, -2.0), (1.55, 0.4)):
        w = np.asarray(lj.direction(theta, phi))
        visible = np.sum(np.maximum(m @ w, 0.0) * density * weight)
        found = facets.masking(split(jnp.asarray(w)), BRUSHED, kind)
        np.testing.assert_allclose(found * visible, w[2], rtol=1e-6)  # the kink at m.w = 0 limits the rule


@pytest.mark.parametrize("kind", KINDS)
def test_slopes_along_and_across_are_as_wide_as_they_say(kind):
    """P(slope along the tangent, slope across) of Walter et al. 2007, each over its own width."""
    p, q, tangent = 0.2, -0.5, 0.4
    slopes = np.cos(tangent) * p - np.sin(tangent) * q, np.sin(tangent) * p + np.cos(tangent) * q
    m = np.array([-slopes[0], -slopes[1], 1.0]) / np.sqrt(1 + p * p + q * q)
    squared = (p / 0.3) ** 2 + (q / 0.7) ** 2
    expected = np.exp(-squared) if kind == "beckmann" else (1 + squared) ** -2
    found = facets.density(split(jnp.asarray(m)), BRUSHED, kind)
    np.testing.assert_allclose(found, expected / (np.pi * 0.3 * 0.7) / m[2] ** 4, rtol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_equal_widths_are_one_width(kind):
    wi, wo = lj.direction(0.7, 0.3), lj.direction(np.array([0.2, 0.6, 1.4]), np.array([3.0, 1.0, 3.4]))
    one, two = metal(0.3, None, kind=kind), metal(0.3, 0.3, 1.0, kind)
    assert np.array_equal(lj.evaluate(one, wi, wo), lj.evaluate(two, wi, wo))
    face = lj.Stack([lj.Interface(1.5, 0.3, kind, alpha_y=0.3)], lj.Lambertian(0.5))
    plain = lj.Stack([lj.Interface(1.5, 0.3, kind)], lj.Lambertian(0.5))
    assert np.array_equal(lj.evaluate(face, wi, wo), lj.evaluate(plain, wi, wo))
    # traced they are two, and the same to rounding
    traced = jax.jit(lambda width: lj.evaluate(metal(0.3, width, 1.0, kind), wi, wo))(jnp.asarray(0.3))
    np.testing.assert_allclose(traced, lj.evaluate(one, wi, wo), rtol=1e-12)


def test_swapped_widths_are_a_quarter_turn():
    wi, wo = lj.direction(0.7, 0.3), lj.direction(np.array([0.2, 0.6, 1.4]), np.array([3.0, 1.0, 3.4]))
    found = lj.evaluate(metal(0.2, 0.5, 0.3), wi, wo)
    np.testing.assert_allclose(lj.evaluate(metal(0.5, 0.2, 0.3 - np.pi / 2), wi, wo), found, rtol=1e-12)
    quarter = np.pi / 2
    turned = [lj.direction(theta, phi + quarter) for theta, phi in (lj.angles(wi), lj.angles(wo))]
    np.testing.assert_allclose(lj.evaluate(metal(0.5, 0.2, 0.3), *turned), found, rtol=1e-12)
    # a vector says the same as an azimuth, whatever its length and its part along the normal
    along = (3.0 * np.cos(0.3), 3.0 * np.sin(0.3), 1.0)
    np.testing.assert_allclose(lj.evaluate(metal(0.2, 0.5, along), wi, wo), found, rtol=1e-12)


def test_a_map_has_a_tangent_for_every_texel():
    wi, wo, turns = lj.direction(0.7, 0.3), lj.direction(0.6, 3.0), np.linspace(-1.0, 1.0, 4)
    found = lj.evaluate(metal(0.2, 0.5, jnp.asarray(turns)), wi, wo)
    expected = [lj.evaluate(metal(0.2, 0.5, turn), wi, wo) for turn in turns]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def masking(w, widths):
    """Smith's G1 of GGX slopes (Heitz 2014, Eq. 72 and 86), in numpy."""
    squared = ((widths[0] * w[..., 0]) ** 2 + (widths[1] * w[..., 1]) ** 2) / w[..., 2] ** 2
    return 2.0 / (1.0 + np.sqrt(1.0 + squared))


def test_energies_of_a_conductor_are_those_of_draws():
    """GGX slopes are drawn in numpy, stretched, and weighed by what is seen."""
    u, phi = np.random.default_rng(7).random((2, 400_000)) * [[1.0], [2.0 * np.pi]]
    radius = np.sqrt(u / (1.0 - u))
    for theta, azimuth, widths in ((0.0, 0.0, (0.3, 0.6)), (1.2, 0.5, (0.1, 0.4)), (1.3, 2.0, (0.6, 0.2))):
        p, q = widths[0] * radius * np.cos(phi), widths[1] * radius * np.sin(phi)
        m = np.stack([-p, -q, np.ones_like(p)], axis=-1) / np.sqrt(1.0 + p * p + q * q)[:, None]
        wi = np.asarray(lj.direction(theta, azimuth))
        c = m @ wi
        up = 2.0 * c[:, None] * m - wi
        seen = np.maximum(c, 0.0) / m[:, 2] / wi[2] * masking(wi, widths)
        leaves = np.where(up[:, 2] > 0, masking(np.where(up[:, 2:] > 0, up, [0.0, 0.0, 1.0]), widths), 0.0)
        cosine = np.maximum(c, 1e-9)
        root = np.sqrt((MIRROR[0] + 1j * MIRROR[1]) ** 2 - 1.0 + cosine**2)
        index = (MIRROR[0] + 1j * MIRROR[1]) ** 2
        level = 0.5 * (
            np.abs((cosine - root) / (cosine + root)) ** 2
            + np.abs((index * cosine - root) / (index * cosine + root)) ** 2
        )
        part = seen * level * leaves
        stack = lj.Stack([], lj.Conductor(*MIRROR, widths[0], alpha_y=widths[1]))
        found, _ = lj.albedo(stack, wi)
        assert abs(found[0] - part.mean()) < 4.0 * part.std() / np.sqrt(part.size) + 3e-4


@pytest.mark.parametrize(
    ("kind", "theta"), [("ggx", 0.7), pytest.param("ggx", 1.5, marks=pytest.mark.slow), ("beckmann", 1.2)]
)
def test_a_conductor_is_sampled_as_it_says(kind, theta):
    stack = lj.Stack([], lj.Conductor(*MIRROR, 0.3, kind, alpha_y=0.8, tangent=0.5))
    wi = lj.direction(theta, 0.4)
    wo, _, weight = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(11))
    above = wo[:, 2] > 0
    probability, total = chi_square(wo[above], lambda w: jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w), 0.0))
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, np.mean(above), atol=5e-3)
    energy, _ = lj.albedo(stack, wi)
    assert abs(np.mean(weight) - energy[0]) < 4.5 * np.std(weight) / np.sqrt(DRAWS) + 3e-4
    assert weight.max() < 1.0 + 1e-9  # normals are drawn as they are seen: what is left is masking, and Fresnel's share


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_draws_and_slopes_are_finite(dtype, kind):
    random = np.random.default_rng(8)
    ends = [1e-4, 0.01, 0.3, 1.0]
    wi, wo, ior, alpha = pairs(random, 2000, ends, dtype)
    across, tangent = random.choice(ends, 2000).astype(dtype), random.uniform(-3, 3, 2000).astype(dtype)
    u = tuple(random.choice([0.0, 1.0 - 1e-7, *random.random(200)], (3, 2000)).astype(dtype))

    def everything(wi, wo, ior, alpha, across, tangent, u):
        below, widths = (wo[0], wo[1], -wo[2]), Widths(alpha, across, tangent)
        reflected = interface_reflection(wi, wo, ior, widths, kind)
        passed = interface_transmission(wi, below, ior, widths, kind)
        drawn, _ = interface_sample(wi, ior, widths, *u, kind)
        return jnp.stack([reflected, passed, interface_pdf(reflected, wi, wo, ior, widths, kind), *drawn])

    checked = jax.jit(jax.vmap(with_slopes(everything, (0, 1, 2, 3, 4, 5), "forward")))
    values, slopes = checked(wi, wo, ior, alpha, across, tangent, u)
    for leaf in jax.tree.leaves((values, slopes)):
        assert np.isfinite(leaf).all()
    assert (values[:, :3] >= 0).all()


def test_slopes_are_differences():
    wi, wo = lj.direction(0.7, 0.2), lj.direction(0.5, 2.9)

    def values(numbers):
        f = lj.evaluate(metal(*numbers), wi, wo)[0]
        m = facets.sample(split(wi), Widths(*numbers), jnp.asarray(0.3), jnp.asarray(0.8), "ggx")
        return jnp.stack([f, *m])

    at, step = jnp.array([0.2, 0.5, 0.3]), 1e-6
    found = jax.jit(jax.jacfwd(values))(at)
    expected = jnp.stack([(values(at + unit) - values(at - unit)) / (2 * step) for unit in step * jnp.eye(3)], axis=-1)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_the_solver_is_reciprocal_and_turns_with_the_stack():
    wi, wo = lj.direction(0.6, 0.3), lj.direction(np.array([0.3, 1.0]), np.array([2.0, 4.0]))
    found = lj.evaluate(coated(), wi, wo, COARSE)
    np.testing.assert_allclose(lj.evaluate(coated(), wo, wi, COARSE), found, rtol=1e-9)
    # by an azimuth of the grid nothing changes
    step = 2.0 * np.pi / 8
    turned = lj.Stack(
        [lj.Interface(1.5, 0.3, alpha_y=0.5, tangent=0.4 + step)],
        lj.Conductor(0.2, 3.0, 0.4, alpha_y=0.3, tangent=step),
    )
    around = [lj.direction(theta, phi + step) for theta, phi in (lj.angles(wi), lj.angles(wo))]
    np.testing.assert_allclose(lj.evaluate(turned, *around, COARSE), found, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_the_solver_are_differences(mode):
    wi, wo = lj.direction(0.6, 0.3), lj.direction(0.8, 2.0)

    def value(numbers):
        return lj.evaluate(coated(*numbers), wi, wo, lj.AddingDoubling(ordinates=(10, 16)))[0]

    at, step = jnp.array([0.3, 0.5, 0.4]), 1e-5
    expected = [(value(at + unit) - value(at - unit)) / (2 * step) for unit in step * jnp.eye(3)]
    # sums over facets have kinks where one reaches the horizon: 1e-3 of what a value changes with a width
    np.testing.assert_allclose(mode(value)(at), expected, rtol=1e-3, atol=1e-3 * float(value(at)) / 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([lj.Interface(1.5, 0.2, alpha_y=0.6, tangent=0.7)], lj.Lambertian(0.7)),
        lj.Stack(
            [lj.Interface(1.5, 0.2, alpha_y=0.5), lj.Medium(0.5, 0.9, lj.HenyeyGreenstein(0.5))],
            lj.Conductor(0.2, 3.0, 0.4, "beckmann", alpha_y=0.2, tangent=0.5),
        ),
        lj.Stack([lj.Interface(1.5, 0.3, alpha_y=0.5), lj.Interface(1.0, 0.4, "beckmann", alpha_y=0.3, tangent=0.7)]),
        lj.Stack([lj.Interface(1.5)], lj.Conductor(0.2, 3.0, 0.5, alpha_y=0.25, tangent=0.5)),
    ],
    ids=["paint", "hazy metal", "slab", "smooth lacquer on brushed metal"],
)
def test_solver_and_walk_agree(stack):
    wi = lj.direction(0.6, 0.4)
    theta, phi = np.array([0.3, 0.6, 1.2]), np.array([2.5, 3.0, 0.5])
    wo = lj.direction(theta if stack.base is not None else np.pi - theta, phi)
    exact, doubt = lj.evaluate_with_error(stack, wi, wo, lj.AddingDoubling(ordinates=(12, 20)))
    mean, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=60_000), key=jax.random.key(0))
    assert np.all(np.abs(exact - mean) < 4.0 * error + doubt)
    assert np.all(doubt < 0.1 * exact)


def test_what_it_cannot_be_is_refused_by_name():
    stack = lj.Stack([lj.Interface(1.5, 0.3, alpha_y=0.4)], lj.Lambertian(0.6))
    for transport in (lj.ENDF(), lj.WeidlichWilkie(), lj.AddingDoubling(facet_multiple_scattering=True)):
        with pytest.raises(ValueError, match=r"layers\[0\]\.alpha_y: .* carries no facets of two widths; Adding"):
            lj.prepare(stack, transport)
    with pytest.raises(ValueError, match=r"Interface\.alpha_y: 2 is outside \[0\.0001, 1\]"):
        lj.Interface(1.5, 0.1, alpha_y=2.0)
    with pytest.raises(ValueError, match=r"Interface\.alpha_y: given without alpha"):
        lj.Interface(1.5, alpha_y=0.2)
    with pytest.raises(ValueError, match=r"Conductor\.tangent: given without alpha_y"):
        lj.Conductor(0.2, 3.0, 0.1, tangent=0.3)
    with pytest.raises(ValueError, match=r"Conductor\.tangent: \(0, 0, 1\) has no part in the plane"):
        lj.Conductor(0.2, 3.0, 0.1, alpha_y=0.3, tangent=(0, 0, 1))
    with pytest.raises(ValueError, match=r"Interface\.tangent: \[0\.1, 0\.2\] is neither an azimuth nor a vector"):
        lj.Interface(1.5, 0.1, alpha_y=0.3, tangent=[0.1, 0.2])
    with pytest.raises(ValueError, match=r'Interface\.alpha_y: "vmf" normals have one width'):
        lj.Interface(1.5, 0.1, "vmf", alpha_y=0.3)
