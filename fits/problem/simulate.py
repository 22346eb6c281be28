"""Simulated goniometer data: a stack seen along slices, with noise of known size."""

import sys

import numpy as np

import layerjax as lj
from fits.data.geometry import Floats, Geometry, polar
from fits.data.measurements import SMALLEST_SIGMA, Measurements, Source, channel_names
from fits.problem.model import Transport, forward
from layerjax._checks import require_kind, require_number, require_seed
from layerjax.compiling import program_cache
from layerjax.mixture import stacks_of


@program_cache()
def simulate(
    stack: lj.Stack | lj.Mixture,
    geometry: Geometry,
    transport: Transport = "auto",
    noise: float = 0.0,
    floor: float = 0.0,
    seed: int = 0,
) -> Measurements:
    """The BSDF of a stack along `geometry`, with Gaussian noise of standard deviation sqrt((noise f)^2 + floor^2).

    Args:
        stack: holds numbers, nothing `Free`.
        geometry: N pairs of directions, from `slices` say.
        transport: as in `Problem`.
        noise: relative, in [0, 1] (0.05 is 5 %).
        floor: in 1/sr, >= 0.
        seed: of the noise.

    Returns:
        (N, C) values, and the deviation that was used as `sigma`, None if `noise` and `floor` are 0. Samples where the
        stack gives 0 and `floor` is 0 carry no noise, which no measurement does: they are masked.

    Raises:
        ValueError: a negative `noise` or `floor`, a light below an opaque stack, or a transport that is random or
            cannot carry the stack.
    """
    require_number("noise", noise, 0.0, 1.0)
    require_number("floor", floor, 0.0, sys.float_info.max)
    require_kind("geometry", geometry, Geometry, Measurements)
    require_seed(seed)
    require_visible("simulate", stack, light=geometry.wi)
    # evaluate picks the precision of the directions: float64 if the session has it turned on
    exact = np.asarray(forward(stack, geometry.wi, geometry.wo, transport), dtype=np.float64)
    sigma = np.hypot(noise * exact, floor)
    noisy = exact + sigma * np.random.default_rng(seed).standard_normal(exact.shape)
    notes = (f"noise: relative {noise:g}, floor {floor:g} 1/sr, seed {seed}",)
    known = noise > 0 or floor > 0
    mask = ~(known & np.any(sigma < SMALLEST_SIGMA, axis=1))
    source, channels = Source("", "simulated", "brdf", notes), channel_names(exact.shape[1])
    return Measurements(geometry.wi, geometry.wo, noisy, sigma if known else None, mask, channels, source)


def require_visible(subject: str, material: object, **directions: Floats) -> None:
    """Refuse directions of the subject in or below the surface of an opaque stack, whose BSDF is 0 there."""
    if not isinstance(material, lj.Stack | lj.Mixture) or any(one.base is None for one in stacks_of(material)):
        return
    for name, w in directions.items():
        lowest = float(polar(w).max(initial=0.0))
        if lowest >= 90.0:
            words = "sees nothing of an opaque stack; its polar angle must be in [0, 90) degrees"
            raise ValueError(f"{subject}: a {name} at {lowest:g} degrees {words}")
