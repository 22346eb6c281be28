"""The materials whose parameters are maps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import layerjax as lj

Maps = dict[str, NDArray[Any]]
SEED = 19


@dataclass(frozen=True)
class Range:
    """What a parameter varies in from texel to texel, evenly; channels: 0 for a number that serves all of them."""

    low: float
    high: float
    channels: int = 0


@dataclass(frozen=True)
class Material:
    """A stack whose parameters are all maps, and the microseconds a texel that it may take at least, and should."""

    name: str
    ranges: Mapping[str, Range]
    build: Callable[[Mapping[str, Any]], lj.Stack]
    transport: lj.Transport
    least: float | None = None
    aim: float | None = None

    def maps(self, texels: int, precision: str) -> Maps:
        """A map of each parameter, (texels,) or (texels, channels)."""
        return maps_of(self.ranges, texels, precision)


def maps_of(ranges: Mapping[str, Range], texels: int, precision: str) -> Maps:
    """Maps of parameters that vary in these ranges."""
    generator = np.random.default_rng(SEED)
    found = {}
    for name, kind in ranges.items():
        shape = (texels, kind.channels) if kind.channels else (texels,)
        found[name] = generator.uniform(kind.low, kind.high, shape).astype(precision)
    return found


COAT = {"ior": Range(1.3, 1.8), "alpha": Range(0.05, 0.6)}
SECOND = {"second ior": Range(1.3, 1.8), "second alpha": Range(0.05, 0.6)}
METAL = {"metal": Range(0.2, 1.5, 3), "k": Range(2.0, 5.0, 3), "metal alpha": Range(0.05, 0.6)}
DIFFUSE = {"base": Range(0.1, 0.9, 3)}
DYE = {"dye": Range(0.1, 1.0, 3)}
HAZE = {"thickness": Range(0.1, 1.0, 3), "albedo": Range(0.5, 0.99, 3), "g": Range(0.5, 0.9)}


def _coat(p: Mapping[str, Any]) -> lj.Interface:
    return lj.Interface(p["ior"], p["alpha"])


def _second(p: Mapping[str, Any]) -> lj.Interface:
    return lj.Interface(p["second ior"], p["second alpha"])


def _metal(p: Mapping[str, Any]) -> lj.Conductor:
    return lj.Conductor(p["metal"], p["k"], p["metal alpha"])


def _haze(p: Mapping[str, Any]) -> lj.Medium:
    return lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))


MATERIALS = (
    Material(
        "interface over metal", COAT | METAL, lambda p: lj.Stack([_coat(p)], _metal(p)), lj.Statistical(), 0.5, 0.2
    ),
    Material(
        "interface over Lambertian",
        COAT | DIFFUSE,
        lambda p: lj.Stack([_coat(p)], lj.Lambertian(p["base"])),
        lj.Statistical(),
        0.5,
        0.2,
    ),
    Material(
        "three layers over metal",
        COAT | DYE | SECOND | METAL,
        lambda p: lj.Stack([_coat(p), lj.Medium(p["dye"], 0.0), _second(p)], _metal(p)),
        lj.Statistical(),
        2.0,
        1.0,
    ),
    Material(
        "hazy medium between interfaces",
        COAT | HAZE | SECOND,
        lambda p: lj.Stack([_coat(p), _haze(p), _second(p)]),
        lj.Statistical(),
        3.0,
        1.5,
    ),
    Material(
        "two interfaces over a diffuse base",
        COAT | SECOND | DIFFUSE,
        lambda p: lj.Stack([_coat(p), _second(p)], lj.Lambertian(p["base"])),
        lj.Statistical(),
        5.0,
        2.0,
    ),
    Material(
        "haze over metal, two lobes",
        HAZE | METAL,
        lambda p: lj.Stack([_haze(p)], _metal(p)),
        lj.SpongeCake(),
        1.0,
        None,
    ),
    Material(
        "haze over metal, first order", HAZE | METAL, lambda p: lj.Stack([_haze(p)], _metal(p)), lj.SingleScattering()
    ),
    Material(
        "interface over metal, 2007", COAT | METAL, lambda p: lj.Stack([_coat(p)], _metal(p)), lj.WeidlichWilkie()
    ),
    Material("interface over metal, one bounce", COAT | METAL, lambda p: lj.Stack([_coat(p)], _metal(p)), lj.ENDF()),
)
"""Those that have a bar, and what other transports take beside them."""

PRINCIPLED = {
    "base_color": Range(0.1, 0.9, 3),
    "roughness": Range(0.2, 0.8),
    "metallic": Range(0.0, 1.0),
    "clearcoat": Range(0.0, 1.0),
    "clearcoat_gloss": Range(0.0, 1.0),
}
"""Parameters of Mitsuba's BSDF of that name: a metal or a diffuse base, and a coat over either."""

CONDUCTOR = {"eta": METAL["metal"], "k": METAL["k"], "alpha": METAL["metal alpha"]}
"""Parameters of its rough metal."""
