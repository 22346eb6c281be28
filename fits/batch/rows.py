"""What became of a file and a stack, as a row of the table; and which stack is best of those of a file."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from fits.prediction.compare import LEANING

if TYPE_CHECKING:
    from fits.batch.fitting import Fitted

BEST, AS_GOOD = "best", "as good"


@dataclass(frozen=True)
class Parameter:
    """A fitted number with its standard error: NaN at a bound, infinite where the data leave it open."""

    name: str
    value: float
    error: float
    unit: str
    at_bound: bool


@dataclass(frozen=True)
class Row:
    """One file and one stack.

    Args:
        file, stack: their names.
        directory: of the result, below that of all; empty without one.
        failure: why there is none, on one line; empty where there is.
        structure: of a search, the stack that it found best, from the top.
        converged, status, objective, chi_square, reduced_chi_square: see `Fit`.
        readings: that were fitted.
        alone: reduced chi-square of the stack without errors that readings share, which say how far it misses the data;
            NaN where none are counted.
        aic: Akaike's information criterion; NaN for a named objective.
        score, scored: mean log-density of readings that were held out, and how many values they have.
        seconds: that it took, with compilation and pictures.
        parameters: in the order of the fit.
    """

    file: str
    stack: str
    directory: str = ""
    failure: str = ""
    structure: str = ""
    converged: bool = False
    status: str = ""
    objective: str = "likelihood"
    readings: int = 0
    chi_square: float = math.nan
    reduced_chi_square: float = math.nan
    alone: float = math.nan
    aic: float = math.nan
    score: float = math.nan
    scored: int = 0
    seconds: float = math.nan
    parameters: tuple[Parameter, ...] = ()

    @property
    def fitted(self) -> bool:
        """Whether there is a result."""
        return not self.failure

    @property
    def loss(self) -> float:
        """The smaller, the better: -2 log-density of what was held out, or else AIC, or else chi-square."""
        if self.scored:
            return -2.0 * self.score * self.scored
        return self.chi_square if math.isnan(self.aic) else self.aic

    @property
    def measure(self) -> str:
        """What `loss` is: rows of one measure can be compared."""
        return "score" if self.scored else "AIC" if not math.isnan(self.aic) else self.objective

    def plain(self) -> dict[str, Any]:
        """For `write_json`."""
        return asdict(self)


def row_of(fitted: "Fitted", *, file: str, stack: str, directory: str, structure: str, seconds: float) -> Row:
    """The row of a fit."""
    fit, alone = fitted.fit, fitted.fit.without_discrepancy
    seen = None if fitted.held_out is None else fitted.held_out.prediction.scores
    return Row(
        file=file,
        stack=stack,
        directory=directory,
        structure=structure,
        converged=bool(fit.converged),
        status=fit.status,
        objective=fit.problem.objective,
        readings=int(fit.problem.data.mask.sum()),
        chi_square=fit.chi_square,
        reduced_chi_square=fit.reduced_chi_square,
        alone=math.nan if alone is None else alone.chi_square / max(alone.degrees_of_freedom, 1),
        aic=2.0 * len(fit.vector) - 2.0 * fit.log_likelihood,
        score=math.nan if seen is None else seen.elpd,
        scored=0 if seen is None else seen.count,
        seconds=round(seconds, 2),
        parameters=tuple(
            Parameter(name, value, fit.standard_errors[name], fit.units[name], name in fit.at_bound)
            for name, value in fit.values.items()
        ),
    )


def stored_row(content: Mapping[str, Any]) -> Row:
    """A row as `Row.plain` and a JSON file keep it: numbers that are not finite are words there."""
    numbers = ("chi_square", "reduced_chi_square", "alone", "aic", "score", "seconds")
    parameters = tuple(
        Parameter(**(dict(one) | {key: float(one[key]) for key in ("value", "error")})) for one in content["parameters"]
    )
    return Row(**(dict(content) | {key: float(content[key]) for key in numbers} | {"parameters": parameters}))


def standings(rows: Sequence[Row]) -> dict[tuple[str, str], str]:
    """By file and stack: best, as good as the best, or by how much worse in AIC; empty where nothing can be said.

    A best fit that misses the data by more than their noise says that the noise is larger than stated: differences are
    divided by its reduced chi-square, as in `fits.compare`.
    """
    words = {(row.file, row.stack): "" for row in rows}
    for file in dict.fromkeys(row.file for row in rows):
        own = [row for row in rows if row.file == file and row.fitted and math.isfinite(row.loss)]
        if len(own) < 2 or len({row.measure for row in own}) > 1:
            continue
        best = min(own, key=lambda row: (not row.converged, row.loss))
        excess = max(1.0, best.reduced_chi_square) if best.measure == "AIC" else 1.0
        for row in own:
            behind = (row.loss - best.loss) / (1.0 if math.isnan(excess) else excess)
            alike = behind < LEANING and row.measure in ("AIC", "score") and row.converged
            words[row.file, row.stack] = BEST if row is best else AS_GOOD if alike else f"{behind:+.1f}"
    return words


def best_of(rows: Sequence[Row]) -> dict[str, str]:
    """By file, the stack that is best; the only one, where one was fitted."""
    words = standings(rows)
    found = {}
    for file in dict.fromkeys(row.file for row in rows):
        own = [row for row in rows if row.file == file and row.fitted]
        named = [row.stack for row in own if words[row.file, row.stack] == BEST or len(own) == 1]
        if named:
            found[file] = named[0]
    return found
