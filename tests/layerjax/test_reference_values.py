"""SpongeCake section 4 against values that were computed without it."""

import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.cases import HEMISPHERES, POINTS, X, fiber_2, flakes

SINGLE = lj.SingleScattering()


@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-9), (jnp.float32, 1e-5)])
def test_point_values(name, dtype, tolerance):
    layers, incident, outgoing, expected = POINTS[name]
    wi, wo = (lj.direction(*angles).astype(dtype) for angles in (incident, outgoing))
    value = lj.evaluate(lj.Stack(layers()), wi, wo, SINGLE)
    assert value.shape == (1,)
    assert value.dtype == dtype
    np.testing.assert_allclose(value[0], expected, rtol=tolerance)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * name.startswith("three tilted")) for name in HEMISPHERES]
)
def test_hemispherical_values(name):
    layers, incident, *references = HEMISPHERES[name]
    wi = lj.direction(*incident)
    stack = lj.Stack(layers())
    own, other = lj.albedo(stack, wi, SINGLE, nodes=96)
    up, down = (own, other) if wi[2] > 0 else (other, own)
    for value, digits in zip((up, down, lj.unscattered(stack, wi)), references, strict=True):
        half_digit = 0.5 * 10.0 ** -len(digits.split(".")[1])  # what the printed digits leave open
        np.testing.assert_allclose(value[0], float(digits), rtol=1e-9, atol=half_digit)


def test_substrate_is_seen_through_the_media():
    # f_sub exp(-sum) for a Lambertian, by Beer's law alone: depths tau sigma / cos with sigma of an x fiber by hand
    stack = lj.Stack([flakes("fiber", 0.5, X, 1.0)], base=lj.Lambertian(0.5))
    bare = lj.Stack([flakes("fiber", 0.5, X, 1.0)])
    wi, wo = lj.direction(0.5, 0.3), lj.direction(0.8, 2.0)
    depth = 0.0
    for w in (np.asarray(wi), np.asarray(wo)):
        depth += np.sqrt(0.25 * w[0] ** 2 + w[1] ** 2 + w[2] ** 2) / w[2]
    expected = 0.5 / np.pi * np.exp(-depth)
    difference = lj.evaluate(stack, wi, wo, SINGLE) - lj.evaluate(bare, wi, wo, SINGLE)
    np.testing.assert_allclose(difference[0], expected, rtol=1e-10)


def test_substrate_energy():
    # Lambert 0.5 under fiber 0.5 (x axis), thickness 1, theta 0.5, phi 0.3: what the base alone reflects
    wi = lj.direction(0.5, 0.3)
    layers = [flakes("fiber", 0.5, X, 1.0)]
    with_base, transmitted = lj.albedo(lj.Stack(layers, lj.Lambertian(0.5)), wi, SINGLE, nodes=64)
    without, _ = lj.albedo(lj.Stack(layers), wi, SINGLE, nodes=64)
    np.testing.assert_allclose(with_base - without, _attenuated_lambertian(np.asarray(wi), 0.5, 0.5, 1.0), rtol=1e-7)
    assert transmitted[0] == 0.0


def test_an_opaque_base_ends_everything_below_it():
    stack = lj.Stack(fiber_2(), base=lj.Lambertian(1.0))
    above, below = lj.direction(0.5, 0.3), lj.direction(2.5, 0.3)
    for wi, wo in ((above, below), (below, above), (below, below)):
        assert lj.evaluate(stack, wi, wo, SINGLE)[0] == 0.0
    assert lj.unscattered(stack, above)[0] == 0.0


def test_the_lower_half_of_a_stack_is_the_upper_half_of_its_mirror_image():
    layers = [flakes("surface", 0.3, (0.4, 0.2, 0.9), 0.4), flakes("fiber", 0.2, (1.0, 0.5, 0.3), 0.6, 0.7, 0.2)]
    mirrored = [
        flakes("fiber", 0.2, (1.0, 0.5, -0.3), 0.6, 0.7, 0.2),
        flakes("surface", 0.3, (0.4, 0.2, -0.9), 0.4),
    ]
    flip = jnp.array([1.0, 1.0, -1.0])
    wi = lj.direction(jnp.array([0.5, 2.4, 2.4]), 1.0)
    wo = lj.direction(jnp.array([2.2, 1.1, 2.0]), 4.0)
    np.testing.assert_allclose(
        lj.evaluate(lj.Stack(layers), wi, wo, SINGLE),
        lj.evaluate(lj.Stack(mirrored), wi * flip, wo * flip, SINGLE),
        rtol=1e-13,
    )


def _attenuated_lambertian(wi, albedo, alpha, thickness):
    """Albedo of a Lambertian base under x fibers, by a product rule in numpy."""

    def through(x, y, z):
        return np.exp(-thickness * np.sqrt(alpha**2 * x**2 + y**2 + z**2) / z)

    s, w = np.polynomial.legendre.leggauss(200)
    z, w = 0.5 * (s + 1.0), 0.5 * w
    phi = np.arange(400) * 2 * np.pi / 400
    r = np.sqrt(1 - z**2)
    inner = through(r[:, None] * np.cos(phi), r[:, None] * np.sin(phi), z[:, None]).mean(axis=1)
    return through(*wi) * albedo * 2.0 * np.sum(w * z * inner)
