"""What is fitted to what: a stack with free parameters, measurements, a noise model and a calibration factor.

`Problem` is what users and results hold. Its `model` holds the same as arrays and static choices, so that one compiled
program serves every problem of the same structure and shape: new data, bounds or fixed numbers do not recompile.
"""

import inspect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

import layerjax as lj
from fits.data.measurements import Measurements
from fits.problem.compiled import Static, run
from fits.problem.likelihood import (
    DEFAULT_FLOOR,
    DEFAULT_RELATIVE,
    Noise,
    Objective,
    Tails,
    information_weights,
    log_density,
    named_residual,
    sigma_residual,
    tail_residual,
    total_sigma,
)
from fits.problem.parameters import Box, Free, LogNormal, Normal, Template, is_free, split
from layerjax.stack import with_known

Transport = Any
"""`"auto"`, a layerjax transport, or a function `(stack, wi, wo) -> (N, C)` that stands in for one."""

Side = Literal["all", "reflection"]


class Parts(NamedTuple):
    """What a vector of parameters stands for."""

    stack: Any
    scale: Array
    relative: Array
    floor: Array


class Model(eqx.Module):
    """Pure functions of the physical vector (P,): predictions, residuals and log-densities over the used samples.

    N samples, C channels. Arrays are traced by `jax.jit`, the rest is static. variance: the measurement's own, (N, C);
    lowest: what sigma cannot fall below, (N, C); varying: whether sigma depends on the parameters.
    """

    template: Template
    box: Box
    wi: Array
    wo: Array
    values: Array
    variance: Array
    lowest: Array
    degrees_of_freedom: Array
    transport: Transport
    side: Side = eqx.field(static=True)
    objective: Objective = eqx.field(static=True)
    tails: Tails = eqx.field(static=True)
    varying: bool = eqx.field(static=True)

    def build(self, vector: Array) -> Parts:
        """Stack, scale and noise levels with these parameters."""
        return Parts(*self.template.fill(vector))

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self._predict(self.build(vector))

    def sigma(self, vector: Array) -> Array:
        """Scale of the noise, (N, C), in 1/sr."""
        parts = self.build(vector)
        return total_sigma(self._predict(parts), self.variance, parts.relative, parts.floor)

    def standardised(self, vector: Array) -> Array:
        """(datum - model) / sigma, (N, C)."""
        predicted, sigma = self._predicted_and_sigma(vector)
        return (self.values - predicted) / sigma

    def residuals(self, vector: Array, fixed_sigma: Array | None = None) -> tuple[Array, ...]:
        """Arrays whose half sum of squares is minus the log-posterior up to a constant, or the named objective.

        The third of them, where sigma varies with the parameters, is that of log sigma. `fixed_sigma` (N, C), where it
        is finite, replaces sigma: the first step towards a fit of noise levels.
        """
        predicted, sigma = self._predicted_and_sigma(vector)
        if fixed_sigma is not None:
            sigma = jnp.where(jnp.isfinite(fixed_sigma), fixed_sigma, sigma)
        return self._residuals(vector, predicted, sigma)

    def information_rows(self, vector: Array) -> tuple[Array, Array, Array]:
        """Of the data (rows,) and of the prior (P,): their Jacobian A has the Fisher information A'A; and the cost.

        The expected information needs first derivatives only and is never indefinite; for Gaussian noise that is known
        it is J'J. For a named objective: its residuals. The cost is half the sum of squared residuals.
        """
        predicted, sigma = self._predicted_and_sigma(vector)
        residuals = self._residuals(vector, predicted, sigma)
        cost = half_squares(residuals)
        if self.objective != "likelihood":
            return residuals[0].reshape(-1), jnp.zeros_like(vector), cost
        of_mean, of_level = information_weights(self.tails, self.degrees_of_freedom)
        rows = jnp.sqrt(of_mean) * (predicted / jax.lax.stop_gradient(sigma)).reshape(-1)
        if self.varying:
            rows = jnp.concatenate([rows, jnp.sqrt(of_level) * jnp.log(sigma).reshape(-1)])
        return rows, self.box.prior_residuals(vector), cost

    def log_likelihood_per_datum(self, vector: Array) -> Array:
        """Normalised log-density of each datum, (N, C)."""
        predicted, sigma = self._predicted_and_sigma(vector)
        return log_density((self.values - predicted) / sigma, sigma, self.tails, self.degrees_of_freedom)

    def log_likelihood(self, vector: Array) -> Array:
        """Sum over the data."""
        return jnp.sum(self.log_likelihood_per_datum(vector))

    def log_prior(self, vector: Array) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.box.log_prior(vector)

    def log_posterior_unconstrained(self, u: Array) -> Array:
        """Log-posterior (not normalised) as a density over the unconstrained vector; -inf where undefined."""
        vector = self.box.constrain(u)
        total = self.log_likelihood(vector) + self.box.log_prior(vector) + self.box.log_determinant(u)
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def _residuals(self, vector: Array, predicted: Array, sigma: Array) -> tuple[Array, ...]:
        if self.objective != "likelihood":
            return (named_residual(self.objective, predicted, self.values, jnp.abs(self.wi[:, 2:])),)
        z = (predicted - self.values) / sigma
        parts = [tail_residual(z, self.tails, self.degrees_of_freedom), self.box.prior_residuals(vector)]
        if self.varying:
            parts.append(sigma_residual(sigma, self.lowest))
        return tuple(parts)

    def _predicted_and_sigma(self, vector: Array) -> tuple[Array, Array]:
        parts = self.build(vector)
        predicted = self._predict(parts)
        return predicted, total_sigma(predicted, self.variance, parts.relative, parts.floor)

    def _predict(self, parts: Parts) -> Array:
        return parts.scale * forward(parts.stack, self.wi, self.wo, self.transport, self.side)


