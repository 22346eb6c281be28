"""Answers to a `fits.Problem`: the best fit and its uncertainty, samples of the posterior, comparisons of fits.

A problem goes in; a `fits.Fit` comes out, of that a `fits.Posterior`, and of several a `fits.Comparison`.
"""

from typing import TYPE_CHECKING

from fits._lazy import directory_of, names_from

if TYPE_CHECKING:
    from fits.inference.compare import Comparison as Comparison
    from fits.inference.fit_result import Fit as Fit
    from fits.inference.identifiability import Combination as Combination
    from fits.inference.optimise import fit as fit
    from fits.inference.posterior import Posterior as Posterior
    from fits.inference.predicting import predict as predict
    from fits.inference.prediction import Prediction as Prediction
    from fits.inference.sampling import sample as sample

_HOMES = {
    "Fit": "fit_result",
    "fit": "optimise",
    "Posterior": "posterior",
    "Prediction": "prediction",
    "predict": "predicting",
    "sample": "sampling",
    "Comparison": "compare",
    "Combination": "identifiability",
}

__all__ = list(_HOMES)

__getattr__ = names_from(__name__, _HOMES)
__dir__ = directory_of(__name__, _HOMES)
