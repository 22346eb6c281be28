"""Energies counted by the analog walk, against published values, quadrature, and conservation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.surfaces.interface import interface_reflection, interface_transmission
from tests.helpers.cases import HEMISPHERES, fig7, flakes, haze, surface_3

KEY = jax.random.key(20)
PATHS = 50_000
INCIDENT = (0.5, 0.3)


def measure(stack, wi, **options):
    return lj.goniophotometer(stack, wi, key=KEY, **{"paths": PATHS, "polar": 2, "azimuth": 2, "orders": 2, **options})


def agree(found, error, expected, slack=0.0):
    np.testing.assert_array_less(np.abs(np.asarray(found) - expected), 4 * np.asarray(error) + slack)


@pytest.mark.slow
def test_milne_slabs():
    # isotropic and lossless, from the Milne equation
    def energies(tau, mu):
        wi = lj.direction(jnp.arccos(mu), 0.0)
        seen = measure(lj.Stack([lj.Medium(tau, phase=lj.SGGX("surface", 1.0))]), wi)
        return seen.albedo[:, 0], seen.albedo_error[:, 0], seen.unscattered, seen.orders[:, 0, 0], seen.orders_error

    for tau, mu, r, t, delta in (
        (1.0, 1.0, 0.3413288, 0.2907918, 0.3678794),
        (1.0, 0.5, 0.4983755, 0.3662892, 0.1353353),
        (5.0, 1.0, 0.7387212, 0.2545409, 0.0067379),
        (0.2, 0.3, 0.2489603, 0.2376226, 0.5134171),
    ):
        found, error, straight, single, single_error = energies(tau, mu)
        agree(found, error, [r, t])
        agree(straight, np.sqrt(delta * (1 - delta) / PATHS), delta)
        np.testing.assert_allclose(found.sum() + straight.sum(), 1.0, rtol=1e-12)  # every path leaves with all it had
        if (tau, mu) == (1.0, 1.0):
            agree(single, single_error[:, 0, 0], [0.1420154, 0.1061729])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layers", "up", "down"),
    [
        (fig7(), 0.3449, 0.2654),
        ([flakes("surface", 0.5, None, 5.0)], 0.4648, 0.1860),
        ([flakes("fiber", 0.5, (1.0, 0.0, 0.0), 1.0)], 0.1886, 0.1710),
    ],
)
def test_multiple_scattering_by_flakes(layers, up, down):
    seen = measure(lj.Stack(layers), lj.direction(*INCIDENT))  # of a walk with a standard error of 5e-4
    agree(seen.orders[:, 1, 0], np.hypot(seen.orders_error[:, 1, 0], 5e-4), [up, down])


@pytest.mark.parametrize(
    "name",
    [
        "flakes",
        "haze",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("fibers", "two flakes", "three tilted", "three tilted, from below")
        ),
    ],
)
def test_single_scattering(name):
    layers, direction, up, down, straight = HEMISPHERES[name]
    seen = measure(lj.Stack(layers()), lj.direction(*direction))
    upwards = 0 if direction[0] < np.pi / 2 else 1
    single, error = seen.orders[:, 0, 0], seen.orders_error[:, 0, 0]
    agree(single[upwards], error[upwards], float(up))
    agree(single[1 - upwards], error[1 - upwards], float(down))
    agree(seen.unscattered, seen.unscattered_error, float(straight))


# g, albedo, thickness, cosine; van de Hulst 1980 (tables 12, 35; p. 256, 424) and, last two, Wang, Jacques & Zheng 1995
PUBLISHED = [
    (0.0, 1.0, 1.0, 1.0, "R", 0.34133),
    (0.0, 1.0, 1.0, 1.0, "T", 0.65867),
    (0.5, 1.0, 1.0, 1.0, "T", 0.82389),
    (0.5, 0.9, 1.0, 1.0, "T", 0.73909),
    (0.75, 0.9, 1.0, 1.0, "T", 0.82792),
    (0.0, 0.99, 1.0, 0.5, "R", 0.48652),
    (0.0, 0.99, 1.0, 0.5, "T", 0.49163),
    (0.5, 0.99, 4.0, 0.5, "R", 0.61996),
    (0.5, 0.99, 4.0, 0.5, "T", 0.30605),
    (0.75, 0.9, 2.0, 1.0, "R", 0.09739),
    (0.75, 0.9, 2.0, 1.0, "T", 0.66096),
]


@pytest.mark.parametrize(("g", "albedo", "thickness", "cosine", "quantity", "expected"), PUBLISHED)
def test_published_slabs(g, albedo, thickness, cosine, quantity, expected):
    seen = measure(lj.Stack([haze(g, thickness, albedo)]), lj.direction(np.arccos(cosine), 0.0))
    side = 0 if quantity == "R" else 1
    value, variance = seen.albedo[side, 0], seen.albedo_error[side, 0] ** 2
    if quantity == "T":  # all of it, the unscattered part too
        value, variance = value + seen.unscattered[0], variance + seen.unscattered_error[0] ** 2
    agree(value, np.sqrt(variance), expected, slack=1e-5)


def directions_in_bins(seen, count, seed):
    """Directions drawn evenly from each bin of the upper and of the lower hemisphere, and the solid angle of a bin."""
    random = np.random.default_rng(seed)
    cosines, azimuths = np.asarray(seen.cosines), np.asarray(seen.azimuths)
    shape = (2, len(cosines) - 1, len(azimuths) - 1, count)
    z = cosines[:-1, None, None] + np.diff(cosines)[:, None, None] * random.random(shape)
    z = z * np.asarray([1, -1])[:, None, None, None]
    phi = azimuths[:-1, None] + np.diff(azimuths)[:, None] * random.random(shape)
    return lj.direction(jnp.arccos(z), phi), np.diff(cosines)[0] * np.diff(azimuths)[0]


COATED = {
    "two media": lj.Stack([haze(0.5, 0.7, [0.9, 0.5]), flakes("fiber", 0.4, (1, 0.3, 0.2), 0.5, 0.9, 0.1)]),
    "paint": lj.Stack([lj.Interface(1.5, 0.3), haze(0.5, 1.0, 0.9)], lj.Lambertian(0.8)),
    "haze on varnish": lj.Stack([haze(0.5, 0.5, 0.9), lj.Interface(1.5, 0.4), haze(0.3, 1.0, 0.9)]),
    "plate": lj.Stack([lj.Interface(1.5, 0.4), haze(0.5, 0.3, 0.9), lj.Interface(1.0, 0.5)]),
    "two coats on metal": lj.Stack(
        [lj.Interface(1.5, 0.4), haze(0.5, [0.2, 0.9], 0.9), lj.Interface(1.2, 0.5), haze(0.0, 0.3, 0.9)],
        lj.Conductor([0.2, 1.0], [3.9, 2.5], 0.4),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "facet_multiple_scattering", "count"),
    [
        ("two media", False, 400),
        ("paint", False, 400),
        ("paint", True, 400),
        ("haze on varnish", False, 400),
        ("plate", True, 400),
        ("two coats on metal", False, 400),
        ("two coats on metal", True, 400),
    ],
)
def test_bins_hold_the_integral_of_the_values(name, facet_multiple_scattering, count):
    # next-event estimates, integrated over the bins, against light that is merely followed
    stack = COATED[name]
    walk = lj.RandomWalk(paths=64, facet_multiple_scattering=facet_multiple_scattering)
    below = [lj.direction(2.4, 0.3)] if stack.base is None else []
    for wi in [lj.direction(*INCIDENT), *below]:
        seen = measure(stack, wi, facet_multiple_scattering=facet_multiple_scattering)
        wo, solid_angle = directions_in_bins(seen, count, 4)
        values = np.asarray(lj.evaluate(stack, wi, wo, walk, key=jax.random.key(3)))
        values = values * np.abs(np.asarray(wo))[..., 2:] * solid_angle
        mean, error = values.mean(axis=3), values.std(axis=3) / np.sqrt(values.shape[3])
        if wi[2] < 0:
            mean, error = mean[::-1], error[::-1]
        agree(seen.energy, np.hypot(seen.energy_error, error), mean, slack=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("ior", [1.5, 1 / 1.5, 3.0])
def test_energy_of_one_interface(ior):
    alpha = jnp.asarray(0.5)
    wi = lj.direction(0.9, 0.4)
    x, w = np.polynomial.legendre.leggauss(200)
    z, phi = 0.5 * (x + 1)[:, None], 2 * np.pi * (np.arange(400) + 0.5) / 400
    weight = 0.5 * w[:, None] * z * 2 * np.pi / 400
    wo = split(lj.direction(np.arccos(z), phi))
    up = np.sum(interface_reflection(split(wi), wo, ior, alpha) * weight)
    down = np.sum(interface_transmission(split(wi), (wo[0], wo[1], -wo[2]), jnp.asarray(ior), alpha) * weight)
    seen = measure(lj.Stack([lj.Interface(ior, alpha)]), wi)
    agree(seen.albedo[:, 0], seen.albedo_error[:, 0], [up, down], slack=1e-4)


@pytest.mark.parametrize("theta", [0.0, 1.0, 1.5, 2.2])
def test_white_furnace(theta):
    # microsurfaces that absorb nothing give everything back, however rough and however they are lit
    wi = lj.direction(theta, 0.3)
    for ior, alpha in ((1.5, 0.9), (0.6, 0.3), (2.5, 0.05)):
        seen = measure(lj.Stack([lj.Interface(ior, alpha)]), wi, paths=4000, facet_multiple_scattering=True)
        np.testing.assert_allclose(seen.albedo.sum(), 1.0, rtol=1e-12)
        np.testing.assert_allclose(seen.orders[:, 0].sum(), 1.0, rtol=1e-12)  # one visit is one event
    if wi[2] > 0:
        mirror = lj.Conductor(0.01, 20.0, 0.8)  # reflects 0.9999 and more
        seen = measure(lj.Stack([], mirror), wi, paths=4000, facet_multiple_scattering=True)
        assert 0.999 < float(seen.albedo[0, 0]) <= 1.0
        assert float(measure(lj.Stack([], mirror), wi, paths=4000).albedo[0, 0]) < 0.97


def test_sums_in_single_precision_do_not_drift():
    """Every path brings the same: 1e-5, where a plain sum of these is off by 1e-3."""
    with jax.enable_x64(False):
        wi = lj.direction(jnp.float32(0.5), jnp.float32(0.3))
        seen = measure(lj.Stack([], lj.Lambertian(0.3)), wi, paths=1 << 17, polar=1, azimuth=1)
    np.testing.assert_allclose([seen.albedo[0, 0], seen.energy[0, 0, 0, 0]], 0.3, rtol=1e-5)


def test_shapes_and_refusals():
    stack = lj.Stack(surface_3(), lj.Lambertian([0.2, 0.5, 0.8]))
    wi = lj.direction(jnp.asarray([0.2, 2.0]), 0.0)
    seen = lj.goniophotometer(stack, wi, key=KEY, paths=500, polar=3, azimuth=5, orders=4)
    assert seen.energy.shape == seen.energy_error.shape == (2, 2, 3, 5, 3)
    assert seen.orders.shape == (2, 2, 4, 3)
    assert seen.albedo.shape == (2, 2, 3)
    assert seen.unscattered.shape == (2, 3)
    assert seen.cosines.shape == (4,)
    assert seen.azimuths.shape == (6,)
    np.testing.assert_allclose(seen.energy.sum(axis=(2, 3)), seen.albedo, rtol=1e-12)
    np.testing.assert_allclose(seen.orders.sum(axis=2), seen.albedo, rtol=1e-12)
    assert not seen.albedo[1].any()  # light on an opaque base from below
    assert not seen.energy[0, 1].any()
    again = lj.goniophotometer(stack, wi, key=KEY, paths=500, polar=3, azimuth=5, orders=4)
    assert (again.energy == seen.energy).all()
    for bad in ({"paths": 1}, {"polar": 0}, {"azimuth": 0}, {"orders": 0}, {"facet_multiple_scattering": "none"}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            lj.goniophotometer(stack, wi, key=KEY, **bad)
