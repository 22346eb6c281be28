"""A map whose truth is known: roughness and thickness painted over a plate, and measurements of every texel.

The plate is a coat whose roughness and thickness drift smoothly, with an emblem on it, a star in a ring: within it both
jump. All else is the same everywhere, unless two more numbers are painted, which drift alone. It is measured along 64
pairs of directions, with noise.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.suite.coated_haze import PARAMETERS, stack_of

Floats = NDArray[np.float64]
Material = Literal["coat", "flakes", "metal"]

NOISE = 0.02
TOGETHER = 1024
"""Texels that are evaluated at once."""

ROUGHNESS, THICKNESS, SHARED = (0.08, 0.5), (0.2, 3.0), 0.3
"""What is painted lies within these; the albedo of the base is the same everywhere."""


class Painted(NamedTuple):
    """A map that was painted, and its measurements.

    truth: of each free parameter, by its name in a fit, (H, W). values: (H, W, 64, 1), in 1/sr. stack: with `fits.Free`
    where the truth is to be found.
    """

    truth: dict[str, Floats]
    geometry: fits.Geometry
    values: Floats
    stack: lj.Stack
    noise: fits.Noise


class Number(NamedTuple):
    """A number that is painted.

    name: in a fit. low, high: what it lies within. free: as a fit looks for it.
    """

    name: str
    low: float
    high: float
    free: fits.Free


def painted(
    shape: tuple[int, int],
    transport: Any = "auto",
    *,
    material: Material = "coat",
    noise: float = NOISE,
    seed: int = 0,
    shared: bool = False,
    free: Literal[2, 4] = 2,
) -> Painted:
    """Paint a map and simulate its measurements.

    Args:
        shape: texels along its two sides.
        transport: of the simulation; "auto" or an unset resolution is chosen for `TOGETHER` texels.
        material: "coat": a rough dielectric over haze on a diffuse base, which takes all orders of scattering.
            "flakes": SGGX flakes on a diffuse base, which `SingleScattering` carries as well. "metal": a rough
            dielectric over a dye on metal, which `Statistical` carries.
        noise: relative standard deviation of a measurement.
        seed: random seed of the noise.
        shared: whether the albedo of the base is free too, as one number for all texels (of two numbers painted).
        free: how many numbers are painted; of four the last two are the index of the coat or the albedo of the flakes,
            and the albedo of the base or the roughness of the metal.
    """
    numbers = NUMBERS[material][:free]
    truth = dict(zip((one.name for one in numbers), wash(shape, numbers), strict=True))
    geometry = goniometer_slices()
    exact = values_of(_BUILD[material], [*truth.values()], geometry, transport)
    noisy = exact * (1.0 + noise * np.random.default_rng(seed).standard_normal(exact.shape))
    more: dict[str, Any] = {}
    if shared:
        truth["base.albedo"], more["base"] = np.full(shape, SHARED), fits.Free(0.5, 0.0, 1.0, same_for_all_texels=True)
    stack = _BUILD[material](*(one.free for one in numbers), **more)
    return Painted(truth, geometry, noisy, stack, fits.Noise(relative=noise))


def goniometer_slices() -> fits.Geometry:
    """64 pairs of directions in the plane of incidence: 16 for each of four incidences, mirror and retro among them."""
    return fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-70.0, 81.0, 10.0))


def emblem(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Roughness and thickness of the plate, `shape` each, within `ROUGHNESS` and `THICKNESS`."""
    down, across = (2.0 * (np.arange(size) + 0.5) / size - 1.0 for size in shape)
    y, x = np.meshgrid(down, across, indexing="ij")
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    star = radius < 0.42 + 0.2 * np.cos(5.0 * angle + 0.5 * math.pi)
    ring = np.abs(radius - 0.8) < 0.08
    drift = 0.5 + 0.25 * np.sin(2.0 * x + 0.7) + 0.25 * np.cos(3.0 * y - 1.3 * x)  # in [0, 1]
    ripple = 0.5 + 0.5 * np.sin(4.0 * y + 1.5 * np.sin(2.0 * x))
    rough = np.where(star, 0.35 * drift, np.where(ring, 0.6 + 0.4 * drift, 0.3 + 0.5 * drift))
    thick = np.where(star, 0.55 + 0.45 * ripple, np.where(ring, 0.3 * ripple, 0.2 + 0.5 * ripple))
    return _interpolated(ROUGHNESS, rough), _interpolated(THICKNESS, thick)


