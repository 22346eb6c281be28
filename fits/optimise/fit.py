"""Fitting: many starts through one compiled program, then what the best minimum is worth."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.names import Objective
from fits.optimise import apertures
from fits.optimise.descent import PROMISE, ROUGHLY
from fits.optimise.discrepancy import (
    datasets_with_discrepancy,
    start_points_with_discrepancy,
    with_discrepancy,
    without_discrepancy,
)
from fits.optimise.identifiability import OPEN_BEYOND
from fits.optimise.multi_start import End, Solver, race, rough_end, run_starts, start_points, starts_store, unit_of
from fits.optimise.polish import EQUALLY_WELL, Optimum, optimum
from fits.optimise.refinement import Accuracy, refined
from fits.optimise.resolution import resolutions
from fits.optimise.result import OUTCOMES, Fit, Minimum, WithoutDiscrepancy
from fits.optimise.uncertainty import Uncertainty
from fits.problem.instrument import Instrument
from fits.problem.joint import Joint
from fits.problem.model import Transport
from fits.problem.noise import DEFAULT_RELATIVE, Noise
from fits.problem.parameters import Free
from fits.problem.problem import FittingProblem, Problem
from fits.progress import Progress, silent

Floats = NDArray[np.float64]

SAME_BOX, SAME_ERRORS, SAME_AT_MOST = 1e-3, 0.5, 0.05
"""Ends of two starts are one minimum if no parameter differs by more than a thousandth of its box plus half its
standard error, the error counted up to a twentieth of the box. Of one that the data leave open any value will do, if
the costs agree."""
SAME_COST = 1e-3
"""Costs agree within this, in the log-posterior, times the reduced chi-square where that is above 1."""


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
    solver: Solver = "least_squares",
    progress: Progress | None = None,
    checkpoint: str | Path | None = None,
) -> Fit:
    """Find the parameters of `stack` that explain `data` best, and how well the data determine them.

    Args:
        stack: holds `Free` where a number is to be fitted; or a `Joint` of problems, in which all else is said.
        data: only the samples that its mask leaves in are used.
        transport: see `Problem`. A resolution that it leaves open is chosen: coarse for the starts, at the end so fine
            that the numerical error of the model stays below a tenth of the data's standard deviation, where that is
            within reach. `Fit.problem` has it.
        noise, scale, objective, instrument: see `Problem`.
        starts: at least 1: the `Free.start` values, then scrambled Sobol points of the box (in the logarithm for
            parameters with a `LogNormal` or `LogUniform` prior), drawn with `seed`. The lowest end of all is the fit.
        solver: "least_squares" (Levenberg-Marquardt, checked with L-BFGS-B where a parameter ends on a bound), or
            "bounded" (L-BFGS-B throughout).
        progress: called with ("fit", starts done, starts, note).
        checkpoint: a file that each start is kept in as it ends: a fit that was killed takes those that are there for
            done. It stays, as does one beside it for what is fitted again with shared errors (`again`); one of another
            problem is replaced.

    Raises:
        ValueError: as `Problem`; starts < 1; an unknown solver.
    """
    if isinstance(stack, Joint):
        beside: dict[str, Any] = {"data": data, "noise": noise, "scale": scale, "instrument": instrument}
        beside |= {"transport": None if transport == "auto" else transport}
        beside |= {"objective": None if objective == "likelihood" else objective}
        for name, given in beside.items():
            if given is not None:
                raise ValueError(f"{name} is given beside a Joint; each of its problems has its own")
        problem: FittingProblem = stack
    elif data is None:
        raise ValueError("data is None; it must be the measurements that the stack should explain")
    else:
        problem = Problem(stack, data, transport, Noise() if noise is None else noise, scale, objective, instrument)
    return fit_problem(problem, starts=starts, seed=seed, solver=solver, progress=progress, checkpoint=checkpoint)


def fit_problem(
    problem: FittingProblem,
    *,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    progress: Progress | None = None,
    checkpoint: str | Path | None = None,
    refine: bool = True,
) -> Fit:
    """Find the best parameters of a problem that is already put together, as `fit` does.

    Args:
        problem: what is fitted to what: a `Problem`, or a `Joint` of several.
        starts, seed, solver, progress, checkpoint: see `fit`.
        refine: False: stay at the resolution of the starts, do not ask for its error, follow only those that are
            lowest after a few steps, and find the minimum roughly.

    Raises:
        ValueError: starts < 1; an unknown solver.
    """
    if starts < 1:
        raise ValueError(f"starts is {starts}; it must be at least 1")
    if solver not in get_args(Solver):
        raise ValueError(f"solver is {solver!r}; it must be one of {', '.join(get_args(Solver))}")
    settings: dict[str, int | str] = {"starts": starts, "seed": seed, "solver": solver}
    progress = progress or silent
    found = _found(problem, start_points(problem, starts, seed), solver, progress, checkpoint, settings, refine=refine)
    if not datasets_with_discrepancy(found):
        return found
    return fit_again(
        problem,
        found,
        starts=starts,
        seed=seed,
        solver=solver,
        progress=progress,
        checkpoint=None if checkpoint is None else again(checkpoint),
        refine=refine,
    )


def fit_again(
    problem: FittingProblem,
    found: Fit,
    *,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    progress: Progress | None = None,
    checkpoint: str | Path | None = None,
    refine: bool = True,
) -> Fit:
    """The fit of a problem with model discrepancy, after one without; arguments as of `fit_problem`."""
    without = datasets_with_discrepancy(found) or {
        name: without_discrepancy(found.part(name)) for name in problem.problems
    }
    shared = problem.with_problems({name: with_discrepancy(problem.problems[name]) for name in without})
    settings: dict[str, int | str] = {"starts": starts, "seed": seed, "solver": solver}
    progress = progress or silent

    def report(stage: str, done: int, total: int | None = None, info: str = "") -> None:
        progress(f"{stage} with shared errors", done, total, info)

    places = start_points_with_discrepancy(shared, found, starts, seed)
    return _found(shared, places, solver, report, checkpoint, settings, without, refine)


def refit(problem: Problem, *vectors: Floats) -> Fit:
    """The fit of a problem with minima near these vectors (P,), roughly, at the resolution that the problem has."""
    ends = [rough_end(problem, unit_of(problem, vector), fresh=False) for vector in vectors]
    best = optimum(problem, ends, "least_squares", check=False, promise=ROUGHLY)
    return _fit_of(best, None, {"starts": len(ends)}, {})


def again(checkpoint: str | Path) -> Path:
    """Where a fit that is made again, with shared errors, keeps its starts."""
    return Path(f"{checkpoint}-shared")


def _found(
    problem: FittingProblem,
    places: Floats,
    solver: Solver,
    progress: Progress,
    checkpoint: str | Path | None,
    settings: dict[str, int | str],
    without: Mapping[str, WithoutDiscrepancy] = MappingProxyType({}),
    refine: bool = True,
) -> Fit:
    """The fit from these places (starts, P) in the unit box, at the resolution that it needs."""
    known = {name: found for name, one in problem.problems.items() if (found := resolutions(one)) is not None}
    open_rays = {name for name, one in problem.problems.items() if apertures.leaves_open(one)}
    coarse = {name: replace(problem.problems[name], transport=one.far) for name, one in known.items() if one.open}
    problem = problem.with_problems(coarse)
    problem = problem.with_problems({name: apertures.for_starts(problem.problems[name]) for name in open_rays})
    racing = not refine and solver == "least_squares"
    ends = race(problem, places) if racing else _ends(problem, places, solver, progress, checkpoint)
    best, accuracy = optimum(problem, ends, solver, promise=PROMISE if refine else ROUGHLY), None
    if refine and (known or any(map(apertures.has_rays, problem.problems.values()))):
        best, accuracy = refined(best, known, open_rays, solver, progress)
    return _fit_of(best, accuracy, settings, without)


def _fit_of(
    at: Optimum, accuracy: Accuracy | None, settings: dict[str, int | str], without: Mapping[str, WithoutDiscrepancy]
) -> Fit:
    """The fit of an optimum, with what is to be said of it."""
    problem, lowest, found = at.problem, at.lowest, at.found
    at_bound = tuple(name for name, held in zip(problem.names, found.at_bound, strict=True) if held)
    minima, outcomes = _minima(problem, at.ends, at.best, found, SAME_COST * at.excess)
    as_good = tuple(minimum for minimum in minima[1:] if minimum.cost - lowest.cost < EQUALLY_WELL * at.excess)
    result = Fit(
        problem=cast(Problem, problem),  # or a `Joint`, of whose measurements `Fit.part` tells
        vector=lowest.vector,
        errors=found.standard_errors,
        covariance=found.covariance,
        cost=lowest.cost,
        at_bound=at_bound,
        converged=lowest.converged,
        status="",
        iterations=lowest.steps,
        condition_number=found.condition_number,
        unidentified=found.unidentified,
        insensitive=found.insensitive,
        minima=minima,
        alternatives=as_good,
        settings=settings,
        start_outcomes=outcomes,
        numerical_error=None if accuracy is None else accuracy.error,
        resolution=None if accuracy is None else accuracy.resolution,
        without_discrepancy=without.get(""),
        without_discrepancy_parts={name: one for name, one in without.items() if name},
    )
    notes = ["L-BFGS-B improved on Levenberg-Marquardt"] if at.improved else []
    notes += [] if accuracy is None else [accuracy.words]
    result = replace(result, status="; ".join((*_status(result), *notes)))
    if np.all(np.isfinite(at.predicted)):  # to compute it again, another program would be compiled
        vars(result)["predicted"] = at.predicted
    return result


def _ends(
    problem: FittingProblem, points: Floats, solver: Solver, progress: Progress, checkpoint: str | Path | None
) -> list[End]:
    """Where the starts (starts, P) in the unit box end, each kept in the checkpoint as it does."""
    if checkpoint is None:
        return run_starts(problem, points, solver, progress)
    with starts_store(checkpoint, problem, points, solver) as store:
        return run_starts(problem, points, solver, progress, store)


def _minima(
    problem: FittingProblem, ends: list[End], best: int, found: Uncertainty, same_cost: float
) -> tuple[tuple[Minimum, ...], dict[str, int]]:
    """The lowest end and the distinct ones that converged, best first; and how many starts ended where."""
    cost = np.array([end.cost for end in ends])
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(np.stack([end.vector for end in ends]))))
    width = np.asarray(problem.model.box.slope(jnp.asarray(ends[best].vector)))
    spread = np.nan_to_num(found.standard_errors / width, nan=0.0, posinf=np.inf)
    same = SAME_BOX + SAME_ERRORS * np.minimum(spread, SAME_AT_MOST)
    open_ = (spread > OPEN_BEYOND) | np.isin(problem.names, found.insensitive)
    alike = np.where(open_, np.inf, same)
    leaders: list[int] = []
    counts: list[int] = []
    outcomes = dict.fromkeys(OUTCOMES, 0)
    for index in sorted(range(len(ends)), key=lambda k: (cost[k], k != best)):
        if not np.isfinite(cost[index]) and index != best:
            outcomes["failed"] += 1
            continue
        near = [
            place
            for place, other in enumerate(leaders)
            if np.all(
                np.abs(units[index] - units[other]) <= (alike if abs(cost[index] - cost[other]) <= same_cost else same)
            )
        ]
        leads = not near and (index == best or ends[index].converged)
        if leads:
            leaders.append(index)
            counts.append(0)
        if near or leads:
            place = near[0] if near else len(leaders) - 1
            counts[place] += 1
            outcomes["local minima" if place else "best minimum"] += 1
        else:
            outcomes["maximum steps reached" if ends[index].unfinished else "failed"] += 1
    minima = tuple(
        Minimum(
            values=dict(zip(problem.names, map(float, ends[leader].vector), strict=True)),
            cost=float(cost[leader]),
            count=count,
            stack=problem.build(ends[leader].vector).stack,
        )
        for leader, count in zip(leaders, counts, strict=True)
    )
    return minima, outcomes


def _status(fit: Fit) -> list[str]:
    total, reached = sum(fit.start_outcomes.values()), fit.start_outcomes["best minimum"]
    words = [
        f"converged; {reached} of {total} starts reached this minimum"
        if fit.converged
        else f"not converged: the lowest of {total} starts did not; these are the best values seen"
    ]
    words += [
        f"{fit.start_outcomes[key]} of {total} starts {word}"
        for key, word in OUTCOMES.items()
        if key != "best minimum" and fit.start_outcomes[key]
    ]
    if fit.at_bound:
        words.append(f"at a bound: {', '.join(fit.at_bound)}; the errors of the others hold with them kept there")
    if fit.insensitive:
        words.append(f"insensitive, with no effect on the data: {', '.join(fit.insensitive)}")
    if fit.unidentified:
        words.append(f"{len(fit.unidentified)} direction(s) in the space of parameters are not identified")
    if fit.alternatives:
        words.append(f"the errors are of this minimum alone, and {len(fit.alternatives)} more fit equally well")
    if fit.is_posterior and any(problem.noise_is_assumed for problem in fit.problem.problems.values()):
        words.append(f"a noise of {100.0 * DEFAULT_RELATIVE:g} % of the model's value was assumed, none is stated")
    if not fit.is_posterior:
        words.append(
            f"objective {fit.problem.objective} is no likelihood: the errors are scaled by its scatter, no posterior"
        )
    return words
