"""Free parameters: what is fitted, between which bounds, under which prior, and how a tree of them becomes a vector.

Three spaces, all of dimension P:

- *physical* `vector`: the numbers that the stack holds;
- *unit* `s` in [0, 1]: the bounds map to 0 and 1, linearly, or in the logarithm for a prior that lives there;
  optimisers work here and starts are spread evenly here;
- *unconstrained* `u = log(s / (1 - s))`: samplers work here, with the log-determinant of the map.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fits.problem.priors import LogNormal as LogNormal
from fits.problem.priors import LogUniform as LogUniform
from fits.problem.priors import Normal as Normal
from fits.problem.priors import Prior as Prior
from fits.problem.priors import Uniform as Uniform
from fits.problem.priors import log_normaliser, require_computable, require_steps, shared_normaliser, steps
from fits.problem.values import shown


@dataclass(frozen=True)
class Free:
    """A number to be fitted: a placeholder that may stand anywhere in a stack where a number may stand.

    `start`, `low`, `high` are numbers or one per channel (then a prior holds for each channel); the unit is that
    of the number it stands for. Requires low < high, start in [low, high], and low > 0 for `LogNormal` and
    `LogUniform`. A `Normal` must have its mean within 37 standard deviations of the bounds, and a standard deviation
    above 1e-15 of the distance from the mean to either bound, so that its density can be computed (`LogNormal`: the
    same of the logarithms). Each place is a parameter of its own, even where the same object stands twice.

    `random_walk_sd` holds channels together: the standard deviation of the difference between neighbours (of the
    logarithms for `LogNormal` and `LogUniform`), one or one for each of the C - 1 steps, say in proportion to the root
    of the distance in wavelength. It is a Gaussian random walk beside the prior of each channel, not cut off at bounds.

    `same_for_all_texels` says that all texels of a map have this number in common, see `fits.fit_map`; in a fit of one
    material it says nothing.
    """

    start: float | tuple[float, ...]
    low: float | tuple[float, ...]
    high: float | tuple[float, ...]
    prior: Prior
    random_walk_sd: float | tuple[float, ...] | None
    same_for_all_texels: bool = False

    __layerjax_placeholder__: ClassVar[bool] = True

    def __init__(
        self,
        start: float | Sequence[float],
        low: float | Sequence[float],
        high: float | Sequence[float],
        prior: Prior | None = None,
        random_walk_sd: float | Sequence[float] | None = None,
        same_for_all_texels: bool = False,
    ):
        prior = Uniform() if prior is None else prior
        if not isinstance(prior, Prior):
            raise ValueError(f"Free.prior is {shown(prior)}; it must be Uniform, LogUniform, Normal, LogNormal or None")
        if not isinstance(same_for_all_texels, bool):
            raise ValueError(f"Free.same_for_all_texels is {shown(same_for_all_texels)}; it must be True or False")
        object.__setattr__(self, "prior", prior)
        object.__setattr__(self, "same_for_all_texels", same_for_all_texels)
        given = {"start": start, "low": low, "high": high, "random_walk_sd": random_walk_sd}
        for field, value in given.items():
            object.__setattr__(self, field, value if value is None else _plain(f"Free.{field}", value))
        first, lower, upper = self.arrays()
        if np.any(lower >= upper):
            raise ValueError(
                f"Free.low is {shown(self.low)} and Free.high is {shown(self.high)}; low must be below high"
            )
        if np.any((first < lower) | (first > upper)):
            raise ValueError(
                f"Free.start is {shown(self.start)}; it must lie in [{shown(self.low)}, {shown(self.high)}]"
            )
        require_computable(prior, lower, upper)
        if self.random_walk_sd is not None:
            require_steps(np.asarray(self.random_walk_sd), self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """() or (C,)."""
        return self.arrays()[0].shape

    def __repr__(self) -> str:
        words = [repr(value) for value in (self.start, self.low, self.high)]
        words += [] if self.prior == Uniform() else [repr(self.prior)]
        words += [] if self.random_walk_sd is None else [f"random_walk_sd={self.random_walk_sd!r}"]
        words += ["same_for_all_texels=True"] if self.same_for_all_texels else []
        return f"Free({', '.join(words)})"

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`start`, `low`, `high` at their common shape."""
        try:
            start, low, high = np.broadcast_arrays(*(np.asarray(x, float) for x in (self.start, self.low, self.high)))
        except ValueError:
            raise ValueError(
                f"Free: start {shown(self.start)}, low {shown(self.low)} and high {shown(self.high)} have different "
                "numbers of channels"
            ) from None
        return start, low, high


