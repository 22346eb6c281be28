"""A fit in four steps: multi-start, polish with uncertainties, resolution, result.

Where nothing is said of a discrepancy, the stack is fitted with independent noise; where residuals of neighbours along
the scans are correlated by more than `FitOptions` allow, it is fitted again with a discrepancy.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from fits._files import given_path, require_switch
from fits.data.geometry import Floats
from fits.data.measurements import Measurements
from fits.data.scans import correlation, neighbours
from fits.data.totals import Totals
from fits.names import Objective
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, ROUGH_TOLERANCE
from fits.optimise.multi_start import (
    Optimum,
    multi_start,
    polish,
    rough_descent,
    screened_starts,
    start_points,
    starts_store,
    unit_of,
)
from fits.optimise.options import DEFAULT, FitOptions
from fits.optimise.resolution import Accuracy, for_starts, refined
from fits.optimise.result import OUTCOMES, Fit, Minimum, WithoutDiscrepancy
from fits.optimise.uncertainty import UNCONSTRAINED_BEYOND
from fits.problem.instrument import Instrument
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import FittingProblem, Problem
from fits.progress import Progress, given_progress, named, silent
from layerjax._checks import require_count, require_kind, require_seed
from layerjax.compiling import program_cache

SAME_AT_MOST = 0.05  # share of its box up to which a standard error counts where minima are compared
MOST_STARTS = 8  # minima without model discrepancy that the fit with it starts from; of other starts half as many


@program_cache()
def fit(
    stack: Any,
    data: Measurements | None = None,
    *,
    transport: Transport = "auto",
    noise: Noise | None = None,
    scale: float | Free | None = None,
    objective: Objective = "likelihood",
    instrument: Instrument | None = None,
    starts: int = 32,
    seed: int = 0,
    options: FitOptions = DEFAULT,
    progress: Progress | None = None,
    checkpoint: str | Path | None = None,
    screen: bool = False,
) -> Fit:
    """Fit the free parameters of a stack to measurements, from several starts, with standard errors.

    Args:
        stack: a stack with `Free` in the place of each number that is fitted; or a `Problem` or `Joint`, without
            further arguments about data and model.
        data: measurements; masked ones are not used.
        transport: see `Problem`. A resolution that is not given is chosen: a coarse one for the starts, then one for
            which the numerical error of the model is below a tenth of the standard deviations of the data
            (`Fit.resolution`).
        noise, scale, objective, instrument: see `Problem`.
        starts: at least 1: the `Free.start` values, then scrambled Sobol points between the bounds (of the logarithm
            for `LogNormal` and `LogUniform` priors). The best minimum is the result; where a parameter ends at a bound,
            L-BFGS-B checks it.
        seed: random seed of the starts.
        options: tolerances and thresholds.
        progress: called with ("fit", starts done, starts, note).
        checkpoint: file in which each finished start is stored. A fit that was killed resumes from it; a file of
            another problem is replaced.
        screen: a rough fit to rank stacks: at the resolution of the starts, without an estimate of its error, and only
            the best starts after a few steps are continued.

    Raises:
        ValueError: as `Problem`; starts < 1.
    """
    if isinstance(stack, FittingProblem):
        problem = stack
        arguments: dict[str, Any] = {"data": data, "noise": noise, "scale": scale, "instrument": instrument}
        arguments |= {"transport": None if transport == "auto" else transport}
        arguments |= {"objective": None if objective == "likelihood" else objective}
        if given := [name for name, value in arguments.items() if value is not None]:
            raise ValueError(f"{given[0]} is given beside a {type(stack).__name__}, which says it all")
    else:
        problem = Problem(stack, cast(Measurements, data), transport, noise or Noise(), scale, objective, instrument)
    require_count("starts", starts, 1)
    require_seed(seed)
    require_switch("screen", screen)
    checkpoint = None if checkpoint is None else given_path("checkpoint", checkpoint)
    require_kind("options", options, FitOptions)
    run = _Run(starts, seed, options, given_progress(progress), checkpoint, screen)
    independent = _fit_from(problem, start_points(problem, starts, seed), run)
    without = {name: found for name in problem.problems if (found := _refuted(independent.part(name), options))}
    if not without:
        return independent

    # again with model discrepancy of these data sets: from the minima of the fit without, and a few other points
    sets = {name: problem.problems[name] for name in without}
    sets = {name: replace(one, noise=replace(one.noise, discrepancy=True)) for name, one in sets.items()}
    whole, points = problem.with_problems(sets), []
    for minimum in independent.minima[:MOST_STARTS]:
        values = dict(zip(whole.names, whole.start, strict=True)) | minimum.values
        points.append(unit_of(whole, np.array([values[name] for name in whole.names])))
    others = start_points(whole, min(starts, MOST_STARTS // 2), seed)

    checkpoint = None if checkpoint is None else discrepancy_checkpoint(checkpoint)
    again = run._replace(progress=named("with model discrepancy", run.progress), checkpoint=checkpoint)
    return _fit_from(whole, np.concatenate([points, others]), again, without)


def refit(problem: Problem, *vectors: Floats) -> Fit:
    """The fit of a problem with minima near these vectors (P,), roughly, at the resolution that the problem has."""
    ends = [rough_descent(problem, unit_of(problem, vector), fresh=False) for vector in vectors]
    best = polish(problem, ends, check=False, tolerance=ROUGH_TOLERANCE)
    return _result(best, None, _Run(len(ends)), {})


def discrepancy_checkpoint(checkpoint: str | Path) -> Path:
    """The checkpoint of the second fit, with model discrepancy, beside that of the first."""
    return Path(f"{checkpoint}-discrepancy")


class _Run(NamedTuple):
    """How a problem is fitted: see `fit`."""

    starts: int
    seed: int = 0
    options: FitOptions = DEFAULT
    progress: Progress = silent
    checkpoint: str | Path | None = None
    screen: bool = False


def _refuted(fit: Fit, options: FitOptions) -> WithoutDiscrepancy | None:
    """What is to be said of a fit whose residuals show that it needs model discrepancy, where that is left to them."""
    possible = fit.problem.noise.tails == "gaussian" and fit.is_posterior and not isinstance(fit.problem.data, Totals)
    if fit.problem.noise.discrepancy is not None or not possible:
        return None
    pairs = neighbours(fit.problem.data.used(), fit.residuals)
    found = correlation(*pairs)
    if not (found * math.sqrt(pairs[0].size) > options.autocorrelation_errors and found > options.autocorrelation):
        return None
    return WithoutDiscrepancy(
        values=fit.values,
        errors=fit.standard_errors,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        log_likelihood=fit.log_likelihood,
        residual_autocorrelation=found,
        pairs=pairs[0].size,
    )


def _fit_from(
    problem: FittingProblem, points: Floats, run: _Run, without: Mapping[str, WithoutDiscrepancy] | None = None
) -> Fit:
    """The fit from these points (starts, P) of the unit box, in four steps."""
    # 1. all starts, at a coarse resolution where that is open
    problem, choices = for_starts(problem)
    if run.screen:
        ends = screened_starts(problem, points)
    else:
        with starts_store(run.checkpoint, problem, points) as store:  # each is kept as it ends
            ends = multi_start(problem, points, run.progress, store)
    # 2. the lowest of them, to its very minimum, with the uncertainties there
    at = polish(problem, ends, tolerance=ROUGH_TOLERANCE if run.screen else COST_TOLERANCE)
    # 3. at the resolution that the noise of the data asks for
    accuracy = None
    if not run.screen:
        at, accuracy = refined(at, choices, run.options, run.progress)
    # 4. what follows from it
    return _result(at, accuracy, run, without or {})


def _result(at: Optimum, accuracy: Accuracy | None, run: _Run, without: Mapping[str, WithoutDiscrepancy]) -> Fit:
    """The fit of an optimum: values, errors, minima."""
    problem, lowest, found, options = at.problem, at.lowest, at.uncertainty, run.options
    at_bound = tuple(name for name, held in zip(problem.names, found.at_bound, strict=True) if held)
    minima, outcomes = _minima(problem, at, options)
    result = Fit(
        problem=cast(Problem, problem),  # or a `Joint`, of whose data sets `Fit.part` says more
        vector=lowest.vector,
        errors=found.standard_errors,
        covariance=found.covariance,
        cost=lowest.cost,
        at_bound=at_bound,
        converged=lowest.converged,
        iterations=lowest.steps,
        condition_number=found.condition_number,
        unidentified=found.unidentified,
        insensitive=found.insensitive,
        minima=minima,
        settings={"starts": run.starts, "seed": run.seed, **asdict(options)},
        start_outcomes=outcomes,
        numerical_error=None if accuracy is None else accuracy.error,
        resolution=None if accuracy is None else accuracy.resolution,
        without_discrepancy=without.get(""),
        without_discrepancy_parts={name: one for name, one in without.items() if name},
    )
    if np.all(np.isfinite(at.predicted)):  # to compute it again, another program would be compiled
        vars(result)["predicted"] = at.predicted
    return result


def _minima(problem: FittingProblem, at: Optimum, options: FitOptions) -> tuple[tuple[Minimum, ...], dict[str, int]]:
    """The lowest end and the distinct ones that converged, best first; and how many starts had which outcome.

    Of a parameter that is not identified any value will do, if the costs agree.
    """
    ends, best = at.ends, at.best
    cost = np.array([end.cost for end in ends])
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(np.stack([end.vector for end in ends]))))
    width = np.asarray(problem.model.box.slope(jnp.asarray(ends[best].vector)))
    spread = np.nan_to_num(at.uncertainty.standard_errors / width, nan=0.0, posinf=np.inf)
    same = options.same_values + options.same_errors * np.minimum(spread, SAME_AT_MOST)
    free = (spread > UNCONSTRAINED_BEYOND) | np.isin(problem.names, at.uncertainty.insensitive)
    same_at_equal_cost = np.where(free, np.inf, same)

    def are_one(index: int, other: int) -> bool:
        equal_cost = abs(cost[index] - cost[other]) <= options.same_cost * at.excess
        return bool(np.all(np.abs(units[index] - units[other]) <= (same_at_equal_cost if equal_cost else same)))

    leaders, counts = list[int](), list[int]()
    outcomes = dict.fromkeys(OUTCOMES, 0)
    for index in sorted(range(len(ends)), key=lambda k: (cost[k], k != best)):
        if not np.isfinite(cost[index]) and index != best:
            outcomes["failed"] += 1
            continue
        place = next((place for place, leader in enumerate(leaders) if are_one(index, leader)), len(leaders))
        if place < len(leaders) or index == best or ends[index].converged:
            if place == len(leaders):
                leaders.append(index)
                counts.append(0)
            counts[place] += 1
            outcomes["local minima" if place else "best minimum"] += 1
        else:
            outcomes["maximum steps reached" if ends[index].max_steps_reached else "failed"] += 1
    minima = tuple(
        Minimum(
            values=dict(zip(problem.names, map(float, ends[leader].vector), strict=True)),
            cost=float(cost[leader]),
            count=count,
            equivalent=leader != leaders[0] and bool(cost[leader] - cost[best] < options.equivalent_cost * at.excess),
        )
        for leader, count in zip(leaders, counts, strict=True)
    )
    return minima, outcomes
