"""Sampling the posterior about a fit with emcee, until the chain is long enough to be believed.

Half the steps are emcee's stretch moves, half are independent proposals from an approximation, the fit's own or one
learned from the chain (`laplace`). The ensemble moves in unconstrained coordinates, where the box has no walls;
everything that is reported is physical.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import emcee
import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.special import logit
from scipy.stats import qmc

from fits.inference.chain import FileChain, MemoryChain, stored_chain
from fits.inference.fit_result import Fit
from fits.inference.laplace import Approximation, first_positions
from fits.inference.mixture import Mixture
from fits.problem.model import Model
from fits.problem.problem import Problem
from fits.progress import Progress

if TYPE_CHECKING:
    from arviz import InferenceData

FIRST_CHECK = 100
LONG_ENOUGH = 50.0
STEADY = 0.05
BURN_IN = 10
REPORTED_DRAWS = 2048
INDEPENDENT = 0.5

Floats = NDArray[np.float64]
Proposals = Approximation | Mixture


@dataclass(frozen=True, eq=False)
class Posterior:
    """An ensemble chain of P parameters and what it says.

    Attributes:
        chain: (steps, walkers, P), physical values, from the start on.
        log_probability: (steps, walkers), of the unconstrained coordinates, not normalised.
        autocorrelation_time: (P,), in steps, of the chain without its first tenth.
        acceptance: mean share of proposals taken.
        converged: the chain without its first tenth is longer than 50 autocorrelation times of every parameter, which
            changed by less than 5 % since the last check.
        allow_short: estimates may be had from a chain that has not converged.
    """

    fit: Fit
    chain: Floats
    log_probability: Floats
    autocorrelation_time: Floats
    acceptance: float
    converged: bool
    allow_short: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.fit.problem.names

    @property
    def burn_in(self) -> int:
        """Steps left out at the start: a tenth of the chain."""
        return len(self.chain) // BURN_IN

    @property
    def thin(self) -> int:
        """Every how many steps `samples` takes one: half the shortest autocorrelation time."""
        shortest = float(np.min(self.autocorrelation_time))
        return max(1, int(shortest / 2)) if math.isfinite(shortest) else 1

    @property
    def effective_samples(self) -> Floats:
        """Effective number of independent samples of each parameter, (P,)."""
        return (len(self.chain) - self.burn_in) * self.chain.shape[1] / self.autocorrelation_time

    @cached_property
    def samples(self) -> Floats:
        """Thinned samples after the burn-in, (S, P), in physical units."""
        self._require_converged()
        return self.chain[self.burn_in :: self.thin].reshape(-1, len(self.names))

    def summary(self) -> dict[str, tuple[float, float, float, float, float]]:
        """For each parameter: median, ends of the central 68 % interval, mean, standard deviation.

        Raises ValueError for a chain that has not converged, unless it was sampled with `allow_short`.
        """
        self._require_converged()
        kept = self.chain[self.burn_in :].reshape(-1, len(self.names))
        median, low, high = np.quantile(kept, [0.5, 0.158655, 0.841345], axis=0)
        columns = (median, low, high, kept.mean(axis=0), kept.std(axis=0))
        return {
            name: (float(a), float(b), float(c), float(d), float(e))
            for name, a, b, c, d, e in zip(self.names, *columns, strict=True)
        }

    @cached_property
    def inference_data(self) -> "InferenceData":
        """ArviZ data: posterior, log_likelihood of each datum, posterior_predictive with noise, observed_data.

        A walker is a chain. Draws are thinned so that about 2,000 remain: they serve predictions and model comparison.
        """
        self._require_converged()
        import arviz

        steps, walkers, count = self.chain[self.burn_in :].shape
        draws = min(max(REPORTED_DRAWS // walkers, 1), steps)
        picked = np.linspace(0, steps - 1, draws).astype(int)
        chosen = np.swapaxes(self.chain[self.burn_in :][picked], 0, 1)
        problem = self.fit.problem
        density, predicted, sigma = problem.call(_over_samples, chosen.reshape(-1, count))
        shape = (walkers, draws, *problem.model.values.shape)
        generator = np.random.default_rng(0)
        student = problem.noise.tails == "student"
        freedom = problem.noise.degrees_of_freedom
        noise = generator.standard_t(freedom, shape) if student else generator.standard_normal(shape)
        simulated = np.asarray(predicted).reshape(shape) + np.asarray(sigma).reshape(shape) * noise
        return arviz.from_dict(
            posterior={name: chosen[..., index] for index, name in enumerate(self.names)},
            log_likelihood={"value": np.asarray(density).reshape(shape)},
            posterior_predictive={"value": simulated},
            observed_data={"value": np.asarray(problem.model.values)},
            dims={"value": ["sample", "channel"]},
            coords={"channel": list(problem.data.channels)},
        )

    def _require_converged(self) -> None:
        if self.converged or self.allow_short:
            return
        raise ValueError(
            f"the chain of {len(self.chain)} steps is too short to report from: its longest autocorrelation time is "
            f"{np.max(self.autocorrelation_time):.0f} steps, and {LONG_ENOUGH:.0f} of them after burn-in are needed, "
            f"steady to {STEADY:.0%}; sample again with the same path and a larger max_steps to go on, or with "
            "allow_short=True"
        )


def sample(
    fit: Fit,
    *,
    walkers: int = 32,
    seed: int = 0,
    path: str | Path | None = None,
    max_steps: int = 20_000,
    resume: bool = True,
    allow_short: bool = False,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior of a fit until its chain is long enough, or `max_steps` steps.

    Args:
        fit: made with a likelihood.
        walkers: even, at least twice the number of parameters plus 2.
        seed: of starts and moves; the same seed gives the same chain.
        path: HDF5 file that the chain is kept in as it grows, with a journal beside it: a killed run that is started
            again goes on from its last whole step and ends as it would have. One process at a time writes it, any
            number may read it. None keeps it in memory.
        max_steps: hard limit; a chain that reaches it is not `converged`.
        resume: False replaces what `path` holds.
        allow_short: let the result report estimates though the chain has not converged.
        progress: called with ("sample", steps, None, note).

    Raises:
        ValueError: the fit's objective is no likelihood; too few walkers; `path` holds a chain of something else, or is
            in use by another process; no start with a finite posterior near the optimum.
        OSError: the disk is full, say. What was sampled is kept.
    """
    problem = fit.problem
    if not fit.is_posterior:
        raise ValueError(f"objective {problem.objective!r} is no likelihood, so there is no posterior to sample")
    count = len(problem.names)
    if walkers % 2 or walkers < 2 * count + 2:
        raise ValueError(f"walkers is {walkers}; it must be even and at least {2 * count + 2} for {count} parameters")
    if max_steps < FIRST_CHECK:
        raise ValueError(f"max_steps is {max_steps}; it must be at least {FIRST_CHECK}")
    if path is not None and not Path(path).parent.is_dir():
        raise ValueError(f"{path}: there is no directory {Path(path).parent}")
    identity = _identity(problem, walkers, seed)
    chain = MemoryChain(walkers, count) if path is None else FileChain(path, walkers, count, identity, resume)
    try:
        initial = Mixture.of(fit) or Approximation.of(fit)
        while not _finished(chain, max_steps):
            state = chain.get_last_sample() if chain.iteration else _first_state(problem, initial, walkers, seed)
            sampler = _sampler(problem, walkers, chain, initial)
            target = min(_next_check(chain.iteration), max_steps)
            # walkers are drawn from a density of full rank: emcee need not look whether they are
            sampler.run_mcmc(state, target - chain.iteration, skip_initial_state_check=True)
            chain.checkpoint()
            if progress is not None:
                progress("sample", chain.iteration, None, _note(chain))
        chain.checkpoint()  # what a killed run left in the journal alone
    finally:
        chain.close()
    return _posterior(fit, chain, allow_short)


