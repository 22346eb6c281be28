"""Sampling the posterior about a fit, in unconstrained coordinates, until the chain is long enough to be believed."""

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from scipy.special import logit
from scipy.stats import qmc

from fits._files import given_path, require_switch
from fits.optimise.result import Fit
from fits.problem.problem import Problem
from fits.progress import Progress, given_progress, silent
from fits.sampling.chain import Chain, opened
from fits.sampling.convergence import CHECKS, Convergence, expected_steps, next_check
from fits.sampling.ensemble import Ensemble
from fits.sampling.initial import log_posteriors, share_of
from fits.sampling.nuts import CHAINS, Nuts, require_blackjax
from fits.sampling.options import SamplerOptions
from fits.sampling.posterior import Posterior, posterior_of
from fits.store import Store, another, differences, fingerprint
from layerjax._checks import require_kind, require_seed
from layerjax.compiling import program_cache

WALKERS = 20  # of which 50 autocorrelation times have about 1,000 effective samples
PATIENCE = 10.0  # seconds between two looks at a chain that grows slowly, for what progress shows

Sampler = Literal["emcee", "nuts"]


@program_cache()
def sample(
    fit: Fit,
    *,
    ess: float | None = None,
    sampler: Sampler = "emcee",
    walkers: int | None = None,
    max_steps: int | None = None,
    options: SamplerOptions | None = None,
    seed: int = 0,
    path: str | Path | None = None,
    resume: bool = True,
    allow_unconverged: bool = False,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior of a fit until its chain has converged and has the effective samples that are requested.

    Args:
        fit: a fit of a likelihood.
        ess, walkers, max_steps: in place of those of `options`.
        sampler: "emcee", an ensemble of walkers, or "nuts", a few chains that follow the gradient, for many parameters:
            it needs the extra `layerjax[nuts]`.
        options: stopping rule and settings. A chain can be resumed for more effective samples.
        seed: random seed; the same seed gives the same chain.
        path: file of the chain, from which a killed run resumes with the same result. One process at a time may write
            it. None: in memory.
        resume: False replaces the chain of `path`.
        allow_unconverged: allow estimates from a chain that has not converged.
        progress: called with ("sample", steps, steps that are expected in all, note); before that with
            ("approximation", rounds, most, note), and of NUTS with ("warm-up", steps, all).

    Raises:
        ValueError: the fit's objective is no likelihood, or it is a part of a joint one, whose chain is that of the
            whole (`Posterior.part`); too few walkers; an unknown sampler, or one whose extra is not installed; `path`
            holds a chain of something else, or is in use by another process; no finite posterior near the optimum.
        OSError: the disk is full, say. What was sampled is kept.
    """
    require_kind("fit", fit, Fit)
    fit.require_posterior("sample")
    require_seed(seed)
    require_switch("resume", resume)
    require_switch("allow_unconverged", allow_unconverged)
    if path is not None and not given_path("path", path).parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")
    count = len(fit.problem.names)
    require_kind("options", options, SamplerOptions, None)
    changes: dict[str, Any] = {"ess": ess, "walkers": walkers, "max_steps": max_steps}
    options = replace(options or SamplerOptions(), **{name: one for name, one in changes.items() if one is not None})
    walkers = walkers_of(count, sampler, options.walkers)
    options = replace(options, walkers=walkers)
    progress = given_progress(progress)
    with opened(path, walkers, count, identity_of(fit.problem, walkers, seed, sampler), resume) as chain:
        chain.keep_options(asdict(options))
        moved = (Nuts if sampler == "nuts" else Ensemble)(fit, chain, seed, options, progress)
        _run(moved, chain, options, progress)
    return posterior_of(fit, chain, allow_unconverged)


def _run(moved: Nuts | Ensemble, chain: Chain, options: SamplerOptions, progress: Progress) -> None:
    """Go on until the chain is long enough, as seen at its checks."""
    found, looked = Convergence.of(chain.steps(), options), time.monotonic()
    total: int | None = None

    def check() -> None:
        nonlocal found, total, looked
        found = Convergence.of(chain.steps(), options)
        total = None if progress is silent else expected_steps(chain.steps(), options)
        looked = time.monotonic()

    def show() -> None:
        if progress is silent:
            return
        if time.monotonic() - looked > PATIENCE:
            check()
        progress("sample", chain.iteration, total, found.note(options) if np.any(found.ess > 0.0) else "")

    while chain.iteration < options.max_steps:
        if chain.iteration in CHECKS and found.is_finished(options):
            break
        moved.advance(min(next_check(chain.iteration), options.max_steps), show)
        chain.write()
        check()
    total = chain.iteration
    show()


def walkers_of(count: int, sampler: Sampler, walkers: int | None) -> int:
    """How many walkers sample so many parameters. ValueError for a number with which they cannot be."""
    if sampler not in get_args(Sampler):
        raise ValueError(f"sampler is {sampler!r}; it must be one of {', '.join(get_args(Sampler))}")
    if sampler == "nuts":
        require_blackjax()
        if walkers is not None and walkers < 2:
            raise ValueError(f"walkers is {walkers}; it must be at least 2 for sampler='nuts'")
        return walkers or CHAINS
    least = 2 * count + 2
    walkers = walkers or max(WALKERS, least)
    if walkers % 2 or walkers < least:
        raise ValueError(f"walkers is {walkers}; it must be even and at least {least} for {count} parameters")
    return walkers


class NoSteps(ValueError):
    """A chain that has not begun."""


def load(fit: Fit, path: str | Path, *, allow_unconverged: bool = False) -> Posterior:
    """The posterior kept in a file by `sample`, as far as it got. ValueError if the file is not a chain of this fit."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no chain")
    store = Store.read(path)
    if not store.fingerprint:
        raise NoSteps(f"{path}: the chain has no steps yet")
    sampler, walkers, seed = settings_of(store)
    if different := differences(store.fingerprint, identity_of(fit.problem, walkers, seed, sampler)):
        raise ValueError(another(path, different))
    chain = Chain(walkers, len(fit.problem.names), store)
    if not chain.iteration:
        raise NoSteps(f"{path}: the chain has no steps yet")
    return posterior_of(fit, chain, allow_unconverged)


def settings_of(store: Store) -> tuple[str, int, int]:
    """Sampler, walkers and seed of a chain that is kept in a store."""
    whose = store.fingerprint
    return whose.get("sampler", "none"), int(whose.get("walkers", 0)), int(whose.get("seed", 0))


def identity_of(problem: Problem, walkers: int, seed: int, sampler: str) -> dict[str, str]:
    """What tells one sampling from another: names, bounds, settings, and the posterior itself at a few points; of
    numbers the first digits, which are the same wherever they are computed."""
    points = 0.01 + 0.98 * qmc.Sobol(len(problem.names), scramble=False).random_base2(2)  # in the unit box
    log_posterior = log_posteriors(problem, logit(points), share_of(walkers))
    return fingerprint(
        sampler=sampler,
        walkers=walkers,
        seed=seed,
        precision=str(jnp.zeros(()).dtype),
        names=list(problem.names),
        bounds=[f"{bound:.9g}" for bound in np.concatenate([problem.low, problem.high])],
        posterior=[f"{height:.6g}" for height in log_posterior],
    )
