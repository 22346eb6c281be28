"""What a chain of samples says about the parameters of a fit: estimates, predictions, and how far to trust them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits._lazy import shown_by
from fits.optimise.result import Fit
from fits.problem.discrepancy import logarithm
from fits.problem.model import Model
from fits.sampling.chain import MemoryChain
from fits.sampling.convergence import (
    BURN_IN,
    LONG_ENOUGH,
    MIXED,
    autocorrelation_times,
    long_enough,
    r_hat,
)
from fits.sampling.mixture import MODES, Mixture
from layerjax._checks import require_kind

if TYPE_CHECKING:
    from arviz import InferenceData

REPORTED_DRAWS = 2048
LOOKED_AT = 1000
"""Steps of a chain by which shares of modes are told."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Mode:
    """A mode of a posterior: the share of it, its standard error as walkers scatter about it, and the mean of the
    parameters there, by name."""

    share: float
    error: float
    values: dict[str, float]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Chains of P parameters, an ensemble of walkers or a few of NUTS, and what they say.

    Attributes:
        chain: (steps, walkers, P), physical values, from the start on.
        log_probability: (steps, walkers), of the unconstrained coordinates, not normalised.
        autocorrelation_time: (P,), in steps, of the chain without its first tenth.
        acceptance: mean share of proposals taken; of NUTS, of steps that moved.
        converged: the chain without its first tenth is longer than 50 autocorrelation times of every parameter,
            and R-hat is below 1.05.
        allow_unconverged: estimates may be had from a chain that has not converged.
        status: what is to be said of the sampler, if anything.
        divergences: steps of NUTS that lost their way, where the posterior is too narrow for them.
        modes: where the fit knows several minima that hold a share of the posterior: these, the largest share first.
            Estimates are of all of them together. Empty where one is known.
    """

    fit: Fit
    chain: Floats
    log_probability: Floats
    autocorrelation_time: Floats
    acceptance: float
    converged: bool
    allow_unconverged: bool = False
    status: str = ""
    divergences: int = 0
    modes: tuple[Mode, ...] = ()

    def __repr__(self) -> str:
        steps, walkers = self.chain.shape[:2]
        ended = "converged" if self.converged else "not converged"
        modes = f", {len(self.modes)} modes" if self.modes else ""
        return f"<Posterior of {', '.join(self.names)}: {steps} steps of {walkers} walkers, {ended}{modes}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.reports.html:posterior_fragment", self))

    def part(self, name: str) -> "Posterior":
        """What the posterior of a `Joint` says of one measurement. ValueError for a name that none has."""
        fit = self.fit.part(name)
        own = list(self.fit.problem.places(name))
        whole = {plain: self.names[place] for plain, place in zip(fit.problem.names, own, strict=True)}
        modes = tuple(
            replace(mode, values={plain: mode.values[name] for plain, name in whole.items()}) for mode in self.modes
        )
        time = self.autocorrelation_time[own]
        return replace(self, fit=fit, chain=self.chain[..., own], autocorrelation_time=time, modes=modes)

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
    def r_hat(self) -> Floats:
        """Rank-normalised split R-hat of each parameter, (P,): 1 where all walkers tell the same, above 1.01 where some
        do not yet, or stay in modes of their own."""
        return r_hat(self.chain)

    @cached_property
    def samples(self) -> Floats:
        """Thinned samples after the burn-in, (S, P), in physical units."""
        self._require_converged()
        return self.chain[self.burn_in :: self.thin].reshape(-1, len(self.names))

    def summary(self) -> dict[str, tuple[float, float, float, float, float]]:
        """For each parameter: median, ends of the central 68 % interval, mean, standard deviation.

        Raises ValueError for a chain that has not converged, unless it was sampled with `allow_unconverged`.
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
        Simulated readings share errors that are drawn anew, where `predict` has those that the data tell of.
        ValueError for a fit of several measurements: ask `part`.
        """
        self.fit.require_one("inference_data")
        self._require_converged()
        import arviz

        steps, walkers, count = self.chain[self.burn_in :].shape
        draws = min(max(REPORTED_DRAWS // walkers, 1), steps)
        picked = np.linspace(0, steps - 1, draws).astype(int)
        chosen = np.swapaxes(self.chain[self.burn_in :][picked], 0, 1)
        problem, generator = self.fit.problem, np.random.default_rng(0)
        shape, process = (walkers, draws, *problem.model.values.shape), problem.model.process
        white = generator.standard_normal((walkers * draws, shape[-1], 0 if process is None else len(process.where)))
        density, expected, sigma = problem.call(_over_samples, chosen.reshape(-1, count), white)
        student = problem.noise.tails == "student"
        freedom = problem.noise.degrees_of_freedom
        noise = generator.standard_t(freedom, shape) if student else generator.standard_normal(shape)
        simulated = np.asarray(expected).reshape(shape) + np.asarray(sigma).reshape(shape) * noise
        return arviz.from_dict(
            posterior={name: chosen[..., index] for index, name in enumerate(self.names)},
            log_likelihood={"value": np.asarray(density).reshape(shape)},
            posterior_predictive={"value": simulated},
            observed_data={"value": np.asarray(problem.model.values)},
            dims={"value": ["sample", "channel"]},
            coords={"channel": list(problem.data.channels)},
        )

    def _require_converged(self) -> None:
        if self.converged or self.allow_unconverged:
            return
        raise ValueError(
            f"the chain of {len(self.chain)} steps is too short to report from: its longest autocorrelation time is "
            f"{np.max(self.autocorrelation_time):.0f} steps, and {LONG_ENOUGH:.0f} of them after burn-in are needed, "
            f"with R-hat below {MIXED:g} (it is {np.max(self.r_hat):.3g}); sample again with "
            "the same path and a larger max_steps to go on, or with allow_unconverged=True"
        )


def posterior_of(fit: Fit, chain: MemoryChain, allow_unconverged: bool = False) -> Posterior:
    """What a chain of a fit's posterior says."""
    positions, moves = chain.get_chain(), chain.moves
    count = positions.shape[-1]
    values = np.asarray(fit.problem.call(_constrained, positions.reshape(-1, count))).reshape(positions.shape)
    taken = float(np.mean(chain.accepted) / chain.iteration)
    divergences, words = 0, str(moves.get("words", ""))
    if moves.get("sampler") == "nuts":
        divergences = round((1.0 - taken) * positions[..., 0].size)  # what its records hold
        taken = float(np.mean(np.any(np.diff(positions, axis=0), axis=-1))) if len(positions) > 1 else 1.0
        words = f"NUTS, {divergences} divergent steps of {positions[..., 0].size}"
        words += ", near which it may have missed a part of the posterior" if divergences else ""
    return Posterior(
        fit=fit,
        chain=values,
        log_probability=chain.get_log_prob(),
        autocorrelation_time=autocorrelation_times(chain, len(positions)),
        acceptance=taken,
        converged=long_enough(chain),
        allow_unconverged=allow_unconverged,
        status=words,
        divergences=divergences,
        modes=_modes(fit, moves, positions, values),
    )


