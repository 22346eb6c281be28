"""The residuals of a fit, along the angles of its measurements and in units of their noise.

White residuals are what the error bars assume, where a model discrepancy is fitted once they are whitened by its
covariance. A wrong model or a smooth instrument error leaves neighbours in angle correlated.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from fits.problem.model import Model

if TYPE_CHECKING:
    from fits.optimise.result import Fit


def over_all_rows(fit: "Fit", values: np.ndarray) -> np.ndarray:
    """Values (used samples, C) of a fit spread over every row of its data, (N, C); NaN in rows that were not used."""
    mask = fit.problem.data.mask
    spread = np.full((len(mask), np.shape(values)[1]), np.nan)
    spread[mask] = values
    return spread


def bsdf(fit: "Fit") -> np.ndarray:
    """Predicted BSDF at every row, with the model discrepancy, (N, C), in 1/sr; NaN in unused rows."""
    from fits.prediction.predict import with_discrepancy

    used = fit.problem.data.used()
    return over_all_rows(fit, with_discrepancy(fit, used.wi, used.wo, fit.predicted))


def standardised(fit: "Fit") -> np.ndarray:
    """Residuals of every row that are independent standard normal if the model holds, (N, C); NaN in unused rows.

    They are in units of the noise; with a model discrepancy, whitened by the covariance of both. A named objective has
    no noise model: there the unit is the scatter that the fit has left.
    """
    return over_all_rows(fit, fit.residuals / _unit(fit))


def misfit(fit: "Fit") -> np.ndarray:
    """Measurements less `bsdf`, in units of the noise, (N, C); NaN in rows that were not used.

    With a model discrepancy these are smaller than the noise, since it follows the data: `standardised` are not.
    """
    independent = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
    return over_all_rows(fit, independent / _unit(fit))


def residual_label(fit: "Fit") -> str:
    """The name of an axis of a `misfit`."""
    if not fit.is_posterior:
        return f"residual of {fit.problem.objective} / its scatter"
    return rf"(data $-$ {'with discrepancy' if fit.problem.noise.discrepancy else 'model'}) / $\sigma$"


def _unit(fit: "Fit") -> float:
    return 1.0 if fit.is_posterior else math.sqrt(fit.chi_square / max(fit.degrees_of_freedom, 1))
