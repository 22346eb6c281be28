"""Tolerances and thresholds of a fit, with the values that they have by default."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from fits.problem.stack_file import check_keys
from layerjax._checks import require_number


@dataclass(frozen=True)
class FitOptions:
    """What decides when a fit has converged and what is said of it; stored with the fit (`Fit.settings`).

    Attributes:
        same_values, same_errors: two starts converged to one minimum if no parameter differs by more than this share of
            its box plus this many standard errors (each counted up to a twentieth of the box).
        same_cost: and if their costs agree within this, in the log-posterior, times the reduced chi-square above 1.
        equivalent_cost: minima explain the data equally well if their log-posteriors differ by less than this, times
            the reduced chi-square above 1.
        autocorrelation, autocorrelation_errors: a fit with independent noise is fitted again with model discrepancy if
            residuals of neighbours along the scans are correlated by more than the first, and by more than so many
            standard errors of that (see `Noise.discrepancy`).
        numerical_error: of the model, in standard deviations of the data: a resolution that is chosen stays below it,
            where that is within reach.
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
