"""fits: recover the parameters of a layered material, with their uncertainty, from BRDF measurements.

Names are imported when they are first used: `import fits` loads neither arviz, matplotlib nor a solver.
"""

import ast
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fits.any_report import report as report
    from fits.batch import FittedFiles as FittedFiles
    from fits.batch import fit_files as fit_files
    from fits.data.formats.csv import write_csv as write_csv
    from fits.data.formats.rxt import Slab as Slab
    from fits.data.formats.rxt import read_slab as read_slab
    from fits.data.geometry import Geometry as Geometry
    from fits.data.geometry import slices as slices
    from fits.data.measurements import Measurements as Measurements
    from fits.data.reading import ReadOptions as ReadOptions
    from fits.data.reading import read as read
    from fits.data.spheres import Sphere as Sphere
    from fits.data.spheres import Spheres as Spheres
    from fits.data.totals import Totals as Totals
    from fits.exports.export import ExportReport as ExportReport
    from fits.exports.export import export as export
    from fits.maps.fit_map import fit_map as fit_map
    from fits.maps.options import MapOptions as MapOptions
    from fits.maps.options import SpatialPrior as SpatialPrior
    from fits.maps.store import FittedMap as FittedMap
    from fits.maps.store import open_map as open_map
    from fits.optimise.fit import fit as fit
    from fits.optimise.options import FitOptions as FitOptions
    from fits.optimise.result import Fit as Fit
    from fits.optimise.uncertainty import Direction as Direction
    from fits.prediction.compare import Average as Average
    from fits.prediction.compare import Comparison as Comparison
    from fits.prediction.compare import average as average
    from fits.prediction.compare import compare as compare
    from fits.prediction.cross_validation import ModelScore as ModelScore
    from fits.prediction.cross_validation import cross_validate as cross_validate
    from fits.prediction.importance import Evidence as Evidence
    from fits.prediction.importance import evidence as evidence
    from fits.prediction.options import ComparisonOptions as ComparisonOptions
    from fits.prediction.predict import Prediction as Prediction
    from fits.prediction.predict import Scores as Scores
    from fits.prediction.predict import predict as predict
    from fits.prediction.predict import scores as scores
    from fits.problem.discrepancy import Discrepancy as Discrepancy
    from fits.problem.instrument import Instrument as Instrument
    from fits.problem.noise import Noise as Noise
    from fits.problem.parameters import Free as Free
    from fits.problem.parameters import LogNormal as LogNormal
    from fits.problem.parameters import LogUniform as LogUniform
    from fits.problem.parameters import Normal as Normal
    from fits.problem.parameters import PowerLaw as PowerLaw
    from fits.problem.parameters import Uniform as Uniform
    from fits.problem.problem import Joint as Joint
    from fits.problem.problem import Problem as Problem
    from fits.problem.simulate import simulate as simulate
    from fits.problem.stack_file import read_problem as read_problem
    from fits.problem.stack_file import write_problem as write_problem
    from fits.reports.render import render as render
    from fits.reports.results import load_fit as load_fit
    from fits.reports.results import load_posterior as load_posterior
    from fits.reports.results import save_fit as save_fit
    from fits.reports.verdicts import ReportOptions as ReportOptions
    from fits.sampling.options import SamplerOptions as SamplerOptions
    from fits.sampling.posterior import Mode as Mode
    from fits.sampling.posterior import Posterior as Posterior
    from fits.sampling.sample import sample as sample
    from fits.structure_search import Candidate as Candidate
    from fits.structure_search import Library as Library
    from fits.structure_search import Search as Search
    from fits.structure_search import SearchOptions as SearchOptions
    from fits.structure_search import default_library as default_library
    from fits.structure_search import read_library as read_library
    from fits.structure_search import search as search

_IMPORTS = [node for node in ast.walk(ast.parse(Path(__file__).read_text())) if isinstance(node, ast.ImportFrom)]
_HOMES = {name.name: str(node.module) for node in _IMPORTS for name in node.names if name.asname}
"""The module of each public name, as the imports above say: Python does not run them, type checkers do."""

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
