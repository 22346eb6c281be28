"""What fits foretell of readings that are left out of them: one incidence after the other, or stretches of a scan.

Readings of one incidence are alike, so that one of them, left out by itself, is told by its neighbours whatever the
stack is. What a stack is worth shows where a whole incidence is missing.
"""

from collections.abc import MutableMapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.data.measurements import Measurements
from fits.data.scans import incidences, scans
from fits.optimise.fit import refit
from fits.optimise.result import Fit
from fits.prediction.importance import Weighted
from fits.prediction.predict import foretold
from fits.problem.discrepancy.logarithm import size
from fits.problem.noise import total_sigma
from fits.problem.problem import Problem
from fits.progress import Progress
from fits.sampling.modes import other_minima
from layerjax._checks import require_kind

FEWEST_INCIDENCES = 3
"""With fewer, stretches of the scans are left out: what is fitted at one incidence says little of another."""

STRETCHES = 5
"""Of each scan."""

DRAWS = 128

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """How readings were foretold that were left out.

    groups: what was left out together. rows: the rows of each among the used samples. log_density: of each reading by
    the fit that had not seen its group, (N, C), 0 for those of planes with too few readings to leave some out, which
    are in no group. converged: whether all of these fits did.
    """

    groups: tuple[str, ...]
    rows: tuple[NDArray[np.int64], ...]
    log_density: Floats
    converged: bool

    @property
    def elpd(self) -> float:
        """Sum of the log-densities: the higher, the better are new readings foretold."""
        return float(np.sum(self.log_density))

    @property
    def by_group(self) -> Floats:
        """The score of each group, (G,)."""
        return np.array([np.sum(self.log_density[rows]) for rows in self.rows])

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Readings of each group, (G,)."""
        return np.array([self.log_density[rows].size for rows in self.rows])


Done = MutableMapping[str, tuple[Floats, bool]]
"""By group: the log-density of its readings, (rows, C), and whether the fit without them converged."""


def cross_validate(
    fit: Fit,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    progress: Progress | None = None,
    known: Weighted | None = None,
    done: Done | None = None,
) -> CrossValidation:
    """Fit anew without each incidence, from the best values on, and foretell its readings.

    With fewer than three incidences every scan is left out by fifths.

    Args:
        fit: of a likelihood.
        draws, seed: see `predict`.
        progress: called with ("left out", groups done, groups, name).
        known: draws for the posterior of the fit: those without an incidence are looked for about them.
        done: groups that are there are not computed again; those that are computed are added as they are.

    Raises:
        ValueError: a fit of a named objective, or data of a single group; one of several measurements, or part of it.
    """
    groups, data = require_groups(fit), fit.problem.data.used()
    like = None if known is None else known.mixture(np.random.RandomState(seed), 2 * draws)
    density, converged = np.zeros(data.values.shape), True
    near = [fit.vector, *(np.array([one.values[name] for name in fit.problem.names]) for one in other_minima(fit))]
    done = {} if done is None else done
    for number, (name, rows) in enumerate(groups.items()):
        if progress is not None:
            progress("left out", number, len(groups), name)
        if name not in done:
            chosen = np.zeros(len(data), bool)
            chosen[rows] = True
            found = refit(without(fit.problem, chosen), *near)
            seen = foretold(found, data, draws=draws, seed=seed, like=like).log_density(data.values)[rows]
            done[name] = seen, found.converged
        density[rows], good = done[name]
        converged &= good
    if progress is not None:
        progress("left out", len(groups), len(groups), "")
    return CrossValidation(tuple(groups), tuple(groups.values()), density, converged)


def require_groups(fit: Fit) -> dict[str, NDArray[np.int64]]:
    """Rows of a fit's readings that are left out together, by name.

    Raises:
        ValueError: as `cross_validate`.
    """
    require_kind("fit", fit, Fit)
    if not fit.is_posterior:
        raise ValueError(
            f"cross_validate: a fit of {fit.problem.objective!r} has no noise model, it says nothing of readings"
        )
    fit.require_alone("cross_validate")
    if fit.problem.problems.get("") is not fit.problem:
        raise ValueError("cross_validate: it takes a fit of one measurement by itself, not a joint one")
    groups = groups_of(fit.problem.data.used())
    if len(groups) < 2:
        raise ValueError("cross_validate: the readings are all of one incidence, and too few to leave some of them out")
    return groups


def groups_of(data: Measurements) -> dict[str, NDArray[np.int64]]:
    """Rows that are left out together, by name."""
    every = incidences(data)
    if len(every) >= FEWEST_INCIDENCES:
        return {one.label: one.rows for one in every}
    pieces = [np.array_split(rows, STRETCHES) for rows in scans(data)]
    stretches = [np.concatenate([piece[number] for piece in pieces]) for number in range(STRETCHES)] if pieces else []
    return {f"stretch {number}": rows for number, rows in enumerate(stretches, 1) if rows.size}


ENORMOUS = 1e8
"""Noise that leaves a reading without influence, in units of the largest one."""


def without(problem: Problem, rows: ArrayLike) -> Problem:
    """The problem, whose used samples in `rows` (N,) bool count for nothing: their noise is without bounds.

    Residuals of these rows are 0; their number counts still.
    """
    model, left = problem.model, jnp.asarray(rows)[:, None]
    enormous = ENORMOUS * jnp.max(jnp.abs(model.values) + model.lowest)
    model = replace(
        model,
        variance=jnp.where(left, enormous**2, model.variance),
        lowest=jnp.where(left, enormous, model.lowest),
    )
    if model.process is not None and model.process.gram is not None:
        parts = model.build(jnp.asarray(problem.start))
        sigma = total_sigma(model.values, model.variance, parts.relative, parts.floor)
        gram = model.process.gram_of(size(model.values, model.softness) / sigma)
        model = replace(model, process=replace(model.process, gram=gram))
    return problem.with_model(model)
