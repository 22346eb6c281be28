"""Model discrepancy: what a stack systematically misses, a Gaussian process of log BSDF (Kennedy & O'Hagan 2001).

With model value f, datum d and noise n, g(d) = g(f) + e + n, where g is the logarithm and, below four standard
deviations of the noise, a straight line (`logarithm`). e has Matern kernels of the angles of half vector and difference
(Rusinkiewicz 1998), folded so that light and viewer may change places: errors follow a lobe from one incidence to the
next, and a measurement at 10 and 70 degrees says something of that at 70 and 10. Their standard deviation grows towards
grazing, by a power of the mean cosine of light and viewer, cos half cos difference. Channels have one correlation. The
process lives on inducing points, and costs a matrix of as many rows: the places of all measurements where these are
few, else of some, on which the others are regressed. Noise is that of the datum, so that the covariance does not depend
on the model, and most of its derivatives vanish.

The negative log-density of all measurements is half a sum of squares again, up to a constant: with A from white numbers
c to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',

    (z'(1 + A A')^-1 z + log det (1 + A A')) / 2 = min_c (|z - A c|^2 + |c|^2) / 2 + sum log diag C.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import ArrayLike, NDArray

from fits.data.geometry import Floats
from fits.problem.parameters import Free, LogNormal, Normal, require_number_or_free

LONGEST = 40.0  # degrees: a longer length scale, if its prior is not given, would take the place of the stack's level
LINEAR_BELOW = 4.0  # standard deviations of the additive noise: the logarithm is linear below
LEAST_SOFTNESS = 1e-6  # of the median measurement: it is linear below, where nothing is said of additive noise
GRAZING = 85.0  # degrees from which the discrepancy grows no more
SHORTEST, LEAST_SHORTEST = 5.0, 0.05  # degrees of the shortest length scale that inducing points carry, and at least
REACHES = 16  # so many of it there are across measurements that do not reach far
FEWEST_NODES, MOST_NODES = 80, 250  # inducing points at most, with many channels, and with many measurements
SOME_NODES, A_NODE = 160, 50  # with few measurements, every so many of which add one
MOST_ROWS = 400  # of the matrix: points times channels
LOST, LONGER = 0.02, 1.25  # where points leave more of the variance, the shortest length scale grows by the second
CANDIDATES = 4000  # places that points are chosen among, at most
TYPICAL = 2.0  # measurements are regressed on the points with so many times the shortest length scale
JITTER, ROUNDING, TINY = 1e-8, 1e-10, 1e-9
LEAST_INFORMATION = 1e-6  # about a parameter of the process: what is kept of its smallest eigenvalue


# ---- its parameters ----


class Correlation(NamedTuple):
    """The parameters of a process, as `Discrepancy` says of them."""

    amplitude: Any
    length_half: Any
    length_difference: Any
    grazing_exponent: Any
    channel_correlation: Any


ANGLES = (0.1, 360.0)  # degrees of length scales
RANGES = {"amplitude": (1e-6, 1.0), "grazing_exponent": (0.0, 2.0), "channel_correlation": (0.0, 1.0)}


@dataclass(frozen=True)
class Discrepancy:
    """Model discrepancy: a Gaussian process of the logarithm of the BSDF (Kennedy & O'Hagan 2001).

    amplitude: its standard deviation where light and viewer are along the normal, unitless, in [1e-6, 1]. length_half,
    length_difference: length scales of its Matern kernel, in degrees in [0.1, 360], in the angle of the half vector to
    the normal, and in that of light and viewer to the half vector. grazing_exponent: the standard deviation is that of
    the normal times (2 / (cos i + cos o)) to this power, in [0, 2]. channel_correlation: of two channels, in [0, 1].
    Each a number, `Free`, or None for a free one with a wide prior.
    """

    amplitude: float | Free | None = None
    length_half: float | Free | None = None
    length_difference: float | Free | None = None
    grazing_exponent: float | Free | None = None
    channel_correlation: float | Free | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                require_number_or_free(f"Noise.discrepancy.{name}", value, *RANGES.get(name, ANGLES))


def numbers_of(discrepancy: Discrepancy, shortest: Floats, channels: int) -> Correlation:
    """The parameters of a process, with the default of each that is None; shortest: (2,), see `Process`."""

    def length(shortest: float) -> Free:
        low, high = min(shortest, LONGEST), max(LONGEST, 1.4 * shortest)
        return Free(max(15.0, low), low, high, LogNormal(15.0, 0.5))

    defaults = Correlation(
        amplitude=Free(0.1, 1e-3, 0.5, LogNormal(0.1, 1.0)),
        length_half=length(float(shortest[0])),
        length_difference=length(float(shortest[1])),
        grazing_exponent=Free(0.5, *RANGES["grazing_exponent"], Normal(0.5, 0.5)),
        channel_correlation=Free(0.8, 0.0, 0.99) if channels > 1 else 0.0,
    )
    given = {name: own for name in Correlation._fields if (own := getattr(discrepancy, name)) is not None}
    return defaults._replace(**given)


# ---- the logarithm, which becomes a straight line where measurements are no larger than their noise ----


def softness(values: ArrayLike, additive: ArrayLike) -> NDArray[np.float64]:
    """s of measurements, in 1/sr, from the standard deviation of their additive noise, which broadcasts against
    them."""
    values = np.asarray(values, float)
    typical = LEAST_SOFTNESS * float(np.median(np.abs(values))) or 1.0
    return np.maximum(np.broadcast_to(LINEAR_BELOW * np.asarray(additive, float), values.shape), typical)


def logarithm(x: Any, s: Any) -> Array:
    """g(x) = asinh(x / s): log(2 x / s) far above s, x / s below; also of measurements that are not positive.

    The generalised logarithm of Durbin, Hardin, Hawkins & Rocke 2002, Bioinformatics 18, S105.
    """
    return jnp.arcsinh(x / s)


def size(x: Any, s: Any) -> Array:
    """1 / g'(x), in the unit of x: by so much does x change with an error of 1 in the logarithm."""
    return jnp.hypot(x, s)


# ---- places in half and difference angle, the kernel there, and which places are inducing points ----


def places(wi: ArrayLike, wo: ArrayLike) -> Floats:
    """Where pairs of directions (N, 3) lie, (N, 4), in degrees: angle of half vector and normal, that of light and
    viewer to it along the plane of both and across; and the side: 0 and 1 reflection above and below, 2 through.
    """
    wi, wo = np.asarray(wi, float), np.asarray(wo, float)
    side = np.where(wi[:, 2] * wo[:, 2] <= 0.0, 2.0, np.where(wi[:, 2] > 0.0, 0.0, 1.0))
    upright = np.array([1.0, 1.0, 0.0])
    first, second = (w * upright + np.abs(w) * (1.0 - upright) for w in (wi, wo))
    half = first + second
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    half = np.where(length > TINY, half / np.maximum(length, TINY), [0.0, 0.0, 1.0])
    tilt = np.degrees(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]))
    apart = np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(first - second, axis=-1), 0.0, 1.0))) / 2.0
    normal = np.array([0.0, 0.0, 1.0]) - half[:, 2:] * half  # in the plane of normal and half vector
    parts = [np.abs(np.sum(axis * (first - second), axis=-1)) for axis in (normal, np.cross(half, normal))]
    size = np.hypot(*parts)
    along, across = (
        np.where(size > TINY, part / np.maximum(size, TINY), one) for part, one in zip(parts, (1.0, 0.0), strict=True)
    )
    return np.stack([tilt, apart * along, apart * across, side], axis=-1)