def _modes(fit: Fit, moves: dict[str, Any], positions: Floats, values: Floats) -> tuple[Mode, ...]:
    """Where the samples are, if the chain was begun with several modes: positions and values (steps, walkers, P)."""
    if not Mixture.within(moves, MODES):
        return ()
    kept = slice(len(positions) // BURN_IN, None, max(1, len(positions) // LOOKED_AT))
    positions, values = positions[kept], values[kept]
    which = Mixture.from_arrays(moves, MODES).mode_of(positions.reshape(-1, positions.shape[-1]))
    which = which.reshape(positions.shape[:2])
    found = []
    for mode in np.unique(which):
        shares, at = np.mean(which == mode, axis=0), values[which == mode].mean(axis=0)
        error = float(np.std(shares, ddof=1) / math.sqrt(len(shares)))
        found.append(Mode(float(np.mean(shares)), error, dict(zip(fit.problem.names, map(float, at), strict=True))))
    return tuple(sorted(found, key=lambda mode: -mode.share))


def _over_samples(model: Model, vectors: Array, white: Array) -> tuple[Array, Array, Array]:
    """Of each vector, with white numbers (C, R) of its own for what readings share: log-densities of the data, and
    what readings scatter about, by how much; (N, C) each."""

    def one(given: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        vector, numbers = given
        predicted = expected = model.predict(vector)
        if model.process is not None:
            at = model.build(vector).correlation
            assert at is not None
            assert model.softness is not None
            lack = model.process.sample(numbers, at)
            expected = model.softness * jnp.sinh(logarithm(predicted, model.softness) + lack)
        return model.log_likelihood_per_datum_at(vector, predicted), expected, model.sigma_at(vector, expected)

    return jax.lax.map(one, (vectors, white))


def _constrained(model: Model, positions: Array) -> Array:
    return jax.vmap(model.box.constrain)(positions)


def require_fits(candidates: object) -> None:
    """Refuse what are no fits or posteriors by name."""
    require_kind("candidates", candidates, Mapping)
    for name, one in cast(Mapping[str, object], candidates).items():
        require_kind(f"candidates[{name!r}]", one, Fit, Posterior)
