"""What a chain of samples says about the parameters of a fit: estimates, predictions, and how far to trust them."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fits._lazy import shown_by
from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.problem.discrepancy import Correlation, logarithm
from fits.problem.model import Model
from fits.sampling.chain import Chain
from fits.sampling.convergence import Convergence, after_burn_in
from fits.sampling.mixture import Mixture
from fits.sampling.options import SamplerOptions

if TYPE_CHECKING:
    from arviz import InferenceData

REPORTED_DRAWS = 2048
MODE_STEPS = 1000  # of a chain, by which shares of modes are estimated


@dataclass(frozen=True)
class Mode:
    """A mode of a posterior: its share, the standard error of the share, and the mean parameters by name."""

    share: float
    error: float
    values: dict[str, float]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of P parameters: chains of an ensemble of walkers (emcee) or of NUTS.

    Attributes:
        chain: (steps, walkers, P), in physical units, with the burn-in.
        log_probability: (steps, walkers), of the unconstrained coordinates, not normalised.
        autocorrelation_time: (P,), in steps, of the chain without its burn-in.
        acceptance: mean acceptance; for NUTS, the share of steps that moved.
        converged: whether the chain meets the thresholds of `options`.
        allow_unconverged: whether estimates are allowed from a chain that has not converged.
        status: remarks of the sampler, if any.
        divergences: number of divergences of NUTS after its warm-up.
        modes: modes of the posterior, the largest first, if there are several. Estimates are of all of them together.
        options: the options of the sampler.
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
    options: SamplerOptions = field(default_factory=SamplerOptions)

    def __repr__(self) -> str:
        steps, walkers = self.chain.shape[:2]
        ended = "converged" if self.converged else "not converged"
        modes = f", {len(self.modes)} modes" if self.modes else ""
        return f"<Posterior of {', '.join(self.names)}: {steps} steps of {walkers} walkers, {ended}{modes}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.reports.html:posterior_fragment", self))

    def part(self, name: str) -> "Posterior":
        """Posterior of one data set of a `Joint`. ValueError for an unknown name."""
        fit = self.fit.part(name)
        own = list(self.fit.problem.places(name))
        whole = {plain: self.names[place] for plain, place in zip(fit.problem.names, own, strict=True)}
        values = [{plain: mode.values[name] for plain, name in whole.items()} for mode in self.modes]
        modes = tuple(replace(mode, values=its) for mode, its in zip(self.modes, values, strict=True))
        time = self.autocorrelation_time[own]
        return replace(self, fit=fit, chain=self.chain[..., own], autocorrelation_time=time, modes=modes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.fit.problem.names

    @property
    def burn_in(self) -> int:
        """Number of steps at the start that estimates do not use."""
        return len(self.chain) - len(after_burn_in(self.chain, self.options))

    @property
    def thin(self) -> int:
        """Steps between two draws of `samples`, half the shortest autocorrelation time."""
        shortest = float(np.min(self.autocorrelation_time))
        return max(1, int(shortest / 2)) if math.isfinite(shortest) else 1

    @cached_property
    def convergence(self) -> Convergence:
        """Effective sample size, autocorrelation time and R-hat of each parameter."""
        return Convergence.of(self.chain, self.options)

    @property
    def effective_samples(self) -> Floats:
        """Effective sample size of each parameter, (P,), the smaller of bulk and tail as ArviZ defines them."""
        return self.convergence.ess

    @property
    def r_hat(self) -> Floats:
        """Rank-normalised R-hat between halves of groups of walkers, of each parameter, (P,)."""
        return self.convergence.r_hat

    @cached_property
    def samples(self) -> Floats:
        """Thinned samples after the burn-in, (S, P), in physical units."""
        self._require_converged()
        return after_burn_in(self.chain, self.options)[:: self.thin].reshape(-1, len(self.names))

    def summary(self) -> dict[str, tuple[float, float, float, float, float]]:
        """For each parameter: median, ends of the central 68 % interval, mean, standard deviation.

        Raises ValueError for a chain that has not converged, unless it was sampled with `allow_unconverged`.
        """
        self._require_converged()
        kept = after_burn_in(self.chain, self.options).reshape(-1, len(self.names))
        quantiles = np.quantile(kept, [0.5, 0.158655, 0.841345], axis=0)
        columns = np.stack([*quantiles, kept.mean(axis=0), kept.std(axis=0)], axis=-1).tolist()
        return {name: tuple(row) for name, row in zip(self.names, columns, strict=True)}

    @cached_property
    def inference_data(self) -> "InferenceData":
        """ArviZ data with posterior, log_likelihood of each datum, posterior_predictive with noise, and observed_data.

        A walker is a chain. Draws are thinned so that about 2,000 remain: they serve predictions and model comparison.
        The discrepancy of simulated measurements is drawn anew, where `predict` has that of the data.
        ValueError for a joint fit; use `part`.
        """
        self.fit.require_one("inference_data")
        self._require_converged()
        import arviz
        from xarray import Dataset, DataTree

        kept = after_burn_in(self.chain, self.options)
        steps, walkers, count = kept.shape
        draws = min(max(REPORTED_DRAWS // walkers, 1), steps)
        chosen = np.swapaxes(kept[np.linspace(0, steps - 1, draws).astype(int)], 0, 1)
        problem, generator = self.fit.problem, np.random.default_rng(0)
        shape, process = (walkers, draws, *problem.model.values.shape), problem.model.process
        white = generator.standard_normal((walkers * draws, shape[-1], 0 if process is None else len(process.where)))
        density, expected, sigma = problem.call(_over_samples, chosen.reshape(-1, count), white)
        student = problem.noise.tails == "student"
        freedom = problem.noise.degrees_of_freedom
        noise = generator.standard_t(freedom, shape) if student else generator.standard_normal(shape)
        simulated = np.asarray(expected).reshape(shape) + np.asarray(sigma).reshape(shape) * noise
        draw, datum = ("chain", "draw"), ("sample", "channel")
        at_draws = {"chain": np.arange(walkers), "draw": np.arange(draws)}
        at = {"sample": np.arange(shape[2]), "channel": list(problem.data.channels)}
        groups = {
            "posterior": Dataset({name: (draw, chosen[..., place]) for place, name in enumerate(self.names)}, at_draws),
            "log_likelihood": Dataset({"value": (draw + datum, np.asarray(density).reshape(shape))}, at_draws | at),
            "posterior_predictive": Dataset({"value": (draw + datum, simulated)}, at_draws | at),
            "observed_data": Dataset({"value": (datum, np.asarray(problem.model.values))}, at),
        }
        tree, old = DataTree.from_dict(groups), hasattr(arviz, "InferenceData")  # which is a tree from ArviZ 1.0 on
        return cast("InferenceData", arviz.InferenceData.from_datatree(tree) if old else tree)

    def _require_converged(self) -> None:
        if self.converged or self.allow_unconverged:
            return
        raise ValueError(
            f"the chain of {len(self.chain)} steps is too short to report from: its longest autocorrelation time is "
            f"{np.max(self.autocorrelation_time):.0f} steps, and {self.options.autocorrelation_times:g} of them after "
            f"burn-in are needed, with R-hat of at most {self.options.r_hat:g} (it is {np.max(self.r_hat):.3g}); "
            "sample again with the same path and a larger max_steps to go on, or with allow_unconverged=True"
        )


def posterior_of(fit: Fit, chain: Chain, allow_unconverged: bool = False) -> Posterior:
    """What a chain of a fit's posterior says."""
    positions, options = chain.steps(), SamplerOptions(**chain.options)
    count, nuts = positions.shape[-1], "metrics" in chain.moves
    values = np.asarray(fit.problem.call(_constrained, positions.reshape(-1, count))).reshape(positions.shape)
    taken, divergences, status = float(np.mean(chain.accepted) / chain.iteration), 0, ""
    if nuts:  # whose records hold which steps did not diverge
        divergences = round((1.0 - taken) * positions[..., 0].size)
        taken = float(np.mean(np.any(np.diff(positions, axis=0), axis=-1))) if len(positions) > 1 else 1.0
        status = f"NUTS, {divergences} divergences in {positions[..., 0].size} steps after the warm-up"
        status += ", near which it may have missed a part of the posterior" if divergences else ""
    found = Convergence.of(positions, options)
    return Posterior(
        fit=fit,
        chain=values,
        log_probability=chain.log_prob[: chain.iteration],
        autocorrelation_time=found.autocorrelation_time,
        acceptance=taken,
        converged=found.is_converged(options),
        allow_unconverged=allow_unconverged,
        status=status,
        divergences=divergences,
        modes=_modes(fit, Mixture(**chain.moves["mixture"]), positions, values, options),
        options=options,
    )


