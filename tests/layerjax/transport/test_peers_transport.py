"""Stacks against Mitsuba 3: `volpath` through slabs, `roughdielectric` and `roughconductor` alone.

Mitsuba knows nothing of layerjax; the translation is checked by itself, on single scattering, whose values are known.
"""

from math import pi

import jax
import numpy as np
import pytest

import layerjax as lj
from benchmarks.peers import functions as peers
from benchmarks.peers.mitsuba_volpath import Volpath, surface_values
from tests.helpers.cases import X, flakes, haze

TILTED = (0.4, 0.2, 0.9)
SINGLE = lj.SingleScattering()
MITSUBA_PATHS = 1 << 19
WALKS, SURFACE_WALKS = 1 << 17, 1 << 12
LEAST = 0.01
"""Differences that small are never an error; larger ones must be explained by noise."""

SLABS = {
    "haze": [haze(0.4, 0.8, 0.9)],
    "forward haze, thick": [haze(0.7, 5.0, 0.99)],
    "backward haze, in colour": [haze(-0.3, 0.8, [0.9, 0.5, 1.0])],
    "upright flakes": [flakes("surface", 0.3, None, 1.0, 0.9)],
    "tilted flakes": [flakes("surface", 0.4, TILTED, 1.0, 0.9)],
    "fibers in the plane": [flakes("fiber", 0.3, X, 1.5, 0.8)],
    "fibers over tilted flakes": [flakes("fiber", 0.3, X, 0.5, 0.9), flakes("surface", 0.4, TILTED, 1.0, 0.8)],
}
COATED = {
    "haze under an interface": lj.Stack([lj.Interface(1.5, 0.3), haze(0.4, 1.0, 0.9)]),
    "an interface in haze": lj.Stack([haze(0.4, 0.3, 0.9), lj.Interface(1.5, 0.3), haze(0.0, 1.0, 0.9)]),
    "a haze between interfaces": lj.Stack([lj.Interface(1.5, 0.3), haze(0.4, 1.0, 0.9), lj.Interface(1.0, 0.4)]),
    "a coat on a diffuse base": lj.Stack([lj.Interface(1.5, 0.3), haze(0.4, 0.5, 0.9)], lj.Lambertian([0.8, 0.4, 0.2])),
    "a Beckmann coat on a diffuse base": lj.Stack([lj.Interface(1.5, 0.3, "beckmann")], lj.Lambertian(0.6)),
    "a coat on brushed metal": lj.Stack([lj.Interface(1.5, 0.3)], lj.Conductor(0.2, 3.9, 0.2, alpha_y=0.5)),
    "a brushed coat on a diffuse base": lj.Stack(
        [lj.Interface(1.5, 0.2, alpha_y=0.5, tangent=pi / 2), haze(0.4, 0.5, 0.9)], lj.Lambertian([0.8, 0.4, 0.2])
    ),
    "a haze between brushed interfaces": lj.Stack(
        [
            lj.Interface(1.5, 0.3, alpha_y=0.5),
            haze(0.4, 1.0, 0.9),
            lj.Interface(1.0, 0.5, "beckmann", alpha_y=0.3),
        ]
    ),
    "flakes on metal": lj.Stack(
        [flakes("surface", 0.3, None, 0.5, 0.9)], lj.Conductor([0.2, 0.9, 1.5], [3.9, 2.4, 1.9], 0.3)
    ),
}
STACKS = {name: lj.Stack(layers) for name, layers in SLABS.items()} | COATED
ANGLES = np.array([(0.3, 0.1), (1.0, 2.5), (1.2, -1.0), (pi - 0.3, 3.0), (pi - 1.0, 2.5), (pi - 1.2, 0.5)])
INCIDENT = {"from above": (0.6, 0.2), "from below": (pi - 0.6, 0.2)}

TRANSPORTS = {
    # more azimuths than the default, which errs by up to 1.5 % where an axis is tilted
    "deterministic": lambda paths: lj.AddingDoubling(ordinates=(14, 32)),
    "walk": lambda paths: lj.RandomWalk(paths=paths),
}


