"""Free parameters: what is fitted, between which bounds, under which prior, and how a tree of them becomes a vector.

Three spaces, all of dimension P: the *physical* `vector`, the numbers that the stack holds; *unit* `s` in [0, 1], where
optimisers work, between the bounds, linearly, or in the logarithm for a prior that lives there; and *unconstrained*
`u = log(s / (1 - s))`, where samplers work, with the log-determinant of the map.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

import layerjax as lj
from fits._files import require_switch
from fits.data.geometry import Floats
from layerjax._checks import abbreviate, require_kind, require_number
from layerjax._repr import ReprModule
from layerjax.mixture import stacks_by_name

SMALLEST = float(np.finfo(float).tiny)  # what is smaller is 0 in compiled programs
_FLAT = 1e-6  # width of the bounds in standard deviations below which a difference of two masses loses its digits


# ---- priors: densities within the bounds, flat or Gaussian in the value or in its logarithm ----


class Prior:
    """A density within bounds. logarithmic: whether it is flat or Gaussian in the logarithm of the value."""

    logarithmic: ClassVar[bool] = False

    def gaussian(self) -> tuple[float, float]:
        """Centre and inverse standard deviation in the coordinate where the prior is Gaussian; 0: flat there."""
        return 0.0, 0.0


@dataclass(frozen=True)
class Uniform(Prior):
    """Constant density within the bounds."""


@dataclass(frozen=True)
class LogUniform(Prior):
    """Density proportional to 1 / value within the bounds, which must be positive."""

    logarithmic: ClassVar[bool] = True


@dataclass(frozen=True)
class Normal(Prior):
    """Gaussian with `mean` and standard deviation `sd` > 0, cut off at the bounds and normalised within them."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        require_number("Normal.mean", self.mean, open_ends=True)
        require_number("Normal.sd", self.sd, 0.0, open_ends=True)

    def gaussian(self) -> tuple[float, float]:
        return float(self.mean), 1.0 / float(self.sd)


@dataclass(frozen=True)
class LogNormal(Prior):
    """The logarithm is Gaussian about log(`median`) with standard deviation `sd`; cut off at the positive bounds."""

    median: float
    sd: float
    logarithmic: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_number("LogNormal.median", self.median, 0.0, open_ends=True)
        require_number("LogNormal.sd", self.sd, 0.0, open_ends=True)

    def gaussian(self) -> tuple[float, float]:
        return math.log(self.median), 1.0 / float(self.sd)


def _require_computable(prior: Prior, low: Floats, high: Floats) -> None:
    """ValueError for bounds, each () or (C,), and a prior whose density within them float64 cannot hold."""
    if prior.logarithmic and np.any(low < SMALLEST):
        words = f"must be above 0 for the prior {prior}, at least {SMALLEST:.2g}"
        raise ValueError(f"Free.low is {abbreviate(low.tolist())}; it {words}")
    centre, inverse_sd = prior.gaussian()
    with np.errstate(all="ignore"):
        ends = np.log([low, high]) if prior.logarithmic else np.array([low, high])
        squares = np.square((ends - centre) * inverse_sd)
        normalisers = [_log_normaliser(prior, *pair) for pair in zip(low.ravel(), high.ravel(), strict=True)]
    if not (np.all(np.isfinite(squares)) and np.all(np.isfinite(normalisers))):
        bounds = f"[{abbreviate(low.tolist())}, {abbreviate(high.tolist())}]"
        raise ValueError(f"Free.prior is {prior}; float64 cannot hold its density between the bounds {bounds}")


def _log_normaliser(prior: Prior, low: float, high: float) -> float:
    """Log of the integral of the prior between two bounds, in the coordinate where it is Gaussian or flat."""
    centre, inverse_sd = prior.gaussian()
    a, b = (np.log(low), np.log(high)) if prior.logarithmic else (low, high)
    if inverse_sd == 0:
        return float(np.log(b - a))
    width = (b - a) * inverse_sd
    a, b = (a - centre) * inverse_sd, (b - centre) * inverse_sd
    if a > 0:  # both ends in the upper tail: mirror, so that the difference keeps its digits
        a, b = -b, -a
    if width < _FLAT:
        log_mass = np.log(width) + stats.norm.logpdf(0.5 * (a + b))
    else:
        log_mass = stats.norm.logcdf(b) + np.log(-np.expm1(stats.norm.logcdf(a) - stats.norm.logcdf(b)))
    return float(log_mass - math.log(inverse_sd) + 0.5 * math.log(2 * math.pi))