class Box(eqx.Module):
    """Bounds and priors of P parameters as arrays of shape (P,), and the maps between the three spaces.

    between: (Q, P), differences between neighbouring channels in units of `Free.random_walk_sd`.
    """

    low: Array
    high: Array
    logarithmic: Array
    centre: Array
    inverse_sd: Array
    log_normaliser: Array
    between: Array

    @classmethod
    def of(cls, free: Sequence[Free]) -> "Box":
        """The box of these parameters, one after the other."""
        bounds = [entry.arrays() for entry in free]
        low = np.concatenate([np.ravel(b[1]) for b in bounds]) if bounds else np.zeros(0)
        high = np.concatenate([np.ravel(b[2]) for b in bounds]) if bounds else np.zeros(0)
        priors = [entry.prior for entry, b in zip(free, bounds, strict=True) for _ in range(b[0].size)]
        gaussians = np.array([prior.gaussian() for prior in priors]).reshape(-1, 2)
        logs = np.array([log_normaliser(prior, a, b) for prior, a, b in zip(priors, low, high, strict=True)])
        between = [np.zeros((0, len(low)))]
        first = 0
        for entry in free:
            here = slice(first, first := first + math.prod(entry.shape))
            if entry.random_walk_sd is not None:
                rows = np.zeros((here.stop - here.start - 1, len(low)))
                rows[:, here] = steps(entry.random_walk_sd, here.stop - here.start)
                between.append(rows)
                logs[here] = shared_normaliser(entry.prior, rows[:, here], logs[here])
        return cls(
            low=jnp.asarray(low),
            high=jnp.asarray(high),
            logarithmic=jnp.asarray([prior.logarithmic for prior in priors], dtype=bool),
            centre=jnp.asarray(gaussians[:, 0]),
            inverse_sd=jnp.asarray(gaussians[:, 1]),
            log_normaliser=jnp.asarray(logs, dtype=jnp.result_type(float)),
            between=jnp.asarray(np.concatenate(between), dtype=jnp.result_type(float)),
        )

    def from_unit(self, s: Array) -> Array:
        """Physical vector from `s` in [0, 1]; 0 and 1 give the bounds exactly for linear parameters."""
        return self._mix(s, 1.0 - s)

    def to_unit(self, vector: Array) -> Array:
        """Inverse of `from_unit`."""
        low, high = self._ends()
        return (self._natural(vector) - low) / (high - low)

    def constrain(self, u: Array) -> Array:
        """Physical vector from the unconstrained one."""
        return self._mix(jax.nn.sigmoid(u), jax.nn.sigmoid(-u))

    def log_determinant(self, u: Array) -> Array:
        """Sum of log |d physical / d unconstrained|."""
        low, high = self._ends()
        slope = jnp.log(high - low) + jax.nn.log_sigmoid(u) + jax.nn.log_sigmoid(-u)
        log_value = low * jax.nn.sigmoid(-u) + high * jax.nn.sigmoid(u)  # d v / d log v = v
        return jnp.sum(slope + jnp.where(self.logarithmic, log_value, 0.0))

    def log_prior(self, vector: Array) -> Array:
        """Log-density of the physical vector, normalised within the bounds; -inf outside, never NaN."""
        inside = jnp.all((vector >= self.low) & (vector <= self.high))
        safe = jnp.clip(vector, self.low, self.high)
        jacobian = jnp.where(self.logarithmic, self._natural(safe), 0.0)
        density = -0.5 * jnp.sum(self.prior_residuals(safe) ** 2) - jnp.sum(self.log_normaliser + jacobian)
        return jnp.where(inside, density, -jnp.inf)

    def prior_residuals(self, vector: Array) -> Array:
        """Standardised distance from the prior's centre, (P,), 0 for flat priors; and between neighbours, (Q,).

        Their squares are the prior's part in the fit, whose optimum is therefore the mode in the coordinate where the
        prior is Gaussian or flat: the logarithm for `LogNormal` and `LogUniform`.
        """
        natural = self._natural(vector)
        own = (natural - self.centre) * self.inverse_sd
        return own if not self.between.shape[0] else jnp.concatenate([own, self.between @ natural])

    def prior_slopes(self) -> Array:
        """d `prior_residuals` / d unit, (P + Q, P)."""
        low, high = self._ends()
        return jnp.concatenate([jnp.diag(self.inverse_sd), self.between]) * (high - low)

    def slope(self, vector: Array) -> Array:
        """d physical / d unit, shape (P,): the width of the box in physical units at this point."""
        low, high = self._ends()
        return (high - low) * jnp.where(self.logarithmic, vector, 1.0)

    def _natural(self, vector: Array) -> Array:
        return jnp.where(self.logarithmic, jnp.log(jnp.where(self.logarithmic, vector, 1.0)), vector)

    def _ends(self) -> tuple[Array, Array]:
        return self._natural(self.low), self._natural(self.high)

    def _mix(self, s: Array, rest: Array) -> Array:
        low, high = self._ends()
        natural = low * rest + high * s
        return jnp.where(self.logarithmic, jnp.exp(jnp.where(self.logarithmic, natural, 0.0)), natural)


