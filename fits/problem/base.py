"""What every problem has, of one measurement or of several: parameters in a box, and a model as arrays.

What calls a problem's model names the function: a `Model` and a `JointModel` answer to the same names.
"""

import abc
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from fits.names import Objective
from fits.problem.compilation import Static, run

Floats = NDArray[np.float64]


class Assembled(NamedTuple):
    """What follows from a problem as it was given; start, low, high: (P,)."""

    names: tuple[str, ...]
    start: Floats
    low: Floats
    high: Floats
    model: Any


class Posed(abc.ABC):
    """Parameters in a box, and what the data say of them, as pure functions of the physical vector (P,)."""

    objective: Objective

    @property
    @abc.abstractmethod
    def _assembled(self) -> Assembled:
        """What follows from it."""

    @property
    @abc.abstractmethod
    def units(self) -> dict[str, str]:
        """Unit of each parameter; "1" for plain ratios."""

    @property
    @abc.abstractmethod
    def problems(self) -> Mapping[str, Any]:
        """A `Problem` for each measurement, by its name."""

    @abc.abstractmethod
    def places(self, name: str) -> tuple[int, ...]:
        """Where the parameters of one measurement stand in the vector."""

    @abc.abstractmethod
    def shares(self, predicted: Floats) -> dict[str, Floats]:
        """What `predict` gives of each measurement, in the shape of its data."""

    @abc.abstractmethod
    def with_problems(self, changed: Mapping[str, Any]) -> "Posed":
        """The same with other problems in the place of those of the same names."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the P parameters: paths such as ``layers[0].thickness``, ``noise.floor`` or ``scale``."""
        return self._assembled.names

    @property
    def start(self) -> Floats:
        """Where the parameters start, (P,)."""
        return self._assembled.start

    @property
    def low(self) -> Floats:
        """Lower bounds of the parameters, (P,)."""
        return self._assembled.low

    @property
    def high(self) -> Floats:
        """Upper bounds of the parameters, (P,)."""
        return self._assembled.high

    @property
    def model(self) -> Any:
        """The problem as pure functions of the physical vector (P,)."""
        return self._assembled.model

    @property
    def count(self) -> int:
        """Number of data: used samples times channels."""
        return int(self.model.values.size)

    def build(self, vector: ArrayLike) -> Any:
        """Stack, scale and noise levels with the physical vector (P,)."""
        return jax.tree.map(jnp.asarray, self.model.build(jnp.asarray(vector)))

    def predict(self, vector: ArrayLike) -> Array:
        """Scaled BSDF of the used samples, (N, C), in 1/sr; of several measurements one after the other, (N, 1)."""
        return self.call("predict", vector)

    def residuals(self, vector: ArrayLike) -> Array:
        """All residuals of the least-squares problem, (rows,): half their sum of squares is what a fit minimises."""
        return jnp.concatenate([part.reshape(-1) for part in self.call("residuals", vector)])

    def log_likelihood(self, vector: ArrayLike) -> Array:
        """Normalised log-likelihood of the used samples with the physical vector (P,)."""
        return self.call("log_likelihood", vector)

    def log_likelihood_per_datum(self, vector: ArrayLike) -> Array:
        """Normalised log-density of each datum with the physical vector (P,), (N, C)."""
        return self.call("log_likelihood_per_datum", vector)

    def log_prior(self, vector: ArrayLike) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.call("log_prior", vector)

    def log_posterior_unconstrained(self, u: ArrayLike) -> Array:
        """Log-posterior over the unconstrained vector (P,), -inf where undefined."""
        return self.call("log_posterior_unconstrained", u)

    def call(self, function: Callable[..., Any] | str, *arguments: Any) -> Any:
        """`function(model, *arguments)`, or the model's own of that name, compiled once for all of this structure."""
        arrays = (jax.tree.map(jnp.asarray, argument, is_leaf=_is_vector) for argument in arguments)
        return run(_own(function) if isinstance(function, str) else function, self.split_model, *arrays)

    @cached_property
    def split_model(self) -> tuple[Any, Static]:
        """The model's arrays, and what is static in it wrapped for use as a key."""
        arrays, static = eqx.partition(self.model, eqx.is_array)
        return arrays, Static(static)


@cache
def _own(name: str) -> Callable[..., Any]:
    """The model's function of that name: one object for each, by which programs are kept."""

    def call(model: Any, *arguments: Any) -> Any:
        return getattr(model, name)(*arguments)

    return call


def _is_vector(argument: Any) -> bool:
    """Whether numbers are listed, which make an array; a named tuple holds arrays."""
    return type(argument) in (list, tuple)