def _random_walk_normaliser(prior: Prior, steps: Floats, normalisers: Floats) -> Floats:
    """Of channels (C,), by the normaliser of each and the steps between them: of all together, in the first. Flat
    priors count once, for the walk starts anywhere; Gaussian ones by their joint precision."""
    channels = len(normalisers)
    inverse_sd = prior.gaussian()[1]
    if inverse_sd > 0.0:
        cut = normalisers.sum() - channels * (0.5 * math.log(2 * math.pi) - math.log(inverse_sd))
        precision = inverse_sd**2 * np.eye(channels) + steps.T @ steps
        whole = cut + 0.5 * channels * math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(precision)[1]
    else:
        scales = -np.log(np.max(np.abs(steps), axis=1))
        whole = normalisers[0] + np.sum(scales) + 0.5 * (channels - 1) * math.log(2 * math.pi)
    return np.array([whole] + [0.0] * (channels - 1))


# ---- what may stand in a stack where a number may ----


@dataclass(frozen=True)
class Free:
    """A free parameter: a placeholder for a number anywhere in a stack.

    Each place is a parameter of its own, even where the same object is used twice.

    Args:
        start: first start of the optimiser, in [low, high]; a number or one per channel, in the unit of the number that
            it replaces.
        low: lower bound; above 0 for `LogNormal` and `LogUniform`.
        high: upper bound, above `low`.
        prior: `Uniform` (the default), `LogUniform`, `Normal` or `LogNormal`; of each channel, if there are several.
        random_walk_sd: standard deviation of the difference between neighbouring channels (of the logarithm for
            `LogNormal` and `LogUniform`), one or one for each of the C - 1 steps. It adds a Gaussian random walk to the
            prior, which is not truncated at the bounds.
        same_for_all_texels: whether the parameter is common to all texels of a map (`fits.fit_map`).
    """

    start: float | Sequence[float]
    low: float | Sequence[float]
    high: float | Sequence[float]
    prior: Prior = Uniform()
    random_walk_sd: float | Sequence[float] | None = None
    same_for_all_texels: bool = False

    __layerjax_placeholder__: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.prior is None:
            object.__setattr__(self, "prior", Uniform())
        require_kind("Free.prior", self.prior, Uniform, LogUniform, Normal, LogNormal)
        require_switch("Free.same_for_all_texels", self.same_for_all_texels)
        for field in ("start", "low", "high", "random_walk_sd"):
            if (value := getattr(self, field)) is not None or field != "random_walk_sd":
                object.__setattr__(self, field, _plain(f"Free.{field}", value))
        first, lower, upper = self.arrays()
        low, high = abbreviate(self.low), abbreviate(self.high)
        if np.any(lower >= upper):
            raise ValueError(f"Free.low is {low} and Free.high is {high}; low must be below high")
        if np.any((first < lower) | (first > upper)):
            raise ValueError(f"Free.start is {abbreviate(self.start)}; it must lie in [{low}, {high}]")
        _require_computable(self.prior, lower, upper)
        if self.random_walk_sd is not None:
            steps, count = np.asarray(self.random_walk_sd), math.prod(self.shape) - 1
            if not (count and steps.shape in ((), (count,)) and np.all(steps > 0.0)):
                words = f"must be above 0, one number or one for each of the {count} steps between channels"
                raise ValueError(f"Free.random_walk_sd is {abbreviate(self.random_walk_sd)}; it {words}")

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
        given = self.start, self.low, self.high
        try:
            start, low, high = np.broadcast_arrays(*(np.asarray(one, float) for one in given))
        except ValueError:
            raise ValueError(f"Free: {abbreviate(given)} have different numbers of channels") from None
        return start, low, high


def _plain(field: str, value: Any) -> float | tuple[float, ...]:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.ndim > 1 or array.size == 0 or not np.isfinite(array).all():
        raise ValueError(f"{field} is {abbreviate(value)}; it must be a finite number or one per channel")
    return float(array) if array.ndim == 0 else tuple(array.tolist())


