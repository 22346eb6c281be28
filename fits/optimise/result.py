"""The outcome of a fit: values, how far to trust them, and what else would explain the data."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from fits._lazy import shown_by
from fits.data.geometry import Floats
from fits.optimise.uncertainty import Direction
from fits.problem.model import Model
from fits.problem.problem import Problem

# what is said of the starts that ended in each way (see `Fit.start_outcomes`)
OUTCOMES = {
    "best minimum": "converged to the best minimum",
    "local minima": "converged to other local minima",
    "maximum steps reached": "reached the maximum of steps",
    "failed": "failed",
}


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum that `count` starts reached: values by name, half the sum of squared residuals, and whether it is not
    the best but fits as well."""

    values: dict[str, float]
    cost: float
    count: int
    equivalent: bool = False


@dataclass(frozen=True)
class WithoutDiscrepancy:
    """The same stack fitted with independent noise: values and standard errors by name, how well.

    residual_autocorrelation: of so many `pairs` of neighbours along the scans.
    """

    values: dict[str, float]
    errors: dict[str, float]
    chi_square: float
    degrees_of_freedom: int
    log_likelihood: float
    residual_autocorrelation: float
    pairs: int


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit: the best minimum of a `Problem` with P parameters, N measurements and C channels.

    Attributes:
        problem: the fitting problem: stack, data, transport, noise and instrument.
        vector: (P,), best values in the problem's order, in physical units.
        errors: (P,), standard errors; NaN for a parameter at a bound, infinite for an unidentified one. The others are
            conditional on the parameters at a bound being fixed there.
        covariance: (P, P), of the parameters.
        cost: half the sum of squared residuals.
        at_bound: names of the parameters at a bound.
        converged: whether the best start converged.
        iterations: steps of the optimiser to the best minimum.
        condition_number: condition number of the information matrix, with each parameter scaled to unit length.
        unidentified: directions of parameter space that the data do not identify, the worst first.
        minima: local minima that were reached, the best first. `errors` and `covariance` are those of the best;
            `fits.sample`, `fits.predict` and `fits.evidence` include all with a share of the posterior.
        insensitive: names of the parameters that have no effect on the predicted data.
        settings: starts, seed, and the numbers of `FitOptions`.
        start_outcomes: number of starts by outcome: "best minimum", "local minima", "maximum steps reached", "failed".
        numerical_error: largest numerical error of the model at the best values, in standard deviations of the data (of
            the residuals for a named objective), estimated with a finer resolution, or with a coarser one where a finer
            one is not possible, plus that of the rays of an instrument. None for a model without one.
        resolution: resolution of the transport, and number of rays, as text; None where there is neither.
        without_discrepancy: the fit without model discrepancy, if one was added because of the residuals (see `Noise`).
        without_discrepancy_parts: the same for each data set of a `Joint`, by name.
        dataset: name of the data set, if this is the part of a joint fit.
    """

    problem: Problem
    vector: Floats
    errors: Floats
    covariance: Floats
    cost: float
    at_bound: tuple[str, ...]
    converged: bool
    iterations: int
    condition_number: float
    unidentified: tuple[Direction, ...]
    minima: tuple[Minimum, ...]
    insensitive: tuple[str, ...] = ()
    settings: Mapping[str, int | float | str] = field(default_factory=dict)
    start_outcomes: Mapping[str, int] = field(default_factory=dict)
    numerical_error: float | None = None
    resolution: str | None = None
    without_discrepancy: WithoutDiscrepancy | None = None
    without_discrepancy_parts: Mapping[str, WithoutDiscrepancy] = field(default_factory=dict)
    dataset: str | None = None

    def __repr__(self) -> str:
        numbers = zip(self.problem.names, self.vector, self.errors, strict=True)
        values = ", ".join(f"{name} {value:.4g} ± {error:.2g}" for name, value, error in numbers)
        return f"<Fit to {self.problem.count} measurements: {values}; {self.status}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.reports.html:fit_fragment", self))

    def part(self, name: str = "") -> "Fit":
        """The result for one data set of a `Joint`, with the errors of the joint fit; a fit of one data set itself.

        It predicts in the normal approximation of the joint posterior, `Posterior.part` from its draws. ValueError for
        an unknown name.
        """
        own = list(self.problem.places(name))
        problem = self.problem.problems[name]
        if problem is self.problem:
            return self
        called = {self.problem.names[place]: plain for place, plain in zip(own, problem.names, strict=True)}

        def names(some: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(called[name] for name in some if name in called)

        def minimum(one: Minimum) -> Minimum:
            return replace(one, values={plain: one.values[whole] for whole, plain in called.items()})

        found = replace(
            self,
            problem=problem,
            vector=self.vector[own],
            errors=self.errors[own],
            covariance=self.covariance[np.ix_(own, own)],
            at_bound=names(self.at_bound),
            insensitive=names(self.insensitive),
            unidentified=tuple(one.renamed(called) for one in self.unidentified if set(one.weights) & set(called)),
            minima=tuple(map(minimum, self.minima)),
            without_discrepancy=self.without_discrepancy_parts.get(name),
            dataset=name,
        )
        vars(found)["predicted"] = self.problem.shares(self.predicted)[name]
        return found

    def require_one(self, what: str) -> None:
        """Raise a ValueError if this is a joint fit; `what` is the function that needs one data set."""
        problems = self.problem.problems
        if problems.get("") is not self.problem:
            raise ValueError(f"{what}: of a joint fit it takes a part: fit.part(...) of {', '.join(problems)}")

    def require_posterior(self, what: str) -> None:
        """Raise a ValueError if the fit has no posterior of its own: a named objective, or a part of a joint fit."""
        if not self.is_posterior:
            raise ValueError(f"{what}: a fit of {self.problem.objective!r} has no noise model, and so no posterior")
        if self.dataset is not None:
            words = "without the others it says something else; fit it by itself, or take the whole fit"
            raise ValueError(f"{what}: {self.dataset!r} is a part of a joint fit, and {words}")

    @property
    def alternatives(self) -> tuple[Minimum, ...]:
        """Other local minima of the same model that fit equally well."""
        return tuple(one for one in self.minima if one.equivalent)

    @property
    def status(self) -> str:
        """How the fit ended, in words."""
        total, best = sum(self.start_outcomes.values()), self.start_outcomes.get("best minimum")
        words = ["converged" if self.converged else "not converged, these are the best values seen"]
        words += [f"{count} of {total} starts {OUTCOMES[how]}" for how, count in self.start_outcomes.items() if count]
        words += ["more starts may find a better one"] if best == 1 < total else []
        words += [f"at a bound: {', '.join(self.at_bound)}"] if self.at_bound else []
        if self.alternatives:
            others = f"{len(self.alternatives)} more local minima fit equally well"
            words.append(f"errors are conditional on this local minimum; {others}")
        if self.resolution is not None:
            error = numerical_error_in_words(self.numerical_error)
            words.append(f"numerical error of the model: {error} at {self.resolution}")
        return "; ".join(words)

    @property
    def values(self) -> dict[str, float]:
        """Best value of each parameter."""
        return dict(zip(self.problem.names, map(float, self.vector), strict=True))

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter."""
        return dict(zip(self.problem.names, map(float, self.errors), strict=True))

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return self.problem.units

    @cached_property
    def stack(self) -> Any:
        """The stack with the best values."""
        return self.problem.build(self.vector).stack

    @property
    def is_posterior(self) -> bool:
        """Whether the objective was a likelihood, so that errors are those of a posterior."""
        return self.problem.objective == "likelihood"

    @cached_property
    def predicted(self) -> Floats:
        """The model at the used samples, (N, C), in 1/sr."""
        return np.asarray(self.problem.predict(self.vector), float)

    @cached_property
    def residuals(self) -> Floats:
        """(datum - model) / sigma, (N, C), or the difference in the measure of the named objective.

        With correlated noise these are whitened: K^-1/2 times the differences, with K their covariance. Under the
        assumed model they are independent standard normal; `chi_square` is the sum of their squares.
        """
        return np.asarray(self.problem.call(Model.whitened_residuals_at, self.vector, self.predicted), float)

    @cached_property
    def chi_square(self) -> float:
        """Sum of squared `residuals`, with correlated noise by its covariance; a named objective's has no scale."""
        return float(np.sum(self.residuals**2))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of data less number of parameters."""
        return self.problem.count - len(self.vector)

    @property
    def reduced_chi_square(self) -> float:
        """`chi_square` per degree of freedom; NaN without any."""
        return self.chi_square / self.degrees_of_freedom if self.degrees_of_freedom > 0 else float("nan")

    @cached_property
    def log_likelihood(self) -> float:
        """Normalised log-likelihood of the best values; NaN for a named objective."""
        if not self.is_posterior:
            return float("nan")
        return float(self.problem.call(Model.log_likelihood_at, self.vector, self.predicted))

    @property
    def correlation(self) -> Floats:
        """(P, P); NaN in the rows and columns of parameters at a bound."""
        spread = np.sqrt(np.diagonal(self.covariance))
        spread = np.where(spread > 0, spread, np.nan)
        return self.covariance / np.outer(spread, spread)


def numerical_error_in_words(error: float | None) -> str:
    """How far the resolution keeps the model from its limit."""
    return "not known" if error is None or not math.isfinite(error) else f"{error:.2g} sigma at most"
