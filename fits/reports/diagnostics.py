"""The structure of the residuals of a fit along the angles of its measurements.

White residuals are what the error bars assume, where a model discrepancy is fitted once they are whitened by its
covariance. The evidence is, per incidence, their mean and size, and over all of them the correlation of neighbours in
angle (lag one), which a wrong model or a smooth instrument error leaves behind.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fits.data.scans import correlation, incidences, neighbours
from fits.problem.model import Model

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.optimise.result import Fit


@dataclass(frozen=True)
class ResidualGroup:
    """Residuals, in units of sigma, of one incidence: white noise has mean 0 and root mean square 1."""

    theta: float
    count: int
    mean: float
    rms: float


@dataclass(frozen=True)
class ResidualStructure:
    """Summary of the standardised residuals of a fit, over the rows and channels that were fitted."""

    count: int
    mean: float
    rms: float
    beyond_three: float  # share of |residual| > 3; a normal law has 0.0027
    lag_one: float  # correlation of neighbours in angle; NaN when no plane holds enough points
    pairs: int
    lag_one_sigma: float  # lag_one over its standard error under white noise, 1 / sqrt(pairs)
    by_incidence: tuple[ResidualGroup, ...]

    @property
    def independent_share(self) -> float:
        """Effective number of residuals over their number, (1 - r) / (1 + r) for a lag-one correlation r; at most 1."""
        if not self.lag_one > 0.0:
            return 1.0
        return (1.0 - self.lag_one) / (1.0 + self.lag_one)


def over_all_rows(fit: "Fit", values: np.ndarray) -> np.ndarray:
    """Values (used samples, C) of a fit spread over every row of its data, (N, C); NaN in rows that were not used."""
    mask = fit.problem.data.mask
    spread = np.full((len(mask), np.shape(values)[1]), np.nan)
    spread[mask] = values
    return spread


def standardised(fit: "Fit") -> np.ndarray:
    """Residuals of every row that are independent standard normal if the model holds, (N, C); NaN in unused rows.

    They are in units of the noise; with a model discrepancy, whitened by the covariance of both. A named objective has
    no noise model: there the unit is the scatter that the fit has left.
    """
    return over_all_rows(fit, fit.residuals / _unit(fit))


def residual_label(fit: "Fit") -> str:
    """What `standardised` residuals are, for an axis of a picture."""
    return "whitened residual" if fit.problem.noise.discrepancy else misfit_label(fit)


def bsdf(fit: "Fit") -> np.ndarray:
    """Predicted BSDF at every row, with the model discrepancy, (N, C), in 1/sr; NaN in unused rows."""
    from fits.prediction.predict import with_discrepancy

    used = fit.problem.data.used()
    return over_all_rows(fit, with_discrepancy(fit, used.wi, used.wo, fit.predicted))


def misfit(fit: "Fit") -> np.ndarray:
    """Measurements less `bsdf`, in units of the noise, (N, C); NaN in rows that were not used.

    With a model discrepancy these are smaller than the noise, since it follows the data: `standardised` are not.
    """
    independent = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
    return over_all_rows(fit, independent / _unit(fit))


def misfit_label(fit: "Fit") -> str:
    """What a `misfit` is, for an axis of a picture."""
    if not fit.is_posterior:
        return f"residual of {fit.problem.objective} / its scatter"
    which = "with discrepancy" if fit.problem.noise.discrepancy else "model"
    return rf"(data $-$ {which}) / $\sigma$"


def _unit(fit: "Fit") -> float:
    return 1.0 if fit.is_posterior else float(np.sqrt(fit.chi_square / max(fit.degrees_of_freedom, 1)))


def residual_structure(data: "Measurements", residuals: np.ndarray) -> ResidualStructure:
    """Summary of standardised residuals (N, C) over the rows of `data`; NaN rows are skipped.

    Raises:
        ValueError: no residual is finite.
    """
    finite = residuals[np.isfinite(residuals)]
    if not finite.size:
        raise ValueError("residuals must hold at least one finite value, got none")
    groups = []
    for incidence in incidences(data):
        values = residuals[incidence.rows]
        values = values[np.isfinite(values)]
        if values.size:
            groups.append(ResidualGroup(incidence.theta, values.size, float(values.mean()), _rms(values)))
    first, second = neighbours(data, residuals)
    lag_one = correlation(first, second)
    return ResidualStructure(
        count=finite.size,
        mean=float(finite.mean()),
        rms=_rms(finite),
        beyond_three=float(np.mean(np.abs(finite) > 3.0)),
        lag_one=lag_one,
        pairs=first.size,
        lag_one_sigma=lag_one * float(np.sqrt(first.size)),
        by_incidence=tuple(groups),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