def is_free(leaf: Any) -> bool:
    """Whether this leaf is a free parameter."""
    return isinstance(leaf, Free)


def require_number_or_free(name: str, value: Any, low: float, high: float) -> None:
    """Refuse what is neither a number in [low, high] nor a single `Free` with such bounds."""
    if not is_free(value):
        require_number(name, value, low, high)
        return
    if value.shape != ():
        raise ValueError(f"{name} has {value.shape[0]} channels; it must be a single number")
    require_number(f"{name}.low", value.low, low, high)
    require_number(f"{name}.high", value.high, low, high)


class PowerLaw(ReprModule):
    """A parameter per channel that follows a power law: ``amplitude (wavelength / reference)^-exponent``.

    Args:
        amplitude: value at the reference, in the unit of the parameter, or `Free` with low >= 0.
        exponent: unitless, or `Free`; 0.5 to 4 are common for reduced scattering.
        wavelengths: one per channel, in nm.
        reference: wavelength in nm; None: the geometric mean.

    Raises:
        ValueError: nothing is free, a parameter differs by channel, or there are fewer than two wavelengths or one that
            is not above 0.
    """

    amplitude: Any
    exponent: Any
    wavelengths: tuple[float, ...] = eqx.field(static=True)
    reference: float = eqx.field(static=True)

    __layerjax_placeholder__: ClassVar[bool] = True

    def __init__(
        self, amplitude: Any, exponent: Any, wavelengths: Sequence[float], reference: float | None = None
    ) -> None:
        self.amplitude, self.exponent = amplitude, exponent
        given = np.asarray(wavelengths, float)
        if given.ndim != 1 or given.size < 2:
            raise ValueError(f"PowerLaw.wavelengths has shape {given.shape}; it must be one a channel, two or more")
        for name, values in (("wavelengths", given), ("reference", 1.0 if reference is None else reference)):
            if not np.all(np.isfinite(values) & (np.asarray(values) > 0.0)):
                raise ValueError(
                    f"PowerLaw.{name} is {abbreviate(np.asarray(values).tolist())}; it must be finite and above 0"
                )
        self.wavelengths = tuple(given.tolist())
        self.reference = float(np.exp(np.mean(np.log(given)))) if reference is None else float(reference)
        require_number_or_free("PowerLaw.amplitude", amplitude, 0.0, math.inf)
        require_number_or_free("PowerLaw.exponent", exponent, -math.inf, math.inf)
        if not (is_free(amplitude) or is_free(exponent)):
            raise ValueError("PowerLaw: nothing is free; write the number of each channel instead")

    def values(self) -> Array:
        """(C,), of numbers that are not free."""
        ratio = np.asarray(self.wavelengths) / self.reference
        return jnp.asarray(self.amplitude) * jnp.exp(-jnp.asarray(self.exponent) * jnp.log(ratio))

    def extremes(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest of each channel, (C,), within the bounds of what is free."""
        ratio = np.asarray(self.wavelengths) / self.reference
        ends = ((one.low, one.high) if is_free(one) else (one,) for one in (self.amplitude, self.exponent))
        corners = np.array([a * ratio**-b for a, b in product(*ends)])
        return corners.min(axis=0), corners.max(axis=0)


def is_law(leaf: Any) -> bool:
    """Whether this leaf is a power law."""
    return isinstance(leaf, PowerLaw)


def with_values(tree: Any) -> Any:
    """The tree with the numbers of each channel in place of power laws."""
    return jax.tree.map(lambda leaf: leaf.values() if is_law(leaf) else leaf, tree, is_leaf=is_law)


def at_start(tree: Any, end: Literal[0, 1, 2] = 0) -> Any:
    """The tree with every free parameter at its start; end: 1 at its lower bound, 2 at its upper one."""
    return with_values(
        jax.tree.map(lambda leaf: jnp.asarray(leaf.arrays()[end]) if is_free(leaf) else leaf, tree, is_leaf=is_free)
    )


def require_in_range(material: Any) -> None:
    """Refuse power laws that leave the range of the numbers in whose place they stand: ValueError that names it."""
    for prefix, stack in stacks_by_name(material).items() if isinstance(material, lj.Stack | lj.Mixture) else ():
        parts = {f"{prefix}layers[{place}]": layer for place, layer in enumerate(stack.layers)}
        for where, part in (parts | {f"{prefix}base": stack.base}).items():
            laws = {} if part is None else {name: one for name, one in vars(part).items() if is_law(one)}
            for name, end in ((name, end) for name, law in laws.items() for end in law.extremes()):
                try:
                    replace(cast(Any, part), **{name: end})
                except ValueError as error:
                    raise ValueError(f"{where}: within the bounds of its power law {error}") from None


# ---- what all free parameters of a tree are together ----


class Box(eqx.Module):
    """Bounds and priors of P parameters as arrays of shape (P,), and the maps between the three spaces; differences
    between neighbouring channels are (Q, P), in units of `Free.random_walk_sd`."""

    low: Array
    high: Array
    logarithmic: Array
    centre: Array
    inverse_sd: Array
    log_normaliser: Array
    differences: Array

    @classmethod
    def of(cls, free: Iterable[Free]) -> "Box":
        """The box of these parameters, one after the other."""
        free = list(free)
        low, high = (np.concatenate([np.zeros(0), *(np.ravel(entry.arrays()[k]) for entry in free)]) for k in (1, 2))
        priors = [entry.prior for entry in free for _ in range(math.prod(entry.shape))]
        gaussians = np.array([prior.gaussian() for prior in priors]).reshape(-1, 2)
        logs = np.array([_log_normaliser(prior, a, b) for prior, a, b in zip(priors, low, high, strict=True)])
        differences = [np.zeros((0, len(low)))]
        first = 0
        for entry in free:
            here = slice(first, first := first + math.prod(entry.shape))
            if entry.random_walk_sd is not None:
                rows = np.diff(np.eye(len(low))[here], axis=0) / np.reshape(entry.random_walk_sd, (-1, 1))
                differences.append(rows)
                logs[here] = _random_walk_normaliser(entry.prior, rows[:, here], logs[here])
        return cls(
            low=jnp.asarray(low),
            high=jnp.asarray(high),
            logarithmic=jnp.asarray([prior.logarithmic for prior in priors], dtype=bool),
            centre=jnp.asarray(gaussians[:, 0]),
            inverse_sd=jnp.asarray(gaussians[:, 1]),
            log_normaliser=jnp.asarray(logs, dtype=jnp.result_type(float)),
            differences=jnp.asarray(np.concatenate(differences), dtype=jnp.result_type(float)),
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
        """Standardised distance from the prior's centre, (P,), 0 for flat priors; and between neighbours, (Q,). The
        optimum of a fit is the mode in the coordinate where the prior is Gaussian or flat."""
        natural = self._natural(vector)
        own = (natural - self.centre) * self.inverse_sd
        return own if not self.differences.shape[0] else jnp.concatenate([own, self.differences @ natural])

    def prior_slopes(self) -> Array:
        """d `prior_residuals` / d unit, (P + Q, P)."""
        low, high = self._ends()
        return jnp.concatenate([jnp.diag(self.inverse_sd), self.differences]) * (high - low)

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


def split(tree: Any, rename: Any = lambda name: name) -> tuple[Template, dict[str, Free]]:
    """The template of a tree, and its free parameters by paths (``layers[0].thickness``), as the vector has them."""
    paths, structure = jax.tree.flatten_with_path(tree, is_leaf=is_free)
    slots, free, offset = [], {}, 0
    for index, (path, leaf) in enumerate(paths):
        if isinstance(leaf, Free):
            slots.append((index, offset, leaf.shape))
            free[rename(jax.tree_util.keystr(path).lstrip("."))] = leaf
            offset += math.prod(leaf.shape)
    return Template(tuple(None if is_free(leaf) else leaf for _, leaf in paths), structure, tuple(slots)), free


def names_of(free: Mapping[str, Free]) -> tuple[str, ...]:
    """Names of P parameters: one that differs by channel has one a channel, ``base.albedo[1]``."""
    channels = {name: [f"[{channel}]" for channel in range(math.prod(one.shape))] for name, one in free.items()}
    return tuple(name + channel for name, one in free.items() for channel in (channels[name] if one.shape else [""]))