def matern(distance: Any, length: Any) -> Any:
    """Matern kernel of smoothness 5/2 (Rasmussen & Williams 2006, Eq. 4.17)."""
    x = 5.0**0.5 * distance / length
    return (1.0 + x + x**2 / 3.0) * distance.__array_namespace__().exp(-x)


def correlation(one: Any, other: Any, half: Any, difference: Any) -> Any:
    """Correlation at places (N, 4) and (M, 4), (N, M), by length scales in degrees; none between the two sides."""
    xp = one.__array_namespace__()
    tilt, along, across, side = (one[:, None, k] - other[None, :, k] for k in range(4))
    both = matern(xp.abs(tilt), half) * matern(xp.hypot(along, across), difference)
    return xp.where(side == 0.0, both, 0.0)


def log_scales(where: Any) -> Any:
    """Logarithms, (N,), of the scale at places (N, 4) over that along the normal, at a grazing exponent of 1."""
    xp = where.__array_namespace__()
    angles = xp.abs(where[:, 0]), xp.hypot(where[:, 1], where[:, 2])
    first, second = (xp.log(xp.cos(xp.radians(xp.minimum(angle, GRAZING)))) for angle in angles)
    return -first - second


def _pivots(where: Floats, reach: Floats, most: int) -> tuple[list[int], float]:
    """Indices of so many places (N, 4) at most, as they are chosen; and the most that they leave of the variance."""
    rows, left, chosen = np.zeros((most, len(where))), np.ones(len(where)), list[int]()
    for row in range(min(most, len(where))):
        pivot = int(np.argmax(left))
        if left[pivot] < ROUNDING:
            break
        rest = correlation(where[pivot : pivot + 1], where, *reach)[0] - rows[:row, pivot] @ rows[:row]
        rows[row] = rest / np.sqrt(left[pivot])
        left = np.maximum(left - rows[row] ** 2, 0.0)
        left[pivot] = 0.0
        chosen.append(pivot)
    return chosen, float(np.max(left))