@dataclass(frozen=True, eq=False)
class Problem:
    """A stack with `Free` leaves, the measurements that it should explain, and how they scatter about it.

    transport: see `layerjax.evaluate`; also a function `(stack, wi, wo) -> (N, C)`. scale: a unitless factor common to
    all values: a number, `Free`, or None for 1. objective: "likelihood" or a named residual (see `likelihood`).
    Only the used samples of `data` enter. Derived from these: names of the P parameters; start, low, high, (P,); model.
    Raises ValueError for a problem without free parameters or samples, channels that do not match, noise that can
    vanish, or a named objective together with free noise levels or priors.
    """

    stack: Any
    data: Measurements
    transport: Transport = "auto"
    noise: Noise = field(default_factory=Noise)
    scale: float | Free | None = None
    objective: Objective = "likelihood"
    names: tuple[str, ...] = field(init=False)
    start: NDArray[np.float64] = field(init=False, repr=False)
    low: NDArray[np.float64] = field(init=False, repr=False)
    high: NDArray[np.float64] = field(init=False, repr=False)
    model: Model = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.objective not in get_args(Objective):
            raise ValueError(f"objective is {self.objective!r}; it must be one of {', '.join(get_args(Objective))}")
        scale = 1.0 if self.scale is None else self.scale
        if not is_free(scale) and not (isinstance(scale, int | float) and math.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale!r}; it must be a finite number above 0, Free or None")
        used = self.data.used()
        if not used.values.size:
            raise ValueError("data: no sample is used; at least one must be")
        variance, relative, floor = _noise_levels(self.noise, used)
        levels = {"relative": relative, "floor": floor}
        parts = tuple(x if is_free(x) else jnp.asarray(x) for x in (scale, relative, floor))
        # what is 0 or 1 stays known where the rest is traced: it costs nothing, and some transports ask for it
        known = with_known(self.stack) if isinstance(self.stack, lj.Stack) else self.stack
        template, names, free = split((known, *parts), _parameter_name)
        if not names:
            raise ValueError("stack: nothing is free; put fits.Free(start, low, high) where a number is to be fitted")
        if self.objective != "likelihood":
            _refuse_likelihood_only(self.objective, levels, free)
        smallest = np.sqrt(variance + _lowest(floor) ** 2)
        varying = is_free(relative) or is_free(floor) or bool(relative > 0)
        if self.objective == "likelihood" and not np.all(smallest > 0):
            raise ValueError("noise: sigma could become 0; give a floor above 0, or data with sigma")
        above = bool(np.all(used.wi[:, 2] > 0) and np.all(used.wo[:, 2] > 0))
        model = Model(
            template=template,
            box=Box.of(free),
            wi=jnp.asarray(used.wi),
            wo=jnp.asarray(used.wo),
            values=jnp.asarray(used.values),
            variance=jnp.asarray(np.broadcast_to(variance, used.values.shape)),
            lowest=jnp.asarray(np.broadcast_to(smallest, used.values.shape)),
            degrees_of_freedom=jnp.asarray(float(self.noise.degrees_of_freedom)),
            transport=self.transport,
            side="reflection" if above else "all",
            objective=self.objective,
            tails=self.noise.tails,
            varying=varying,
        )
        start, low, high = (np.concatenate([np.ravel(entry.arrays()[i]) for entry in free]) for i in range(3))
        derived = {"names": names, "model": model, "start": start, "low": low, "high": high}
        for name, value in derived.items():
            object.__setattr__(self, name, value)
        shape = eqx.filter_eval_shape(model.predict, jnp.asarray(start)).shape
        if np.broadcast_shapes(shape, used.values.shape) != used.values.shape:
            raise ValueError(f"stack: it has {shape[-1]} channels, the data {used.values.shape[-1]}: {used.channels}")

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""
        return {name: _unit(name) for name in self.names}

    @property
    def count(self) -> int:
        """Number of data: used samples times channels."""
        return int(self.model.values.size)

    def build(self, vector: ArrayLike) -> Parts:
        """Stack, scale and noise levels with the physical vector (P,)."""
        return jax.tree.map(jnp.asarray, self.model.build(jnp.asarray(vector)))

    def predict(self, vector: ArrayLike) -> Array:
        """Scaled BSDF of the used samples, (N, C), in 1/sr."""
        return self.call(Model.predict, vector)

    def residuals(self, vector: ArrayLike) -> Array:
        """All residuals of the least-squares problem, one after the other."""
        return jnp.concatenate([part.reshape(-1) for part in self.call(Model.residuals, vector)])

    def log_likelihood(self, vector: ArrayLike) -> Array:
        """Normalised log-likelihood."""
        return self.call(Model.log_likelihood, vector)

    def log_likelihood_per_datum(self, vector: ArrayLike) -> Array:
        """Normalised log-density of each datum, (N, C)."""
        return self.call(Model.log_likelihood_per_datum, vector)

    def log_prior(self, vector: ArrayLike) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.call(Model.log_prior, vector)

    def log_posterior_unconstrained(self, u: ArrayLike) -> Array:
        """Log-posterior over the unconstrained vector (P,), -inf where undefined."""
        return self.call(Model.log_posterior_unconstrained, u)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(model, *arguments)`, compiled once for all problems of this structure."""
        return run(function, self.split_model, *(jnp.asarray(argument) for argument in arguments))

    @cached_property
    def split_model(self) -> tuple[Any, Static]:
        """The model's arrays, and what is static in it wrapped for use as a key."""
        arrays, static = eqx.partition(self.model, eqx.is_array)
        return arrays, Static(static)


def half_squares(residuals: tuple[Array, ...]) -> Array:
    """Half the sum of the squares of all residuals: the cost that a fit minimises."""
    return 0.5 * jnp.sum(jnp.stack([jnp.sum(part**2) for part in residuals]))


def forward(
    stack: Any,
    wi: Array | NDArray[np.float64],
    wo: Array | NDArray[np.float64],
    transport: Transport,
    side: Side = "all",
) -> Array:
    """BSDF (N, C) in 1/sr: the one place where inference meets the forward models."""
    if inspect.isfunction(transport):
        return transport(stack, wi, wo)
    if isinstance(transport, lj.Transport) and transport.random:
        raise ValueError(f"transport: {type(transport).__name__} is random; use a deterministic one: AddingDoubling()")
    return lj.evaluate(stack, wi, wo, transport=transport, side=side)


def _noise_levels(noise: Noise, used: Measurements) -> tuple[Any, Any, Any]:
    has_sigma = noise.use_sigma and used.sigma is not None
    variance = np.square(used.sigma) if has_sigma and used.sigma is not None else np.zeros(1)
    relative = noise.relative
    if relative is None:
        relative = 0.0 if has_sigma or noise.floor is not None else DEFAULT_RELATIVE
    floor = noise.floor
    if floor is None:
        typical = DEFAULT_FLOOR * float(np.median(np.abs(used.values)))
        floor = 0.0 if not is_free(relative) and relative == 0 else typical
    return variance, relative, floor


def _refuse_likelihood_only(objective: str, levels: dict[str, Any], free: tuple[Free, ...]) -> None:
    fitted = [name for name, level in levels.items() if is_free(level)]
    if fitted:
        raise ValueError(f"noise.{fitted[0]} is free, but objective {objective!r} has no noise model")
    if any(isinstance(entry.prior, Normal | LogNormal) for entry in free):
        prior = next(entry.prior for entry in free if isinstance(entry.prior, Normal | LogNormal))
        raise ValueError(f"the prior {prior} has no weight beside objective {objective!r}; leave it out")


def _lowest(level: Any) -> float:
    return float(level.arrays()[1]) if is_free(level) else float(level)


def _parameter_name(path: str) -> str:
    for index, name in enumerate(("", "scale", "noise.relative", "noise.floor")):
        if path.startswith(f"[{index}]"):
            return (name + path.removeprefix(f"[{index}]")).lstrip(".")
    return path


def _unit(name: str) -> str:
    if name == "noise.floor":
        return "1/sr"
    return "optical depth" if re.sub(r"\[\d+\]$", "", name).endswith("thickness") else "1"
