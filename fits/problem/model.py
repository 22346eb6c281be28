"""What a vector of parameters predicts, and how far that is from the data: pure functions that compile once.

A model holds a problem as arrays and static choices, so that one compiled program serves every problem of the same
structure and shape: new data, bounds or fixed numbers do not recompile. `Model` is that of one data set, `JointModel`
that of several.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from fits.names import Objective
from fits.problem.discrepancy import Correlation, Process, Whitened, logarithm, project, size
from fits.problem.instrument import Optics, Setting
from fits.problem.noise import (
    Tails,
    information_weights,
    level_residual,
    log_density,
    named_residual,
    tail_residual,
    total_sigma,
)
from fits.problem.parameters import Box, Template, with_values
from layerjax._shapes import require_single
from layerjax.evaluate import evaluate_known
from layerjax.transport.known_directions import KnownDirections, KnownPairs

Transport = lj.Transport | Literal["auto"] | Callable[[Any, Array, Array], Array]
"""How the values are computed: a layerjax transport, `"auto"`, or any callable in the place of one.

A callable takes the stack with numbers in place of its free parameters, and unit directions wi and wo, (N, 3) each,
and returns the BSDF in 1/sr, (N, C). JAX traces and differentiates it, and it must be hashable, as functions are.
"""

Side = Literal["all", "reflection"]

Step = tuple[Array, Array] | None
"""What stands in the place of sigma, (N, C), where it is finite, and the share of the model discrepancy that counts, on
the way to a fit of levels of noise; None: all is free."""


class Parts(NamedTuple):
    """What a vector of parameters stands for: the stack, the common scale, and the levels of the noise model.

    instrument, correlation: None without an instrument, or a model discrepancy.
    """

    stack: Any
    scale: Array
    instrument: Setting | None
    relative: Array
    floor: Array
    correlation: Correlation | None


class Linearisation(NamedTuple):
    """What a model predicts, (N, C), in 1/sr, with slopes by the first parameters, (M, N, C), at these values, (M,)."""

    values: Any
    slopes: Any
    at: Any

    def predict(self, model: "Model", vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr, of the model near there."""
        return self.values + jnp.tensordot(vector[: len(self.at)] - self.at, self.slopes, 1)