# ---- the process ----


class Whitened(NamedTuple):
    """Residuals z - A c, (N, C), that are independent; c, (C R,); and log diag C, (C R,), none below 0."""

    residuals: Array
    latent: Array
    levels: Array


class Factors(NamedTuple):
    """Roots of the covariance of channels, (C, C), and of inducing points, (R, R), but for the amplitude; A'A, and the
    root C of B = 1 + A'A, (C R, C R)."""

    amplitude: Array
    channels: Array
    points: Array
    square: Array
    root: Array


class Moves(NamedTuple):
    """X of each number of a process, by which A moves by dA = A X; X + X' is the change of the covariance between white
    numbers. Of the amplitude it is a number, of the others (K, C, C) between channels plus (K, R, R) between points."""

    amplitude: Array
    channels: Array
    points: Array

    @property
    def transposed(self) -> "Moves":
        """X'."""
        return Moves(self.amplitude, self.channels.swapaxes(1, 2), self.points.swapaxes(1, 2))

    def times(self, rows: Array) -> Array:
        """Rows (M, C R) of white numbers times X, (1 + K, M, C R)."""
        split = rows.reshape(len(rows), self.channels.shape[-1], -1)
        others = jnp.einsum("mcr,kcx->kmxr", split, self.channels) + jnp.einsum("mcr,krx->kmcx", split, self.points)
        return jnp.concatenate([self.amplitude * rows[None], others.reshape(-1, *rows.shape)])


