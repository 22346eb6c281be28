"""Sampling the posterior about a fit, until the chain is long enough to be believed.

Chains move in unconstrained coordinates, where the box has no walls; everything that is reported is physical.
"""

from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit
from scipy.stats import qmc

from fits.optimise.result import Fit
from fits.problem.problem import Problem
from fits.progress import Progress
from fits.sampling.chain import FileChain, MemoryChain, stored_chain
from fits.sampling.convergence import FIRST_CHECK, Outlook, finished, next_check
from fits.sampling.ensemble import Ensemble, log_posteriors
from fits.sampling.nuts import CHAINS, Nuts, require_blackjax
from fits.sampling.posterior import Posterior, posterior_of
from layerjax._checks import require_kind

WALKERS = 32
Sampler = Literal["emcee", "nuts"]


def sample(
    fit: Fit,
    *,
    sampler: Sampler = "emcee",
    walkers: int | None = None,
    seed: int = 0,
    path: str | Path | None = None,
    ess: float | None = None,
    max_steps: int = 20_000,
    resume: bool = True,
    allow_unconverged: bool = False,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior of a fit until its chain is long enough, or `max_steps` steps.

    Args:
        fit: made with a likelihood.
        sampler: "emcee", an ensemble of walkers that move together, or "nuts", a few chains that follow the gradient,
            for many parameters: it needs the extra `layerjax[nuts]`.
        walkers: of emcee, even, at least twice the number of parameters plus 2; None for 32, or for more if that is
            too few. Of NUTS, the number of chains, at least 2; None for 4.
        seed: of starts and moves; the same seed gives the same chain.
        path: HDF5 file that the chain is kept in as it grows, with a journal beside it: a killed run that is started
            again goes on from its last whole step and ends as it would have. One process at a time writes it, any
            number may read it. None keeps it in memory.
        ess: effective samples of the worst parameter that are asked for, above 0: sampling goes on until the chain has
            them, and is 50 autocorrelation times long. None asks for the latter alone. A chain may be gone on with for
            more of them.
        max_steps: hard limit; a chain that reaches it may not be `converged`.
        resume: False replaces what `path` holds.
        allow_unconverged: let the result report estimates though the chain has not converged.
        progress: called with ("sample", steps, None, note); of NUTS, before that with ("warm-up", steps, all).

    Raises:
        ValueError: the fit's objective is no likelihood, or it is a part of one of several measurements, whose chain is
            that of the whole (`Posterior.part`); too few walkers; an unknown sampler, or one whose extra is not
            installed; `path` holds a chain of something else, or is in use by another process; no start with a finite
            posterior near the optimum.
        OSError: the disk is full, say. What was sampled is kept.
    """
    _require_possible(fit, path)
    count = len(fit.problem.names)
    walkers = require_settings(count, sampler=sampler, walkers=walkers, ess=ess, max_steps=max_steps)
    identity = identity_of(fit.problem, walkers, seed, sampler)
    chain = MemoryChain(walkers, count) if path is None else FileChain(path, walkers, count, identity, resume)
    try:
        moved = Nuts(fit, chain, seed, progress) if sampler == "nuts" else Ensemble(fit, chain, seed)
        if not (chain.iteration or chain.moves):
            moved.decide()
        _run(moved, chain, max_steps, ess, progress)
    finally:
        chain.close()
    return posterior_of(fit, chain, allow_unconverged)


def _run(
    moved: Nuts | Ensemble, chain: MemoryChain, max_steps: int, ess: float | None, progress: Progress | None
) -> None:
    """Go on until the chain is long enough."""
    outlook = Outlook(chain, max_steps, ess)

    def tell(now: bool = False) -> None:
        if progress is not None and (now or outlook.overdue):
            progress("sample", chain.iteration, None, outlook.note())

    while not finished(chain, max_steps, ess):
        moved.advance(min(next_check(chain.iteration), max_steps), tell)
        chain.checkpoint()
        tell(now=True)
    chain.checkpoint()  # what a killed run left in the journal alone


def _require_possible(fit: Fit, path: str | Path | None) -> None:
    """ValueError for a fit that cannot be sampled, or a place that a chain cannot be kept in."""
    require_kind("fit", fit, Fit)
    if not fit.is_posterior:
        raise ValueError(f"objective {fit.problem.objective!r} is no likelihood, so there is no posterior to sample")
    fit.require_alone("sample")
    if path is not None and not Path(path).parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")


def require_settings(count: int, *, sampler: Sampler, walkers: int | None, ess: float | None, max_steps: int) -> int:
    """The walkers, or chains, of `sample`. ValueError for settings by which it cannot sample so many parameters."""
    if sampler not in get_args(Sampler):
        raise ValueError(f"sampler is {sampler!r}; it must be one of {', '.join(get_args(Sampler))}")
    if sampler == "nuts":
        require_blackjax()
    if max_steps < FIRST_CHECK:
        raise ValueError(f"max_steps is {max_steps}; it must be at least {FIRST_CHECK}")
    if ess is not None and not ess > 0:
        raise ValueError(f"ess is {ess}; it must be above 0")
    return _walkers(sampler, walkers, count)


def _walkers(sampler: Sampler, walkers: int | None, count: int) -> int:
    """How many walkers, or chains, `count` parameters are sampled with; ValueError for too few."""
    if sampler == "nuts":
        if walkers is not None and walkers < 2:
            raise ValueError(f"walkers is {walkers}; it must be at least 2 for sampler='nuts'")
        return walkers or CHAINS
    least = 2 * count + 2
    if walkers is not None and (walkers % 2 or walkers < least):
        raise ValueError(f"walkers is {walkers}; it must be even and at least {least} for {count} parameters")
    return walkers or max(WALKERS, least)


class NoSteps(ValueError):
    """A chain that has not begun."""


def load(fit: Fit, path: str | Path, *, allow_unconverged: bool = False) -> Posterior:
    """The posterior kept in a file by `sample`, as far as it got. ValueError if the file is not a chain of this fit."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no chain")

    def expected(stored: dict[str, Any]) -> dict[str, Any]:
        return identity_of(fit.problem, int(stored["walkers"]), int(stored["seed"]), stored["sampler"])

    chain = stored_chain(path, expected)
    if not chain.iteration:
        raise NoSteps(f"{path}: the chain has no steps yet")
    return posterior_of(fit, chain, allow_unconverged)


def identity_of(problem: Problem, walkers: int, seed: int, sampler: str = "emcee") -> dict[str, Any]:
    """What tells one sampling from another: names, bounds, settings, and the posterior itself at a few points."""
    return {
        "sampler": sampler,
        "names": "\n".join(problem.names),
        "bounds": np.stack([problem.low, problem.high]),
        "posterior": np.asarray(problem.call(log_posteriors, _fixed_points(problem)), float),
        "walkers": walkers,
        "seed": seed,
    }


def _fixed_points(problem: Problem) -> NDArray[np.float64]:
    points = 0.01 + 0.98 * qmc.Sobol(len(problem.names), scramble=False).random_base2(2)  # in the unit box
    return logit(points)
