"""fits: recover the parameters of a layered material, with their uncertainty, from BRDF measurements.

Names are imported when they are first used: `import fits` loads neither arviz, matplotlib nor a solver.
"""

from typing import TYPE_CHECKING

from fits._lazy import directory_of, names_from

if TYPE_CHECKING:
    from fits.data.formats import read as read
    from fits.data.formats.csv import write_csv as write_csv
    from fits.data.formats.rxt import Slab as Slab
    from fits.data.formats.rxt import read_slab as read_slab
    from fits.data.geometry import Geometry as Geometry
    from fits.data.geometry import slices as slices
    from fits.data.measurements import Measurements as Measurements
    from fits.data.spheres import Sphere as Sphere
    from fits.data.spheres import Spheres as Spheres
    from fits.data.totals import Totals as Totals
    from fits.exporting.export import Exported as Exported
    from fits.exporting.export import export as export
    from fits.inference.averaging import Average as Average
    from fits.inference.averaging import average as average
    from fits.inference.compare import Comparison as Comparison
    from fits.inference.compare import compare as compare
    from fits.inference.fit_result import Fit as Fit
    from fits.inference.foresight import Foresight as Foresight
    from fits.inference.identifiability import Combination as Combination
    from fits.inference.left_out import leave_out as leave_out
    from fits.inference.marginal_likelihood import Evidence as Evidence
    from fits.inference.marginal_likelihood import evidence as evidence
    from fits.inference.optimise import fit as fit
    from fits.inference.posterior import Mode as Mode
    from fits.inference.posterior import Posterior as Posterior
    from fits.inference.predicting import predict as predict
    from fits.inference.prediction import Prediction as Prediction
    from fits.inference.prediction import Scores as Scores
    from fits.inference.prediction import scores as scores
    from fits.inference.sampling import sample as sample
    from fits.many.files import FittedFiles as FittedFiles
    from fits.many.files import fit_files as fit_files
    from fits.many.searching import Searching as Searching
    from fits.maps.fit_map import fit_map as fit_map
    from fits.maps.fitted_map import FittedMap as FittedMap
    from fits.maps.fitted_map import open_map as open_map
    from fits.maps.smoothing import Smoothness as Smoothness
    from fits.problem.correlated import Correlated as Correlated
    from fits.problem.instrument import Instrument as Instrument
    from fits.problem.joint import Joint as Joint
    from fits.problem.likelihood import Noise as Noise
    from fits.problem.parameters import Free as Free
    from fits.problem.parameters import LogNormal as LogNormal
    from fits.problem.parameters import LogUniform as LogUniform
    from fits.problem.parameters import Normal as Normal
    from fits.problem.parameters import Uniform as Uniform
    from fits.problem.problem import Problem as Problem
    from fits.problem.simulate import simulate as simulate
    from fits.problem.spectra import PowerLaw as PowerLaw
    from fits.problem.stack_file import read_problem as read_problem
    from fits.problem.stack_file import write_problem as write_problem
    from fits.reporting.html import report as report
    from fits.reporting.render import render as render
    from fits.reporting.results import load_fit as load_fit
    from fits.reporting.results import load_posterior as load_posterior
    from fits.reporting.results import save_fit as save_fit
    from fits.structures.library import Library as Library
    from fits.structures.library import default_library as default_library
    from fits.structures.library import read_library as read_library
    from fits.structures.searching import Search as Search
    from fits.structures.searching import search as search

_HOMES = {
    "Average": "inference.averaging",
    "average": "inference.averaging",
    "Comparison": "inference.compare",
    "compare": "inference.compare",
    "Evidence": "inference.marginal_likelihood",
    "evidence": "inference.marginal_likelihood",
    "Exported": "exporting.export",
    "export": "exporting.export",
    "Fit": "inference.fit_result",
    "fit_map": "maps.fit_map",
    "FittedMap": "maps.fitted_map",
    "open_map": "maps.fitted_map",
    "Smoothness": "maps.smoothing",
    "Foresight": "inference.foresight",
    "read": "data.formats",
    "write_csv": "data.formats.csv",
    "read_slab": "data.formats.rxt",
    "Slab": "data.formats.rxt",
    "Geometry": "data.geometry",
    "slices": "data.geometry",
    "Combination": "inference.identifiability",
    "Correlated": "problem.correlated",
    "Instrument": "problem.instrument",
    "Joint": "problem.joint",
    "Noise": "problem.likelihood",
    "PowerLaw": "problem.spectra",
    "Measurements": "data.measurements",
    "Sphere": "data.spheres",
    "Spheres": "data.spheres",
    "Totals": "data.totals",
    "fit": "inference.optimise",
    "Free": "problem.parameters",
    "LogNormal": "problem.parameters",
    "LogUniform": "problem.parameters",
    "Normal": "problem.parameters",
    "Uniform": "problem.parameters",
    "Mode": "inference.posterior",
    "Posterior": "inference.posterior",
    "Prediction": "inference.prediction",
    "Scores": "inference.prediction",
    "scores": "inference.prediction",
    "predict": "inference.predicting",
    "sample": "inference.sampling",
    "Search": "structures.searching",
    "search": "structures.searching",
    "Library": "structures.library",
    "default_library": "structures.library",
    "read_library": "structures.library",
    "leave_out": "inference.left_out",
    "fit_files": "many.files",
    "FittedFiles": "many.files",
    "Searching": "many.searching",
    "Problem": "problem.problem",
    "render": "reporting.render",
    "report": "reporting.html",
    "load_fit": "reporting.results",
    "load_posterior": "reporting.results",
    "save_fit": "reporting.results",
    "simulate": "problem.simulate",
    "read_problem": "problem.stack_file",
    "write_problem": "problem.stack_file",
}

__all__ = list(_HOMES)
__getattr__ = names_from(__name__, _HOMES)
__dir__ = directory_of(__name__, _HOMES)