@pytest.fixture(autouse=True, scope="module")
def mitsuba():
    reason = peers.why_not()
    if reason is not None:
        pytest.skip(reason)


def vector(theta, phi):
    return np.asarray(lj.direction(theta, phi))


def viewers(stack):
    return vector(*ANGLES[: 3 if stack.base is not None else None].T)


def lit_from(stack):
    return {name: vector(*angles) for name, angles in INCIDENT.items() if stack.base is None or name == "from above"}


@pytest.mark.peers
@pytest.mark.parametrize("name", SLABS)
def test_the_translation_keeps_the_first_order(name):
    stack = STACKS[name]
    for wi in lit_from(stack).values():
        scene = Volpath(stack, wi, order=1)
        value, error = scene.values(viewers(stack), MITSUBA_PATHS)
        expected = np.asarray(lj.evaluate(stack, wi, viewers(stack), SINGLE))
        assert np.all(np.abs(value - expected) < 4 * error + 1e-3 * expected)
        for (energy, uncertain), exact in zip(scene.energies(1 << 20), lj.albedo(stack, wi, SINGLE), strict=True):
            assert np.all(np.abs(energy - np.asarray(exact)) < 4 * uncertain + 1e-3 * np.asarray(exact))


@pytest.mark.peers
@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("name", STACKS)
def test_all_orders(name, transport):
    """Point values, and the energy that leaves on either side: Mitsuba's point values are noisy under an interface."""
    stack, solved = STACKS[name], TRANSPORTS[transport](WALKS)
    for wi in lit_from(stack).values():
        scene = Volpath(stack, wi)
        value, error = scene.values(viewers(stack), MITSUBA_PATHS)
        found, noise = evaluated(stack, wi, viewers(stack), solved)
        assert np.all(np.abs(found - value) <= np.maximum(4 * np.hypot(error, noise), LEAST * value))
        shares = lj.albedo(stack, wi, solved, key=jax.random.key(1))
        for (energy, uncertain), share in zip(scene.energies(1 << 20), map(np.asarray, shares), strict=True):
            # a path carries at most 1, so that its variance is at most that of a coin
            noise = np.sqrt(share * (1 - share) / WALKS) if isinstance(solved, lj.RandomWalk) else 0.0
            assert np.all(np.abs(share - energy) <= np.maximum(4 * np.hypot(uncertain, noise), LEAST * energy))


def evaluated(stack, wi, wo, transport):
    """Values and standard errors; a deterministic transport has none."""
    if isinstance(transport, lj.RandomWalk):
        values, errors = lj.evaluate_with_error(stack, wi, wo, transport, key=jax.random.key(0))
        return np.asarray(values), np.asarray(errors)
    values = np.asarray(lj.evaluate(stack, wi, wo, transport))
    return values, np.zeros_like(values)


SURFACES = {
    "dielectric, step up": (lj.Stack([lj.Interface(1.5, 0.2)]), ("above", "below")),
    "dielectric, step down": (lj.Stack([lj.Interface(0.7, 0.4)]), ("above", "below")),
    "Beckmann dielectric": (lj.Stack([lj.Interface(1.5, 0.3, "beckmann")]), ("above", "below")),
    "Beckmann conductor": (lj.Stack([], lj.Conductor(0.2, 3.9, 0.2, "beckmann")), ("above",)),
    "conductor": (lj.Stack([], lj.Conductor([0.2, 0.9, 1.5], [3.9, 2.4, 1.9], 0.2)), ("above",)),
    "brushed dielectric": (lj.Stack([lj.Interface(1.5, 0.15, alpha_y=0.5)]), ("above", "below")),
    "brushed dielectric, turned": (
        lj.Stack([lj.Interface(1.5, 0.15, alpha_y=0.5, tangent=(0.0, 1.0, 0.0))]),
        ("above", "below"),
    ),
    "brushed conductor": (lj.Stack([], lj.Conductor(0.2, 3.9, 0.5, alpha_y=0.1)), ("above",)),
    "brushed Beckmann conductor": (lj.Stack([], lj.Conductor(0.2, 3.9, 0.5, "beckmann", alpha_y=0.2)), ("above",)),
}


