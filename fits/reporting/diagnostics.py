"""What structure the residuals of a fit have left along the angles of its measurements.

White residuals are what the error bars assume. Here is the evidence: per incidence their mean and size, and over all of
them the correlation of neighbours in angle (lag one), which a wrong model or a smooth instrument error leaves behind.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fits.data.neighbours import alike, neighbours
from fits.data.scans import incidences

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.inference.fit_result import Fit


@dataclass(frozen=True)
class ResidualGroup:
    """Residuals, in units of sigma, of one incidence: white noise has mean 0 and root mean square 1."""

    theta: float
    count: int
    mean: float
    rms: float


@dataclass(frozen=True)
class ResidualStructure:
    """What the standardised residuals of a fit look like, over the rows and channels that were fitted."""

    count: int
    mean: float
    rms: float
    beyond_three: float  # share of |residual| > 3; a normal law has 0.0027
    normal_distance: float  # Kolmogorov-Smirnov distance from the unit normal
    lag_one: float  # correlation of neighbours in angle; NaN when no plane holds enough points
    pairs: int
    lag_one_sigma: float  # lag_one over its standard error under white noise, 1 / sqrt(pairs)
    by_incidence: tuple[ResidualGroup, ...]

    @property
    def worst(self) -> ResidualGroup:
        return max(self.by_incidence, key=lambda group: group.rms)

    @property
    def independent_share(self) -> float:
        """Independent readings per reading, (1 - r) / (1 + r) for neighbours correlated by r; 1 where r <= 0."""
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
    """Residuals of every row in units of the noise, (N, C), NaN in rows that were not used.

    A named objective has no noise model: there the unit is the scatter that the fit has left.
    """
    unit = 1.0 if fit.is_posterior else np.sqrt(fit.chi_square / max(fit.degrees_of_freedom, 1))
    return over_all_rows(fit, fit.residuals / unit)


def residual_label(fit: "Fit") -> str:
    """What `standardised` residuals are, for an axis of a picture."""
    return r"(data $-$ model) / $\sigma$" if fit.is_posterior else f"residual of {fit.problem.objective} / its scatter"


def residual_structure(data: "Measurements", residuals: np.ndarray) -> ResidualStructure:
    """Summary of standardised residuals (N, C) over the rows of `data`; NaN rows are left out.

    Raises:
        ValueError: no residual is finite.
    """
    from scipy import stats

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
    lag_one = alike(first, second)
    return ResidualStructure(
        count=finite.size,
        mean=float(finite.mean()),
        rms=_rms(finite),
        beyond_three=float(np.mean(np.abs(finite) > 3.0)),
        normal_distance=float(stats.kstest(finite, "norm").statistic),
        lag_one=lag_one,
        pairs=first.size,
        lag_one_sigma=lag_one * float(np.sqrt(first.size)),
        by_incidence=tuple(groups),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