class Process(eqx.Module):
    """A process on R inducing points among the places of N measurements.

    where: the inducing points, (R, 4), see `places`. weights: (N, R), from these to measurements. shortest: (2,), the
    shortest length scales that they carry, in degrees of half vector and difference. gram: `gram_of` measurements,
    (C, R, R), where their noise is known; else None.

    Residuals z of measurements, and `relative`, an error of 1 in the logarithm, are (N, C) and in units of the noise.
    """

    where: Array
    weights: Array
    shortest: Array
    gram: Array | None = None

    def gram_of(self, relative: Array) -> Array:
        """What measurements say of inducing points, (C, R, R)."""
        return jnp.stack([self.weights.T @ (column[:, None] ** 2 * self.weights) for column in relative.T])

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals when the discrepancy that they imply is taken away."""
        return Whitened(*_whitened(self._numbers(at, z.shape[-1]), z, relative, process=self))

    def sample(self, white: Array, at: Correlation) -> Array:
        """Errors of the measurements, (N, C), from standard normal numbers (C, R)."""
        between, own = map(jnp.linalg.cholesky, self._covariances(self._numbers(at, len(white)), len(white)))
        return at.amplitude * self.weights @ (between @ white @ own.T).T

    def whitened_residuals(self, z: Array, relative: Array, at: Correlation) -> Array:
        """Residuals z (N, C) by the symmetric root of their covariance, K^-1/2 z with K = 1 + A A'.

        Where the model holds they are independent standard normal, and their squares add up to z'K^-1 z. Those of
        `whitened` are neither, as the process follows each datum; those of `leave_one_out` are correlated.
        """
        factors = self.factors(self._numbers(at, relative.shape[-1]), relative)
        spread, axes = jnp.linalg.eigh(factors.square)
        root = jnp.sqrt(1.0 + jnp.maximum(spread, 0.0))
        explained = axes.T @ self.to_white(relative * z, factors)
        white = -(axes @ (explained / (root * (1.0 + root))))  # ((1 + s)^-1/2 - 1) / s
        return z + relative * self.from_white(white, factors)

    def leave_one_out(self, whitened_data: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each measurement its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise."""
        factors = self.factors(self._numbers(at, relative.shape[-1]), relative)
        parts = relative, factors.channels, self.weights @ factors.points
        rows = at.amplitude * jnp.einsum("nc,cx,nr->ncxr", *parts)
        solved = solve_triangular(factors.root, rows.reshape(relative.size, -1).T, lower=True)
        return whitened_data.residuals, 1.0 - jnp.sum(solved**2, axis=0).reshape(relative.shape)

    def predict(
        self, whitened_data: Whitened, relative: Array, at_places: Array, at: Correlation
    ) -> tuple[Array, Array]:
        """Errors of the model at other `places`, given residuals that were whitened: mean and sd, (M, C)."""
        factors = self.factors(self._numbers(at, relative.shape[-1]), relative)
        sizes, own = (jnp.exp(at.grazing_exponent * log_scales(where)) for where in (self.where, at_places))
        across = sizes[:, None] * own * correlation(self.where, at_places, at.length_half, at.length_difference)
        across = solve_triangular(factors.points, across, lower=True)
        rows = at.amplitude * jnp.einsum("cx,rm->mcxr", factors.channels, across)
        rows = rows.reshape(*rows.shape[:2], -1)
        solved = solve_triangular(factors.root, rows.reshape(-1, rows.shape[-1]).T, lower=True)
        explained = jnp.sum(rows**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(rows.shape[:2])
        size = at.amplitude * own
        return -rows @ whitened_data.latent, jnp.sqrt(jnp.maximum(size[:, None] ** 2 - explained, 0.0))

    def information_rows(self, relative: Array, at: Correlation) -> Array:
        """Rows whose Jacobian A has in A'A the Fisher information of the measurements about the numbers of the process.

        With M = 1 - B^-1 and E = X + X' (see `Moves`), it is tr(M E M E) / 2.
        """
        numbers = self._numbers(at, relative.shape[-1])
        held = jax.lax.stop_gradient(numbers)
        factors = self.factors(held, relative)
        inverse = _triangular_inverse(factors.root)
        moves = self.moves(held, factors)
        sums = Moves(*(one + other for one, other in zip(moves, moves.transposed, strict=True)))
        flat = sums.times(jnp.eye(len(inverse)) - inverse.T @ inverse)
        information = 0.5 * jnp.einsum("kij,lji->kl", flat, flat)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), LEAST_INFORMATION))
        scaled = information * scale[:, None] * scale + LEAST_INFORMATION * jnp.eye(len(scale))
        return jax.lax.stop_gradient(jnp.linalg.cholesky(scaled).T / scale) @ numbers

    def _numbers(self, at: Correlation, channels: int) -> Array:
        """Those of a process that matter, (4,) or (5,)."""
        return jnp.stack([jnp.asarray(number, float) for number in (at if channels > 1 else at[:4])])

    def _covariances(self, numbers: Array, channels: int) -> tuple[Array, Array]:
        """Covariances between channels, (C, C), and between inducing points, (R, R), at an amplitude of 1."""
        together = numbers[4] if channels > 1 else jnp.zeros(())
        sizes = jnp.exp(numbers[3] * log_scales(self.where))
        own = _with_jitter(correlation(self.where, self.where, numbers[1], numbers[2]))
        return _with_jitter(together + (1.0 - together) * jnp.eye(channels)), sizes[:, None] * own * sizes

    def factors(self, numbers: Array, relative: Array) -> Factors:
        """The matrices of a process with these numbers."""
        between, own = map(jnp.linalg.cholesky, self._covariances(numbers, relative.shape[-1]))
        gram = self.gram_of(relative) if self.gram is None else self.gram
        square = jnp.einsum("ri,crs,sj->cij", own, gram, own)
        square = jnp.einsum("cx,cy,cij->xiyj", between, between, square).reshape(2 * (len(between) * len(own),))
        square = numbers[0] ** 2 * square
        return Factors(numbers[0], between, own, square, jnp.linalg.cholesky(square + jnp.eye(len(square))))

    def from_white(self, white: Array, factors: Factors) -> Array:
        """Errors of the measurements, (N, C), from white numbers, (C R,)."""
        errors = factors.channels @ white.reshape(len(factors.channels), -1) @ factors.points.T
        return self.weights @ (factors.amplitude * errors).T

    def to_white(self, observed: Array, factors: Factors) -> Array:
        """The transpose of `from_white`."""
        return factors.amplitude * (factors.channels.T @ (observed.T @ self.weights) @ factors.points).reshape(-1)

    def moves(self, numbers: Array, factors: Factors) -> Moves:
        """What the root of the covariance changes by with each number."""
        changes = jax.jacfwd(lambda numbers: self._covariances(numbers, len(factors.channels)))(numbers)
        halves = []
        for root, change in zip((factors.channels, factors.points), changes, strict=True):
            inverse = _triangular_inverse(root)
            whole = inverse @ jnp.moveaxis(change[..., 1:], -1, 0) @ inverse.T
            halves.append(jnp.tril(whole) - 0.5 * whole * jnp.eye(len(root)))
        return Moves(1.0 / jnp.where(numbers[0] > 0.0, numbers[0], 1.0), *halves)