class Model(eqx.Module):
    """Pure functions of the physical vector (P,): predictions, residuals and log-densities of one data set.

    What ends with `_at` takes what the vector predicts, (N, C), beside it, so that nothing is computed twice.

    template: of `Parts`. box: bounds and priors of the P parameters. wi, wo: directions of the N samples, (N, 3).
    values: BSDF, (N, C), in 1/sr. variance: the measurement's own, (N, C), in 1/sr^2. least_floor: of the
    noise, in 1/sr. known: what is known of the directions beforehand. optics: how an instrument sees them, None
    for exact directions. process: the model discrepancy, with the softness of its `logarithm`, (N, C), in 1/sr; None
    without. side: "reflection" if all directions lie above. varying: whether sigma depends on the parameters. moving:
    so many of them come first, on which predictions depend; the others are those of the noise. stand_in: whose
    `predict(model, vector)` takes the place of what the transport says, if any: a `Linearisation` or an emulator.
    """

    template: Template
    box: Box
    wi: Array
    wo: Array
    values: Array
    variance: Array
    least_floor: Array
    degrees_of_freedom: Array
    transport: Transport
    known: KnownDirections | KnownPairs | None
    optics: Optics | None
    process: Process | None
    softness: Array | None
    side: Side = eqx.field(static=True)
    objective: Objective = eqx.field(static=True)
    tails: Tails = eqx.field(static=True)
    varying: bool = eqx.field(static=True)
    moving: int = eqx.field(static=True)
    stand_in: Any = None

    @property
    def lowest(self) -> Array:
        """What sigma cannot fall below, (N, C), in 1/sr."""
        return jnp.hypot(jnp.sqrt(self.variance), self.least_floor)

    def residuals(self, vector: Array) -> tuple[Array, ...]:
        """`residuals_at` what these parameters predict."""
        return self.linear_parts(vector)[0]

    def cost_at(self, vector: Array, predicted: Array) -> Array:
        """Half the sum of squared residuals."""
        return 0.5 * jnp.sum(jnp.stack([jnp.sum(part**2) for part in self.residuals_at(vector, predicted)]))

    def log_likelihood(self, vector: Array) -> Array:
        """Normalised log-likelihood of all data."""
        return self.log_likelihood_at(vector, self.predict(vector))

    def log_prior(self, vector: Array) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.box.log_prior(vector)

    def log_posterior_unconstrained(self, u: Array) -> Array:
        """Log-posterior (not normalised) as a density over the unconstrained vector; -inf where undefined."""
        vector = self.box.constrain(u)
        total = self.log_likelihood(vector) + self.box.log_prior(vector) + self.box.log_determinant(u)
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def with_projection(self) -> "Model":
        """The model with what its measurements say of inducing points, where that depends on no parameter."""
        if self.process is None or self.varying:
            return self
        parts = self.build(self.box.low)
        # by numpy, as JAX would compile each step
        values, variance, relative, floor, softness, weights = (
            np.asarray(one, float)
            for one in (self.values, self.variance, parts.relative, parts.floor, self.softness, self.process.weights)
        )
        projection = project(weights, size(values, softness) / total_sigma(values, variance, relative, floor))
        return replace(self, process=replace(self.process, projection=jax.tree.map(jnp.asarray, projection)))

    def linearised(self, known: Sequence[Linearisation]) -> "Model":
        """The model near the vector (P,) that its one data set was linearised at."""
        return replace(self, stand_in=known[0])

    @property
    def nothing_known(self) -> list[Linearisation]:
        """In the shape of what `linearised` asks for, of the one data set."""
        slopes = jnp.zeros((self.moving, *self.values.shape), self.values.dtype)
        return [Linearisation(jnp.zeros_like(self.values), slopes, self.box.low[: self.moving])]

    def build(self, vector: Array) -> Parts:
        """Stack, scale and noise levels with these parameters."""
        return Parts(*with_values(self.template.fill(vector)))

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr: a stack of one channel has the same in all."""
        if self.stand_in is not None:
            return self.stand_in.predict(self, vector)
        parts = self.build(vector)

        def values(wi: Array, wo: Array, known: KnownDirections | KnownPairs | None) -> Array:
            return forward(parts.stack, wi, wo, self.transport, self.side, known)

        if self.optics is None:
            found = parts.scale * values(self.wi, self.wo, self.known)
        else:
            found = parts.scale * self.optics.measured(values, cast(Setting, parts.instrument), len(self.wi))
        return found if found.shape[-1] > 1 else jnp.broadcast_to(found, (len(found), self.values.shape[-1]))

    def sigma_at(self, vector: Array, predicted: Array) -> Array:
        """Scale of the noise, (N, C), in 1/sr."""
        parts = self.build(vector)
        return total_sigma(predicted, self.variance, parts.relative, parts.floor)

    def standardised_at(self, vector: Array, predicted: Array) -> Array:
        """(datum - model) / sigma, (N, C): with model discrepancy of the `logarithm`, in units of the datum's noise.

        For a named objective: datum minus model in its own measure.
        """
        if self.objective != "likelihood":
            return -self._named(predicted)
        if self.process is None:
            return (self.values - predicted) / self._noise_at(vector, predicted)
        misfit, relative, _ = self._of_process(vector, predicted)
        return -relative * misfit

    def offsets_after_discrepancy_at(self, vector: Array, predicted: Array) -> Array:
        """`standardised_at`, less the model discrepancy that the data imply."""
        if self.process is None:
            return self.standardised_at(vector, predicted)
        return -self.leave_one_out_at(vector, predicted)[0]

    def whitened_residuals_at(self, vector: Array, predicted: Array) -> Array:
        """`standardised_at` by the root of their covariance: under the assumed model independent, with variance 1."""
        if self.process is None:
            return self.standardised_at(vector, predicted)
        return -self.process.whitened_residuals(*self._of_process(vector, predicted))

    def whitened_at(self, vector: Array, predicted: Array, step: Step = None) -> Whitened:
        """Independent residuals of the measurements and of the errors at inducing points."""
        assert self.process is not None
        return self.process.whitened(*self._of_process(vector, predicted, step))

    def leave_one_out_at(self, vector: Array, predicted: Array) -> tuple[Array, Array]:
        """Residuals less the model discrepancy that the data imply, and precisions given all others, (N, C)."""
        assert self.process is not None
        return self.process.leave_one_out(*self._of_process(vector, predicted))

    def discrepancy_at(self, vector: Array, predicted: Array, places: Array) -> tuple[Array, Array]:
        """The model discrepancy at other `places`, as far as the data tell: mean and sd of the logarithm, (M, C)."""
        assert self.process is not None
        return self.process.predict(places, *self._of_process(vector, predicted))

    @property
    def logarithmic(self) -> tuple[int, ...]:
        """Places, among `residuals`, of those whose half squares are logarithms of levels of noise."""
        return tuple(range(2, 2 + self.varying + (self.process is not None)))

    def initial_sigma(self, vector: Array) -> Array:
        """A scale of the noise, (N, C), in 1/sr, by which no measurement near 0 stands out: a fit begins with it."""
        parts = self.build(vector)
        typical = jnp.mean(jnp.abs(self.values))  # a tenth of it keeps data near 0 from outweighing all others
        return total_sigma(jnp.abs(self.values) + 0.1 * typical, self.variance, parts.relative, parts.floor)

    def linear_parts(self, vector: Array, step: Step = None) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        """`residuals`; and what is predicted, (N, C), with the rows (rows,) of the data's Fisher information.

        The Jacobian A of these rows has the Fisher information A'A. The expected information needs first derivatives
        only and is never indefinite; for Gaussian noise that is known it is J'J. For a named objective: its residuals.
        """
        predicted = self.predict(vector)
        whitened = None if self.process is None else self.whitened_at(vector, predicted, step)
        residuals = self.residuals_at(vector, predicted, step, whitened)
        return residuals, (predicted, self._information_rows(vector, predicted, whitened))

    def log_likelihood_per_datum_at(self, vector: Array, predicted: Array) -> Array:
        """Normalised log-density of each datum, (N, C); with model discrepancy, given all others."""
        sigma = self._noise_at(vector, predicted)
        if self.process is None:
            z = (self.values - predicted) / sigma
            return log_density(z, sigma, self.tails, self.degrees_of_freedom)
        own, precision = self.leave_one_out_at(vector, predicted)
        width = sigma / jnp.sqrt(precision)
        return log_density(own / jnp.sqrt(precision), width, self.tails, self.degrees_of_freedom)

    def log_likelihood_at(self, vector: Array, predicted: Array) -> Array:
        """Normalised log-likelihood of all data."""
        if self.process is None:
            return jnp.sum(self.log_likelihood_per_datum_at(vector, predicted))
        sigma = self._noise_at(vector, predicted)
        found = self.whitened_at(vector, predicted)
        squares = jnp.sum(found.unfitted**2) + jnp.sum(found.estimates**2)
        levels = jnp.sum(found.levels) + jnp.sum(jnp.log(sigma))
        return -0.5 * squares - levels - 0.5 * self.values.size * math.log(2.0 * math.pi)

    def _named(self, predicted: Array) -> Array:
        assert self.objective != "likelihood"
        return named_residual(self.objective, predicted, self.values, jnp.abs(self.wi[:, 2:]))

    def _noise_at(self, vector: Array, predicted: Array, step: Step = None) -> Array:
        """`sigma_at`; with model discrepancy of the datum, so that it does not depend on what is predicted."""
        sigma = self.sigma_at(vector, predicted if self.process is None else self.values)
        return sigma if step is None or not self.varying else jnp.where(jnp.isfinite(step[0]), step[0], sigma)

    def _of_process(self, vector: Array, predicted: Array, step: Step = None) -> tuple[Array, Array, Correlation]:
        """Misfit of the logarithm, an error of 1 in it in units of the noise, and the numbers of the process."""
        misfit = logarithm(predicted, self.softness) - logarithm(self.values, self.softness)
        relative = size(self.values, self.softness) / self._noise_at(vector, predicted, step)
        at = cast(Correlation, self.build(vector).correlation)
        return misfit, relative, at if step is None else at._replace(amplitude=step[1] * at.amplitude)

    def residuals_at(
        self, vector: Array, predicted: Array, step: Step = None, whitened: Whitened | None = None
    ) -> tuple[Array, ...]:
        """Arrays whose half sum of squares is minus the log-posterior up to a constant, or the named objective: of the
        data, of the prior, and those of levels of noise (see `logarithmic`). whitened: at these, if known."""
        if self.objective != "likelihood":
            return (self._named(predicted),)
        sigma = self._noise_at(vector, predicted, step)
        levels = [level_residual(jnp.log(jnp.maximum(sigma / self.lowest, 1.0)))] if self.varying else []
        if self.process is None:
            data = tail_residual((predicted - self.values) / sigma, self.tails, self.degrees_of_freedom)
        else:
            if whitened is None:
                whitened = self.whitened_at(vector, predicted, step)
            data = jnp.concatenate([whitened.unfitted.reshape(-1), whitened.estimates])
            levels.append(level_residual(whitened.levels))
        return (data, self.box.prior_residuals(vector), *levels)

    def _information_rows(self, vector: Array, predicted: Array, whitened: Whitened | None) -> Array:
        if self.objective != "likelihood":
            return self._named(predicted).reshape(-1)
        of_mean, of_level = information_weights(self.tails, self.degrees_of_freedom)
        sigma = self._noise_at(vector, predicted)
        scaled = (predicted / jax.lax.stop_gradient(sigma)).reshape(-1) if whitened is None else whitened.information
        levels = [jnp.sqrt(of_level) * jnp.log(sigma).reshape(-1)] if self.varying else []
        return jnp.concatenate([jnp.sqrt(of_mean) * scaled, *levels])


def linearise(model: Model, vector: Array) -> Linearisation:
    """Values and slopes at a vector (P,), by the parameters that predictions depend on."""
    steps = jnp.eye(vector.size, dtype=vector.dtype)[: model.moving]
    along = jax.vmap(lambda step: jax.jvp(model.predict, (vector,), (step,)), out_axes=(None, 0))
    values, slopes = along(steps)
    return Linearisation(values, slopes, vector[: model.moving])


def predict_each(model: Model, vectors: Array) -> Array:
    """What each of the vectors (D, P) predicts, (D, N, C), in 1/sr."""
    return jax.lax.map(model.predict, vectors)


class JointModel(eqx.Module):
    """Of several data sets, one after the other, (N, 1), the same functions as of one: the product of their densities.

    places: for each data set, the places of its parameters in the vector.
    """

    parts: tuple[Model, ...]
    box: Box
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    varying: bool = eqx.field(static=True)
    objective: Objective = eqx.field(static=True, default="likelihood")  # which weighs data sets by their noise

    residuals, cost_at, log_prior = Model.residuals, Model.cost_at, Model.log_prior
    log_likelihood, log_posterior_unconstrained = Model.log_likelihood, Model.log_posterior_unconstrained

    def linearised(self, known: Sequence[Linearisation]) -> "JointModel":
        """The model near the vector (P,) that its data sets were linearised at."""
        return replace(self, parts=tuple(part.linearised([one]) for part, one in zip(self.parts, known, strict=True)))

    @property
    def nothing_known(self) -> list[Linearisation]:
        """In the shape of what `linearised` asks for."""
        return [known for part in self.parts for known in part.nothing_known]

    @property
    def values(self) -> Array:
        """BSDF of all measurements, (N, 1), in 1/sr."""
        return _column([part.values for part in self.parts])

    @property
    def logarithmic(self) -> tuple[int, ...]:
        return (2,) if any(part.logarithmic for part in self.parts) else ()

    def predict(self, vector: Array) -> Array:
        return _column([part.predict(own) for part, own in self._with_vectors(vector)])

    def initial_sigma(self, vector: Array) -> Array:
        return _column([part.initial_sigma(own) for part, own in self._with_vectors(vector)])

    def whitened_residuals_at(self, vector: Array, predicted: Array) -> Array:
        return _column(self._each(Model.whitened_residuals_at, vector, predicted))

    def log_likelihood_per_datum_at(self, vector: Array, predicted: Array) -> Array:
        return _column(self._each(Model.log_likelihood_per_datum_at, vector, predicted))

    def log_likelihood_at(self, vector: Array, predicted: Array) -> Array:
        return jnp.sum(jnp.stack(self._each(Model.log_likelihood_at, vector, predicted)))

    def residuals_at(self, vector: Array, predicted: Array) -> tuple[Array, ...]:
        return self._together(vector, self._each(Model.residuals_at, vector, predicted))

    def linear_parts(self, vector: Array, step: Step = None) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        """Each data set is differentiated by its own parameters alone."""
        steps: list[Step] = [None] * len(self.parts)
        if step is not None:
            sigmas = [step[0]] * len(self.parts) if step[0].size == 1 else self.split(step[0])
            steps = [(sigma, step[1]) for sigma in sigmas]
        each = self._with_vectors(vector)
        found = [part.linear_parts(own, step) for (part, own), step in zip(each, steps, strict=True)]
        predicted, rows = _column([values for _, (values, _) in found]), [rows for _, (_, rows) in found]
        return self._together(vector, [residuals for residuals, _ in found]), (predicted, jnp.concatenate(rows))

    def _together(self, vector: Array, each: Sequence[tuple[Array, ...]]) -> tuple[Array, ...]:
        """Residuals of all: data, prior, levels of noise."""
        levels = [level.reshape(-1) for _, _, *levels in each for level in levels]
        data = jnp.concatenate([residuals[0].reshape(-1) for residuals in each])
        return (data, self.box.prior_residuals(vector), *([jnp.concatenate(levels)] if levels else []))

    def _with_vectors(self, vector: Array) -> list[tuple[Model, Array]]:
        return [(part, vector[np.array(places)]) for part, places in zip(self.parts, self.places, strict=True)]

    def split(self, column: Any) -> list[Any]:
        """What of a column (N, 1) belongs to each data set, in the shape of its values."""
        ends = pairwise(np.cumsum([0, *(part.values.size for part in self.parts)]))
        return [column[a:b].reshape(part.values.shape) for part, (a, b) in zip(self.parts, ends, strict=True)]

    def _each(self, function: Callable[[Model, Array, Array], Any], vector: Array, predicted: Array) -> list[Any]:
        """What a function says of each data set."""
        each = zip(self._with_vectors(vector), self.split(predicted), strict=True)
        return [function(part, own, share) for (part, own), share in each]


def _column(parts: Sequence[Array]) -> Array:
    return jnp.concatenate([part.reshape(-1) for part in parts])[:, None]


def forward(
    stack: Any,
    wi: Array | NDArray[np.float64],
    wo: Array | NDArray[np.float64],
    transport: Transport,
    side: Side = "all",
    known: KnownDirections | KnownPairs | None = None,
) -> Array:
    """BSDF (N, C) in 1/sr along unit directions (N, 3): the one place where inference meets the forward models.

    Raises:
        ValueError: the transport is random, cannot carry the stack, or is nothing that could.
    """
    if isinstance(transport, lj.Transport) and transport.random:
        raise ValueError(f"transport: {type(transport).__name__} is random; use a deterministic one: AddingDoubling()")
    if callable(transport) and not isinstance(transport, lj.Transport | type):  # layerjax refuses classes
        return transport(stack, jnp.asarray(wi), jnp.asarray(wo))
    require_single(stack, "inference")
    if isinstance(known, KnownPairs):
        return evaluate_known(stack, wi, wo, transport, side=side, pairs=known)
    return evaluate_known(stack, wi, wo, transport, side=side, known=known)
