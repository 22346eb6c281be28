"""fits: recover the parameters of a layered material, with their uncertainty, from BRDF measurements.

Names are imported when they are first used: `import fits` loads neither arviz, matplotlib nor a solver.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits.compare import Comparison as Comparison
    from fits.compare import compare as compare
    from fits.fit_result import Fit as Fit
    from fits.formats import read as read
    from fits.formats.csv import write_csv as write_csv
    from fits.geometry import Geometry as Geometry
    from fits.geometry import slices as slices
    from fits.identifiability import Combination as Combination
    from fits.likelihood import Noise as Noise
    from fits.measurements import Measurements as Measurements
    from fits.optimise import fit as fit
    from fits.parameters import Free as Free
    from fits.parameters import LogNormal as LogNormal
    from fits.parameters import LogUniform as LogUniform
    from fits.parameters import Normal as Normal
    from fits.parameters import Uniform as Uniform
    from fits.posterior import Posterior as Posterior
    from fits.posterior import sample as sample
    from fits.problem import Problem as Problem
    from fits.report import report as report
    from fits.results import load_fit as load_fit
    from fits.results import load_posterior as load_posterior
    from fits.results import save_fit as save_fit
    from fits.simulate import simulate as simulate
    from fits.stack_file import read_problem as read_problem
    from fits.stack_file import write_problem as write_problem

_HOMES = {
    "Comparison": "compare",
    "compare": "compare",
    "Fit": "fit_result",
    "read": "formats",
    "write_csv": "formats.csv",
    "Geometry": "geometry",
    "slices": "geometry",
    "Combination": "identifiability",
    "Noise": "likelihood",
    "Measurements": "measurements",
    "fit": "optimise",
    "Free": "parameters",
    "LogNormal": "parameters",
    "LogUniform": "parameters",
    "Normal": "parameters",
    "Uniform": "parameters",
    "Posterior": "posterior",
    "sample": "posterior",
    "Problem": "problem",
    "report": "report",
    "load_fit": "results",
    "load_posterior": "results",
    "save_fit": "results",
    "simulate": "simulate",
    "read_problem": "stack_file",
    "write_problem": "stack_file",
}

__all__ = list(_HOMES)


class _Package(ModuleType):
    """Keeps `fits.compare` and its like the functions that they are: importing a submodule would bind its name here."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'fits' has no attribute {name!r}")
    return getattr(importlib.import_module(f"fits.{_HOMES[name]}"), name)
