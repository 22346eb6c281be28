"""A map whose truth is known: roughness and thickness painted over a plate, and readings of every texel.

The plate is a coat whose roughness and thickness drift smoothly, with an emblem on it, a star in a ring: within it both
jump. All else is the same everywhere. It is read along 64 pairs of directions, with noise.
"""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.suite.coated_haze import PARAMETERS, stack_of

Floats = NDArray[np.float64]
Material = Literal["coat", "flakes"]

NOISE = 0.02
TOGETHER = 1024
"""Texels that are evaluated at once."""

ROUGHNESS, THICKNESS, SHARED = (0.08, 0.5), (0.2, 3.0), 0.3
"""What is painted lies within these; the albedo of the base is the same everywhere."""


class Painted(NamedTuple):
    """A map that was painted, and what is read of it.

    truth: of each free parameter, by its name in a fit, (H, W). values: (H, W, 64, 1), in 1/sr. stack: with `fits.Free`
    where the truth is to be found.
    """

    truth: dict[str, Floats]
    geometry: fits.Geometry
    values: Floats
    stack: lj.Stack
    noise: fits.Noise


def painted(
    shape: tuple[int, int],
    transport: Any = "auto",
    *,
    material: Material = "coat",
    noise: float = NOISE,
    seed: int = 0,
    shared: bool = False,
) -> Painted:
    """Paint a map and read it.

    Args:
        shape: texels along its two sides.
        transport: by which the readings are made; "auto" and an open resolution are chosen for `TOGETHER` texels.
        material: "coat": a rough dielectric over haze on a diffuse base, which takes all orders of scattering.
            "flakes": SGGX flakes on a diffuse base, which `SingleScattering` carries as well.
        noise: relative standard deviation of a reading.
        seed: of the noise.
        shared: whether the albedo of the base is free too, as one number for all texels.
    """
    names = NAMES[material]
    alpha, thickness = emblem(shape)
    geometry = readings()
    exact = values_of(_BUILD[material], alpha, thickness, geometry, transport)
    noisy = exact * (1.0 + noise * np.random.default_rng(seed).standard_normal(exact.shape))
    truth = dict(zip(names, (alpha, thickness), strict=True))
    base: Any = SHARED
    if shared:
        truth["base.albedo"], base = np.full(shape, SHARED), fits.Free(0.5, 0.0, 1.0, shared=True)
    return Painted(truth, geometry, noisy, _BUILD[material](*free(), base), fits.Noise(relative=noise))


def readings() -> fits.Geometry:
    """64 pairs of directions in the plane of incidence: 16 for each of four incidences, mirror and retro among them."""
    return fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-70.0, 81.0, 10.0))


def free() -> tuple[fits.Free, fits.Free]:
    """Roughness and thickness as a fit looks for them."""
    return fits.Free(0.2, 0.02, 1.0, fits.LogUniform()), fits.Free(1.0, 0.05, 10.0, fits.LogUniform())


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
    return _between(ROUGHNESS, rough), _between(THICKNESS, thick)


def values_of(
    build: Callable[..., lj.Stack], alpha: Floats, thickness: Floats, geometry: fits.Geometry, transport: Any
) -> Floats:
    """The BSDF of every texel along the directions, (..., N, 1), so many texels at once."""
    flat = np.stack([alpha.ravel(), thickness.ravel()])
    size = min(TOGETHER, flat.shape[1])
    parts = []
    for first in range(0, flat.shape[1], size):
        rows = np.minimum(np.arange(first, first + size), flat.shape[1] - 1)  # one program for all parts
        one, other = flat[:, rows]
        stack = build(one, other[:, None], SHARED)
        found = lj.evaluate(stack, geometry.wi[:, None], geometry.wo[:, None], transport, side="reflection")
        parts.append(np.moveaxis(np.asarray(found, np.float64), 0, 1)[: flat.shape[1] - first])
    return np.concatenate(parts).reshape(*alpha.shape, len(geometry), -1)


def _between(ends: tuple[float, float], share: Floats) -> Floats:
    low, high = ends
    return low * (high / low) ** share


def _coat(alpha: Any, thickness: Any, base: Any) -> lj.Stack:
    return stack_of({**PARAMETERS, "alpha": alpha, "thickness": thickness, "base": base})


def _flakes(alpha: Any, thickness: Any, base: Any) -> lj.Stack:
    return lj.Stack([lj.Medium(thickness, 0.8, lj.SGGX("surface", alpha), f0=0.5)], lj.Lambertian(base))


_BUILD: dict[Material, Callable[..., lj.Stack]] = {"coat": _coat, "flakes": _flakes}
NAMES: dict[Material, tuple[str, str]] = {
    "coat": ("layers[0].alpha", "layers[1].thickness"),
    "flakes": ("layers[0].phase.alpha", "layers[0].thickness"),
}
"""Of roughness and thickness, as fits call them."""
