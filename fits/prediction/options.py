"""Thresholds of the verdicts of a model comparison."""

from dataclasses import dataclass, fields

from fits.sampling.options import MAX_PARETO_K
from layerjax._checks import require_count, require_number


@dataclass(frozen=True)
class ComparisonOptions:
    """Thresholds of `fits.compare`, `fits.cross_validate` and `fits.average`.

    Attributes:
        standard_errors: two models whose elpd differs by fewer of these are statistically indistinguishable.
        decisive_per_measurement: an elpd difference above this a measurement, in every group of held-out data, decides
            whatever its standard error: a few groups say little of the error of their sum.
        slight_difference: below this difference in AIC and BIC (for elpd: twice the difference less its error) two
            models are statistically indistinguishable (Burnham & Anderson 2002, Sec. 2.6; Kass & Raftery 1995).
        clear_difference: above this difference hardly any doubt remains; below it the data prefer a model slightly.
        max_pareto_k: of importance weights, above which the evidence is unreliable (Vehtari et al. 2024).
        max_reduced_chi_square: if that of every model is above this, a note says that none explains the data.
        min_incidences: cross-validation holds out one incidence at a time if there are so many, and parts of every scan
            if there are fewer, as a fit of one incidence says little of another.
        scan_parts: parts of equal size that every scan is then divided into.
        monte_carlo_error: standard error that the elpd of a group of held-out data may have because draws of the
            posterior are few: more are taken until it is below this, or until there are `most_draws`.
    """

    standard_errors: float = 2.0
    decisive_per_measurement: float = 1.0
    slight_difference: float = 2.0
    clear_difference: float = 10.0
    max_pareto_k: float = MAX_PARETO_K
    max_reduced_chi_square: float = 2.0
    min_incidences: int = 3
    scan_parts: int = 5
    monte_carlo_error: float = 0.3
    most_draws: int = 1024

    def __post_init__(self) -> None:
        for field in fields(self):
            require_number(field.name, getattr(self, field.name), 0.0, open_ends=True)
        for name, least in (("min_incidences", 1), ("scan_parts", 2), ("most_draws", 1)):
            require_count(name, getattr(self, name), least)


DEFAULT = ComparisonOptions()
