"""A rough coat over haze on a diffuse base, and slices of a goniometer: what all orders are fitted to and timed on."""

from collections.abc import Mapping
from typing import Any

import fits
import layerjax as lj

PARAMETERS = {"ior": 1.5, "alpha": 0.3, "thickness": 1.0, "albedo": 0.95, "g": 0.5, "base": 0.3}
"""Index and roughness of the interface; thickness, albedo and asymmetry of the haze; albedo of the base."""

INCIDENCE = (10.0, 30.0, 50.0, 70.0)


def stack_of(parameters: Mapping[str, Any] = PARAMETERS) -> lj.Stack:
    """The material; parameters by name, numbers (traced or not) or `fits.Free`."""
    p = parameters
    haze = lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))
    return lj.Stack([lj.Interface(p["ior"], p["alpha"]), haze], lj.Lambertian(p["base"]))


def goniometer_slices() -> fits.Geometry:
    """140 pairs of directions in the plane of incidence, 35 for each of four incidences."""
    return fits.slices(incidence=INCIDENCE)


FREE = {
    "ior": fits.Free(1.4, 1.2, 2.0),
    "alpha": fits.Free(0.4, 0.05, 1.0, fits.LogUniform()),
    "thickness": fits.Free(0.5, 0.05, 20.0, fits.LogUniform()),
    "albedo": fits.Free(0.9, 0.5, 1.0),
    "g": fits.Free(0.3, -0.5, 0.95),
    "base": fits.Free(0.5, 0.0, 1.0),
}
"""All six of them, in wide boxes."""
