"""Tolerances and thresholds of a fit, with the values that they have by default."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from fits.problem.stack_file import check_keys
from layerjax._checks import require_number


@dataclass(frozen=True)
class FitOptions:
    """Tolerances and thresholds of a fit; they are stored with it (`Fit.settings`).

    Attributes:
        same_values: two starts reached the same minimum if no parameter differs by more than this share of the range
            between its bounds, plus `same_errors` standard errors.
        same_errors: standard errors in `same_values`, in total at most a twentieth of the range.
        same_cost: largest difference of their log-posteriors, times the reduced chi-square if that is above 1.
        equivalent_cost: minima are equivalent if their log-posteriors differ by less than this, times the reduced
            chi-square if that is above 1.
        autocorrelation: a model discrepancy is added if residuals of neighbours along the scans are correlated by more
            than this and by more than `autocorrelation_errors` standard errors (see `Noise.discrepancy`).
        autocorrelation_errors: see `autocorrelation`.
        numerical_error: largest numerical error of the model, in standard deviations of the data, if the resolution is
            chosen.
    """

    same_values: float = 1e-3
    same_errors: float = 0.5
    same_cost: float = 1e-3
    equivalent_cost: float = 2.0
    autocorrelation: float = 0.2
    autocorrelation_errors: float = 3.0
    numerical_error: float = 0.1

    def __post_init__(self) -> None:
        for entry in fields(self):
            require_number(f"FitOptions.{entry.name}", getattr(self, entry.name), 0.0, open_ends=True)


DEFAULT = FitOptions()


def options_from(table: Mapping[str, Any]) -> FitOptions:
    """The options that the ``[options]`` of a stack file changes. ValueError for a key that is none of them."""
    check_keys("[options]", table, tuple(entry.name for entry in fields(FitOptions)))
    return FitOptions(**table)