class Template(eqx.Module):
    """A tree whose `Free` leaves were taken out, and the places where a vector's entries go."""

    leaves: tuple[Any, ...]
    structure: Any = eqx.field(static=True)
    slots: tuple[tuple[int, int, tuple[int, ...]], ...] = eqx.field(static=True)

    def fill(self, vector: Array) -> Any:
        """The tree with the entries of `vector` (P,) in place of its free parameters."""
        leaves = list(self.leaves)
        for leaf, offset, shape in self.slots:
            leaves[leaf] = vector[offset : offset + math.prod(shape)].reshape(shape)
        return jax.tree.unflatten(self.structure, leaves)


def split(tree: Any, rename: Any = lambda name: name) -> tuple[Template, tuple[str, ...], tuple[Free, ...]]:
    """Take the free parameters out of a tree: the template, their P names, and the `Free` leaves in the same order.

    Names are paths such as ``layers[0].thickness``; a per-channel parameter has one name a channel, ``base.albedo[1]``.
    """
    paths, structure = jax.tree.flatten_with_path(tree, is_leaf=is_free)
    leaves: list[Any] = []
    slots: list[tuple[int, int, tuple[int, ...]]] = []
    names: list[str] = []
    free: list[Free] = []
    for path, leaf in paths:
        if isinstance(leaf, Free):
            name = rename(jax.tree_util.keystr(path).lstrip("."))
            slots.append((len(leaves), len(names), leaf.shape))
            names.extend([name] if leaf.shape == () else [f"{name}[{channel}]" for channel in range(leaf.shape[0])])
            free.append(leaf)
        leaves.append(None if isinstance(leaf, Free) else leaf)
    return Template(tuple(leaves), structure, tuple(slots)), tuple(names), tuple(free)


def is_free(leaf: Any) -> bool:
    """Whether this leaf is a free parameter."""
    return isinstance(leaf, Free)


def _plain(field: str, value: Any) -> float | tuple[float, ...]:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{field} is {shown(value)}; it must be a number or one number per channel") from None
    if array.ndim > 1 or array.size == 0:
        raise ValueError(f"{field} has shape {array.shape}; it must be a number or one number per channel")
    if not np.isfinite(array).all():
        raise ValueError(f"{field} is {shown(array.tolist())}; it must be finite")
    return float(array) if array.ndim == 0 else tuple(array.tolist())