def wash(shape: tuple[int, int], numbers: Sequence[Number]) -> list[Floats]:
    """What is painted of each of two or four numbers, (H, W): the emblem, and two that drift."""
    down, across = (2.0 * (np.arange(size) + 0.5) / size - 1.0 for size in shape)
    y, x = np.meshgrid(down, across, indexing="ij")
    slanted = 0.5 + 0.5 * np.sin(1.7 * x + 2.3 * y + 0.4)
    waves = 0.5 + 0.25 * np.cos(3.1 * x - 0.8) + 0.25 * np.sin(2.2 * y + x)
    drifts = [one.low + (one.high - one.low) * share for one, share in zip(numbers[2:], (slanted, waves), strict=False)]
    return [*emblem(shape), *drifts]


def values_of(
    build: Callable[..., lj.Stack], maps: Sequence[Floats], geometry: fits.Geometry, transport: Any
) -> Floats:
    """The BSDF of every texel along the directions, (..., N, 1), so many texels at once."""
    flat = np.stack([one.ravel() for one in maps])
    size = min(TOGETHER, flat.shape[1])
    parts = []
    for first in range(0, flat.shape[1], size):
        rows = np.minimum(np.arange(first, first + size), flat.shape[1] - 1)  # one program for all parts
        stack = build(*flat[:, rows])
        found = lj.evaluate(stack, geometry.wi[:, None], geometry.wo[:, None], transport, side="reflection")
        parts.append(np.moveaxis(np.asarray(found, np.float64), 0, 1)[: flat.shape[1] - first])
    return np.concatenate(parts).reshape(*maps[0].shape, len(geometry), -1)


def _interpolated(ends: tuple[float, float], share: Floats) -> Floats:
    low, high = ends
    return low * (high / low) ** share


def _channel(number: Any) -> Any:
    """A map of what may differ by channel, with an axis for the one channel that there is."""
    return number[:, None] if isinstance(number, np.ndarray) else number


def _coat(alpha: Any, thickness: Any, ior: Any = PARAMETERS["ior"], base: Any = SHARED) -> lj.Stack:
    numbers = {"alpha": alpha, "thickness": _channel(thickness), "ior": ior, "base": _channel(base)}
    return stack_of(PARAMETERS | numbers)


def _flakes(alpha: Any, thickness: Any, albedo: Any = 0.8, base: Any = SHARED) -> lj.Stack:
    flakes = lj.Medium(_channel(thickness), _channel(albedo), lj.SGGX("surface", alpha), f0=0.5)
    return lj.Stack([flakes], lj.Lambertian(_channel(base)))


def _metal(alpha: Any, thickness: Any, ior: Any = 1.5, base: Any = 0.2) -> lj.Stack:
    return lj.Stack([lj.Interface(ior, alpha), lj.Medium(_channel(thickness), 0.0)], lj.Conductor(0.2, 3.9, base))


_BUILD: dict[Material, Callable[..., lj.Stack]] = {"coat": _coat, "flakes": _flakes, "metal": _metal}


def _logarithmic(start: float, low: float, high: float) -> fits.Free:
    return fits.Free(start, low, high, fits.LogUniform())


_ALPHA, _THICKNESS = _logarithmic(0.2, 0.02, 1.0), _logarithmic(1.0, 0.05, 10.0)

NUMBERS: dict[Material, tuple[Number, ...]] = {
    "coat": (
        # a box for which an emulator of all orders takes some thousand solutions
        Number("layers[0].alpha", *ROUGHNESS, _logarithmic(0.2, 0.05, 0.6)),
        Number("layers[1].thickness", *THICKNESS, _logarithmic(1.0, 0.1, 5.0)),
        Number("layers[0].ior", 1.4, 1.7, fits.Free(1.5, 1.3, 1.8)),
        Number("base.albedo", 0.2, 0.8, fits.Free(0.5, 0.0, 1.0)),
    ),
    "flakes": (
        Number("layers[0].phase.alpha", *ROUGHNESS, _ALPHA),
        Number("layers[0].thickness", *THICKNESS, _THICKNESS),
        Number("layers[0].albedo", 0.5, 0.9, fits.Free(0.7, 0.0, 1.0)),
        Number("base.albedo", 0.2, 0.8, fits.Free(0.5, 0.0, 1.0)),
    ),
    "metal": (
        Number("layers[0].alpha", *ROUGHNESS, _ALPHA),
        Number("layers[1].thickness", *THICKNESS, _THICKNESS),
        Number("layers[0].ior", 1.4, 1.7, fits.Free(1.5, 1.3, 1.8)),
        Number("base.alpha", 0.1, 0.4, _ALPHA),
    ),
}
"""What is painted of each material: roughness and thickness first."""

NAMES: dict[Material, tuple[str, str]] = {
    material: (numbers[0].name, numbers[1].name) for material, numbers in NUMBERS.items()
}
"""Parameter names of roughness and thickness in a fit."""
