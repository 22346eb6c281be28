"""Posteriors that are calibrated: which materials, readings and priors, and in what their posteriors are difficult."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import fits
import layerjax as lj
from benchmarks.studies.calibration import shared
from benchmarks.suite import coated_haze

HAZE = {
    "ior": fits.Free(1.5, 1.2, 2.0, fits.Normal(1.5, 0.07)),
    "alpha": fits.Free(0.3, 0.1, 0.9, fits.LogNormal(0.3, 0.25)),
    "thickness": fits.Free(1.0, 0.1, 10.0, fits.LogNormal(1.0, 0.4)),
    "g": fits.Free(0.5, -0.2, 0.95, fits.Normal(0.5, 0.1)),
}
"""Priors that end more than four standard deviations inside their bounds: no posterior leans on one."""

FLOOR = 1e-6


@dataclass(frozen=True)
class Case:
    """A kind of posterior.

    name: of the files. words: what the material is, a sentence or two. free: what is drawn and found, in the order of
    the problem's parameters. stack: of numbers or of `Free`, by name. noise: relative. errors: whether readings share
    errors as well, whose numbers are the last of `free`. scale: whether the factor of the calibration is one of `free`.
    """

    name: str
    words: str
    free: Mapping[str, fits.Free]
    labels: Mapping[str, str]
    stack: Callable[[Mapping[str, Any]], lj.Stack]
    transport: lj.Transport
    readings: fits.Geometry
    noise: float
    most_steps: int = 5000
    errors: bool = False
    scale: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def own(self) -> dict[str, fits.Free]:
        """What is free in the stack alone."""
        beside = {"scale", *(shared.FREE if self.errors else ())}
        return {name: free for name, free in self.free.items() if name not in beside}


def _haze(own: Mapping[str, Any]) -> lj.Stack:
    return coated_haze.stack_of({**coated_haze.PARAMETERS, **own})


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
    readings=coated_haze.readings(),
    noise=0.05,
    settings={"parameters": coated_haze.PARAMETERS},
)

ERRORS = Case(
    name="calibration-errors",
    words=HAZE_WORDS
    + """ Readings share errors of their logarithm as well, drawn from a
process whose numbers are drawn from their priors, by dense matrices; the fit finds these numbers.""",
    free=HAZE | shared.FREE,
    labels=LABELS | shared.LABELS,
    stack=_haze,
    transport=lj.AddingDoubling(nodes=6, modes=6),
    readings=coated_haze.readings(),
    noise=0.02,  # beside the errors: these are of logarithms, in which noise is not quite normal
    errors=True,
    settings={
        "parameters": coated_haze.PARAMETERS,
        "errors": {name: repr(free) for name, free in shared.FREE.items()},
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
    stack=lambda own: lj.Stack(
        [lj.Medium(own["thickness"], own["albedo"], lj.HenyeyGreenstein(own["g"]))], lj.Lambertian(0.0)
    ),
    transport=lj.SingleScattering(),
    readings=FEW,
    noise=0.2,
    most_steps=20000,
)

DEGENERATE = Case(
    name="calibration-degenerate",
    words="""\
Paint by an instrument whose calibration is unknown: the data depend on the product of albedo and factor alone, a ridge
without an end but the bounds.""",
    free={"albedo": fits.Free(0.5, 0.1, 1.0), "scale": fits.Free(1.0, 0.5, 2.0)},
    labels={"albedo": "albedo", "scale": "calibration"},
    stack=lambda own: lj.Stack([], lj.Lambertian(own["albedo"])),
    transport=lj.SingleScattering(),
    readings=FEW,
    noise=0.1,
    most_steps=20000,
    scale=True,
)

BOUNDED = Case(
    name="calibration-bounded",
    words="""\
A rough diffuse surface (Oren-Nayar) by few and noisy readings: roughness and albedo are known so badly that posteriors
lean on the bounds, 0 and 1, most of the time.""",
    free={"albedo": fits.Free(0.5, 0.0, 1.0), "roughness": fits.Free(0.5, 0.0, 1.0)},
    labels={"albedo": "albedo", "roughness": "roughness"},
    stack=lambda own: lj.Stack([], lj.OrenNayar(own["albedo"], own["roughness"])),
    transport=lj.SingleScattering(),
    readings=FEW,
    noise=0.5,
    most_steps=20000,
)

CASES = {
    "haze": ALL_ORDERS,
    "errors": ERRORS,
    "banana": BANANA,
    "degenerate": DEGENERATE,
    "bounded": BOUNDED,
}
"""By what the command line calls them."""