def _modes(fit: Fit, initial: Mixture, positions: Floats, values: Floats, options: SamplerOptions) -> tuple[Mode, ...]:
    """Where the samples are, if the chain began with several modes: positions and values (steps, walkers, P)."""
    if initial.mode_count == 1:
        return ()
    every = max(1, len(positions) // MODE_STEPS)
    positions, values = (after_burn_in(part, options)[::every] for part in (positions, values))
    which = initial.mode_of(positions.reshape(-1, positions.shape[-1])).reshape(positions.shape[:2])
    found = []
    for mode in np.unique(which):
        shares, at = np.mean(which == mode, axis=0), values[which == mode].mean(axis=0)
        error = float(np.std(shares, ddof=1) / math.sqrt(len(shares)))
        found.append(Mode(float(np.mean(shares)), error, dict(zip(fit.problem.names, map(float, at), strict=True))))
    return tuple(sorted(found, key=lambda mode: -mode.share))


def _over_samples(model: Model, vectors: Array, white: Array) -> tuple[Array, Array, Array]:
    """Of each vector, with white numbers (C, R) of its own for the discrepancy: log-densities of the data, and
    what measurements scatter about, by how much; (N, C) each."""

    def one(row: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        vector, numbers = row
        predicted = expected = model.predict(vector)
        if model.process is not None and model.softness is not None:
            discrepancy = model.process.sample(numbers, cast(Correlation, model.build(vector).correlation))
            expected = model.softness * jnp.sinh(logarithm(predicted, model.softness) + discrepancy)
        return model.log_likelihood_per_datum_at(vector, predicted), expected, model.sigma_at(vector, expected)

    return jax.lax.map(one, (vectors, white))


def _constrained(model: Model, positions: Array) -> Array:
    return jax.vmap(model.box.constrain)(positions)