class NoSteps(ValueError):
    """A chain that has not begun."""


def load(fit: Fit, path: str | Path, *, allow_short: bool = False) -> Posterior:
    """The posterior kept in a file by `sample`, as far as it got. ValueError if the file is not a chain of this fit."""
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no chain")

    def expected(stored: dict[str, Any]) -> dict[str, Any]:
        return _identity(fit.problem, int(stored["walkers"]), int(stored["seed"]))

    chain = stored_chain(path, expected)
    if not chain.iteration:
        raise NoSteps(f"{path}: the chain has no steps yet")
    return _posterior(fit, chain, allow_short)


def _sampler(problem: Problem, walkers: int, chain: MemoryChain, initial: Proposals) -> emcee.EnsembleSampler:
    def log_posteriors(positions: Floats) -> Floats:
        return np.asarray(problem.call(_log_posteriors, positions), float)

    approximation = _adapted(chain, initial)
    moves = [(emcee.moves.MHMove(approximation.propose), INDEPENDENT), (emcee.moves.StretchMove(), 1.0 - INDEPENDENT)]
    return emcee.EnsembleSampler(
        walkers, len(problem.names), log_posteriors, moves=moves, vectorize=True, backend=chain
    )


def _adapted(chain: MemoryChain, initial: Proposals) -> Proposals:
    """The fit's approximation, or one learned from the second half of the chain up to its last check if that is closer.

    As checks grow apart, so the adaptation fades; and it depends on whole checks only, so that a resumed chain is the
    same.
    """
    _, check = _last_checks(chain.iteration)
    if not check:
        return initial
    positions = chain.chain[check // 2 : check]
    positions = positions.reshape(-1, positions.shape[-1])
    candidates: list[Proposals] = [initial, Approximation.learned(positions)]
    if isinstance(initial, Mixture):
        candidates.append(initial.refined(positions))
    return max(candidates, key=lambda candidate: candidate.mean_log_density(positions))


def _first_state(problem: Problem, approximation: Proposals, walkers: int, seed: int) -> emcee.State:
    def finite(positions: Floats) -> bool:
        return bool(np.all(np.isfinite(problem.call(_log_posteriors, positions))))

    generator = np.random.RandomState(seed)
    positions = first_positions(approximation.draw, finite, walkers, generator)
    return emcee.State(positions, random_state=generator.get_state())  # else emcee copies numpy's global state


def _log_posteriors(model: Model, positions: Array) -> Array:
    return jax.lax.map(model.log_posterior_unconstrained, positions)  # one walker fits the cache: twice as fast as vmap


def _over_samples(model: Model, vectors: Array) -> tuple[Array, Array, Array]:
    def one(vector: Array) -> tuple[Array, Array, Array]:
        return model.log_likelihood_per_datum(vector), model.predict(vector), model.sigma(vector)

    return jax.lax.map(one, vectors)


def _constrained(model: Model, positions: Array) -> Array:
    return jax.vmap(model.box.constrain)(positions)


def _next_check(step: int) -> int:
    """Checks come after 100, 200, ... steps, later a tenth further each: the same however often a run resumes."""
    check = FIRST_CHECK
    while check <= step:
        check += _interval(check)
    return check


def _interval(check: int) -> int:
    return FIRST_CHECK * max(1, round(check / BURN_IN / FIRST_CHECK))


def _last_checks(step: int) -> tuple[int, int]:
    """The last check up to this step, and the one before; 0 for none."""
    before, check, following = 0, 0, FIRST_CHECK
    while following <= step:
        before, check, following = check, following, following + _interval(following)
    return before, check


def _times(chain: MemoryChain, steps: int) -> Floats:
    kept = chain.chain[steps // BURN_IN : steps]
    with np.errstate(invalid="ignore"):  # a single step has no variance to divide by
        times = emcee.autocorr.integrated_time(kept, tol=0)
    return np.where(np.isfinite(times), times, math.inf)


def _converged(chain: MemoryChain) -> bool:
    before, check = _last_checks(chain.iteration)
    if not before:
        return False
    times, earlier = _times(chain, check), _times(chain, before)
    kept = check - check // BURN_IN
    return bool(np.all(kept > LONG_ENOUGH * times) and np.all(np.abs(times - earlier) < STEADY * times))


def _finished(chain: MemoryChain, max_steps: int) -> bool:
    if chain.iteration:
        return chain.iteration >= max_steps or (chain.iteration in _last_checks(chain.iteration) and _converged(chain))
    return False


def _note(chain: MemoryChain) -> str:
    longest = float(np.max(_times(chain, chain.iteration)))
    return f"autocorrelation time {longest:.0f}, needs {LONG_ENOUGH * longest * BURN_IN / (BURN_IN - 1):.0f} steps"


def _identity(problem: Problem, walkers: int, seed: int) -> dict[str, Any]:
    """What tells one sampling from another: names, bounds, settings, and the posterior itself at a few points."""
    points = 0.01 + 0.98 * qmc.Sobol(len(problem.names), scramble=False).random_base2(2)  # in the unit box
    posteriors = problem.call(_log_posteriors, logit(points))
    return {
        "names": "\n".join(problem.names),
        "bounds": np.stack([problem.low, problem.high]),
        "posterior": np.asarray(posteriors, float),
        "walkers": walkers,
        "seed": seed,
    }


def _posterior(fit: Fit, chain: MemoryChain, allow_short: bool) -> Posterior:
    positions = chain.get_chain()
    times = _times(chain, len(positions))
    return Posterior(
        fit=fit,
        chain=np.asarray(fit.problem.call(_constrained, positions.reshape(-1, positions.shape[-1]))).reshape(
            positions.shape
        ),
        log_probability=chain.get_log_prob(),
        autocorrelation_time=times,
        acceptance=float(np.mean(chain.accepted) / chain.iteration),
        converged=_converged(chain),
        allow_short=allow_short,
    )