@eqx.filter_custom_jvp
def _whitened(numbers: Array, z: Array, relative: Array, *, process: Process) -> tuple[Array, Array, Array]:
    """z - A c (N, C), c (C R,) and log diag C (C R,). Where the noise is known `relative` depends on no parameter."""
    factors = process.factors(numbers, relative)
    half = solve_triangular(factors.root, process.to_white(relative * z, factors), lower=True)
    white = solve_triangular(factors.root, half, lower=True, trans=1)
    return z - relative * process.from_white(white, factors), white, jnp.log(jnp.diagonal(factors.root))


@_whitened.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, process: Process) -> tuple[Any, Any]:
    """In closed form: with X as in `Moves` and c = B^-1 A'z,

        dc = B^-1 (X + X') c - X c,    d(A c) = A B^-1 (X + X') c,    d log diag C = diag(C^-1 (B - 1) X C'^-1).

    So a Jacobian by many parameters makes matrices for the few numbers of the process alone: it is twice as fast.
    """
    numbers, z, relative = primals
    by_numbers, by_z, by_relative = (
        jnp.zeros_like(one) if tangent is None else tangent for one, tangent in zip(primals, tangents, strict=True)
    )
    factors = process.factors(numbers, relative)
    inverse, moves = _triangular_inverse(factors.root), process.moves(numbers, factors)

    def solved(x: Array) -> Array:
        return inverse.T @ (inverse @ x)

    white = solved(process.to_white(relative * z, factors))
    discrepancy = process.from_white(white, factors)
    left = z - relative * discrepancy
    moved, pulled = (one.times(white[None])[:, 0] for one in (moves.transposed, moves))
    sums = solved((moved + pulled).T).T
    levels = jnp.sum(moves.times(factors.root.T - inverse) * inverse, axis=-1)  # C^-1 (B - 1) = C' - C^-1

    by_levels, observed, by_discrepancy = by_numbers @ levels, relative * by_z, jnp.zeros_like(z)
    if process.gram is None:
        by_discrepancy = by_relative * discrepancy
        observed = observed + by_relative * left - relative * by_discrepancy
        parts = inverse.reshape(len(inverse), len(factors.channels), -1), factors.channels
        seen = factors.amplitude * jnp.einsum("mcr,dc,nr->mnd", *parts, process.weights @ factors.points)
        by_levels = by_levels + jnp.tensordot(seen**2, relative * by_relative, 2)
    own = solved(process.to_white(observed, factors))
    by_left = by_z - by_discrepancy - relative * process.from_white(by_numbers @ sums + own, factors)
    found = left, white, jnp.log(jnp.diagonal(factors.root))
    return found, (by_left, by_numbers @ (sums - moved) + own, by_levels)


def _triangular_inverse(root: Array) -> Array:
    return solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True)


def _with_jitter(matrix: Array) -> Array:
    """A matrix of correlations with what rounding leaves of its smallest eigenvalues on its diagonal."""
    rounding = 4.0 * len(matrix) * float(jnp.finfo(matrix.dtype).eps)  # above `JITTER` in single precision alone
    return matrix + max(JITTER, rounding) * jnp.eye(len(matrix), dtype=matrix.dtype)


def make_process(wi: ArrayLike, wo: ArrayLike, channels: int = 1) -> Process:
    """The process of measurements along these directions, (N, 3) each: on all of their places, where these are few.

    Else on those that a pivoted Cholesky decomposition takes first (Fine & Scheinberg 2001): of what errors vary by
    given those at the inducing points before, the place where it is most. The other measurements are regressed on them.
    """
    where = places(wi, wo)
    _, first = np.unique(np.round(where, 6), axis=0, return_index=True)
    those = where[np.sort(first)]
    those = those[:: -(-len(those) // CANDIDATES)]
    most = min(SOME_NODES + len(where) // A_NODE, MOST_NODES)
    most = max(FEWEST_NODES, min(most, MOST_ROWS // channels))
    spans = np.array([np.ptp(where[:, 0]), max(np.ptp(where[:, 1]), np.ptp(where[:, 2]))])
    shortest = np.clip(spans / REACHES, LEAST_SHORTEST, SHORTEST)
    chosen, lost = _pivots(those, shortest, most)
    while lost > LOST:
        shortest = LONGER * shortest
        chosen, lost = _pivots(those, shortest, most)
    among = those[chosen]
    typical = TYPICAL * shortest
    own = correlation(among, among, *typical) + ROUNDING * np.eye(len(among))
    weights = np.linalg.solve(own, correlation(among, where, *typical)).T
    return Process(*map(jnp.asarray, (among, weights, shortest)))
