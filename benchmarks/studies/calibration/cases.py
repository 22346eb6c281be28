"""The cases of the calibration: materials, geometry and priors, and what makes each posterior difficult."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import fits
import layerjax as lj
from benchmarks.studies.calibration import discrepancy
from benchmarks.suite import coated_haze

HAZE = {
    "ior": fits.Free(1.5, 1.2, 2.0, fits.Normal(1.5, 0.07)),
    "alpha": fits.Free(0.3, 0.1, 0.9, fits.LogNormal(0.3, 0.25)),
    "thickness": fits.Free(1.0, 0.1, 10.0, fits.LogNormal(1.0, 0.4)),
    "g": fits.Free(0.5, -0.2, 0.95, fits.Normal(0.5, 0.1)),
}
"""Priors that end more than four standard deviations inside their bounds: no posterior reaches one."""

FLOOR = 1e-6


@dataclass(frozen=True)
class Case:
    """A kind of posterior.

    name: of the files. words: what the material is, a sentence or two. free: what is drawn and fitted, in the order of
    the problem's parameters. stack: of numbers or of `Free`, by name. noise: relative. discrepancy: whether the data
    have a model discrepancy, whose parameters are the last of `free`. scale: whether the global scale is one of `free`.
    """

    name: str
    words: str
    free: Mapping[str, fits.Free]
    labels: Mapping[str, str]
    stack: Callable[[Mapping[str, Any]], lj.Stack]
    transport: lj.Transport
    geometry: fits.Geometry
    noise: float
    most_steps: int = 5000
    discrepancy: bool = False
    scale: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def of_stack(self) -> dict[str, fits.Free]:
        """The free parameters of the stack."""
        others = {"scale", *(discrepancy.FREE if self.discrepancy else ())}
        return {name: free for name, free in self.free.items() if name not in others}


def _haze(p: Mapping[str, Any]) -> lj.Stack:
    return coated_haze.stack_of({**coated_haze.PARAMETERS, **p})


HAZE_WORDS = """\
Rough interface over haze (albedo 0.95) over a diffuse base (albedo 0.3), all orders of scattering, by
`{transport}`. The data are simulated by the solver that fits them, at its resolution: this judges the
inference, [error-vs-time](error-vs-time.md) the solver."""

LABELS = {"ior": "index", "alpha": "roughness", "thickness": "thickness", "g": "asymmetry g"}

ALL_ORDERS = Case(
    name="calibration",
    words=HAZE_WORDS,
    free=HAZE,
    labels=LABELS,
    stack=_haze,
    transport=lj.AddingDoubling(nodes=6, modes=6),
    geometry=coated_haze.goniometer_slices(),
    noise=0.05,
    settings={"parameters": coated_haze.PARAMETERS},
)

DISCREPANCY = Case(
    name="calibration-discrepancy",
    words=HAZE_WORDS
    + """ The data have a model discrepancy as well: a Gaussian
process of their logarithm, drawn by dense matrices, with parameters that are drawn from their priors and fitted.""",
    free=HAZE | discrepancy.FREE,
    labels=LABELS | discrepancy.LABELS,
    stack=_haze,
    transport=lj.AddingDoubling(nodes=6, modes=6),
    geometry=coated_haze.goniometer_slices(),
    noise=0.02,  # small: the discrepancy is of logarithms, in which noise is not quite normal
    discrepancy=True,
    settings={
        "parameters": coated_haze.PARAMETERS,
        "discrepancy": {name: repr(free) for name, free in discrepancy.FREE.items()},
    },
)

FEW = fits.slices(incidence=(10.0, 50.0), outgoing=np.arange(-75.0, 76.0, 15.0))

BANANA = Case(
    name="calibration-banana",
    words="""\
A thin dust, single scattering: little is known but the product of thickness and albedo, a curved ridge that ends at
the bounds.""",
    free={
        "thickness": fits.Free(0.2, 0.02, 1.0),
        "albedo": fits.Free(0.5, 0.1, 1.0),
        "g": fits.Free(0.2, -0.6, 0.6),
    },
    labels={"thickness": "thickness", "albedo": "albedo", "g": "asymmetry g"},
    stack=lambda p: lj.Stack([lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))], lj.Lambertian(0.0)),
    transport=lj.SingleScattering(),
    geometry=FEW,
    noise=0.2,
    most_steps=20000,
)

DEGENERATE = Case(
    name="calibration-degenerate",
    words="""\
Paint by an instrument whose calibration is unknown: the data depend on the product of albedo and global scale alone, a
ridge that only the bounds end.""",
    free={"albedo": fits.Free(0.5, 0.1, 1.0), "scale": fits.Free(1.0, 0.5, 2.0)},
    labels={"albedo": "albedo", "scale": "scale"},
    stack=lambda p: lj.Stack([], lj.Lambertian(p["albedo"])),
    transport=lj.SingleScattering(),
    geometry=FEW,
    noise=0.1,
    most_steps=20000,
    scale=True,
)

BOUNDED = Case(
    name="calibration-bounded",
    words="""\
A rough diffuse surface (Oren-Nayar) with few and noisy measurements: roughness and albedo are identified so weakly that
most posteriors reach their bounds, 0 and 1.""",
    free={"albedo": fits.Free(0.5, 0.0, 1.0), "roughness": fits.Free(0.5, 0.0, 1.0)},
    labels={"albedo": "albedo", "roughness": "roughness"},
    stack=lambda p: lj.Stack([], lj.OrenNayar(p["albedo"], p["roughness"])),
    transport=lj.SingleScattering(),
    geometry=FEW,
    noise=0.5,
    most_steps=20000,
)

CASES = {
    "haze": ALL_ORDERS,
    "discrepancy": DISCREPANCY,
    "banana": BANANA,
    "degenerate": DEGENERATE,
    "bounded": BOUNDED,
}
"""The cases by their names on the command line."""