@pytest.mark.peers
@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("name", SURFACES)
def test_single_surfaces(name, transport):
    """Mitsuba computes in float32, with a difference of squares near the critical angle: hence the floor of 1e-3."""
    stack, sides = SURFACES[name]
    random = np.random.default_rng(3)
    z, phi = random.uniform(0.1, 1.0, (2, 64)), random.uniform(-pi, pi, (2, 64))
    wi, wo = vector(np.arccos(z), phi)
    flip = np.array([1.0, 1.0, -1.0])
    for light in (wi, wi * flip)[: len(sides)]:
        for viewer in (wo, wo * flip)[: len(sides)]:
            expected = surface_values(stack, light, viewer)
            found, noise = evaluated(stack, light, viewer, TRANSPORTS[transport](SURFACE_WALKS))
            tolerance = np.maximum(4 * noise, LEAST * np.maximum(expected, 0.1 * expected.max()))
            assert expected.max() > 0
            assert np.all(np.abs(found - expected) <= tolerance)


SMOOTH = {
    "smooth coat on a diffuse base": lj.Stack([lj.Interface(1.5), haze(0.4, 0.5, 0.9)], lj.Lambertian([0.8, 0.4, 0.2])),
    "smooth coat on rough metal": lj.Stack([lj.Interface(1.5)], lj.Conductor([0.2, 0.9, 1.5], [3.9, 2.4, 1.9], 0.3)),
    "rough coat on a mirror": lj.Stack([lj.Interface(1.5, 0.3), haze(0.4, 0.5, 0.9)], lj.Conductor(0.2, 3.9)),
    "haze between smooth faces": lj.Stack([lj.Interface(1.5), haze(0.4, 1.0, 0.9), lj.Interface(1.0)]),
    "haze between faces, one rough": lj.Stack([lj.Interface(1.3), haze(0.4, 1.0, 0.9), lj.Interface(1.0, 0.3)]),
}
CONE = 0.2


@pytest.mark.peers
@pytest.mark.parametrize("transport", ["deterministic", "walk"])
@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_surfaces(name, transport):
    """Means over a cone of light, away from the delta directions; no path of Mitsuba finds a single one."""
    stack = SMOOTH[name]
    solved = {"deterministic": lj.AddingDoubling(), "walk": lj.RandomWalk(paths=1 << 15)}[transport]
    for wi in lit_from(stack).values():
        scene, viewer = Volpath(stack, wi, cone=CONE, roulette=50), viewers(stack)
        value, error = scene.values(viewer, 1 << 20)
        lights, weight = cone_of(wi)
        found, noise = evaluated(stack, lights[:, None], viewer, solved)
        mean = np.tensordot(weight, found, 1)
        noise = np.sqrt(np.tensordot(weight**2, noise**2, 1))
        assert np.all(np.abs(mean - value) <= np.maximum(4 * np.hypot(error, noise), LEAST * value))


def cone_of(wi):
    """Directions of the cone about wi and their shares of its light, by Gauss points in the squared sine."""
    x, w = np.polynomial.legendre.leggauss(5)
    polar = np.arcsin(np.sin(CONE) * np.sqrt(0.5 * (1 + x)))
    phi = 2 * pi * (np.arange(8) + 0.5) / 8
    about = np.cross(wi, [0.3, 0.9, 0.1])
    about /= np.linalg.norm(about)
    beside = np.cross(wi, about)
    turned = np.cos(phi)[:, None] * about + np.sin(phi)[:, None] * beside
    found = np.cos(polar)[:, None, None] * wi + np.sin(polar)[:, None, None] * turned
    cosine = np.abs(found[..., 2])
    # the disc has the same radiance everywhere, and is seen across wi
    share = (0.5 * w[:, None] / np.cos(polar)[:, None]) * cosine / abs(wi[2])
    return found.reshape(-1, 3), share.ravel() / phi.size
