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

Derivatives are in closed form. A parameter of the process moves the root of its covariance by dA = A X, where X + X' is
the change of that covariance between white numbers; with c = B^-1 A'z,

    dc = B^-1 (X + X') c - X c,    d(A c) = A B^-1 (X + X') c,    d log diag C = diag(C^-1 (B - 1) X C'^-1),

and C^-1 (B - 1) = C' - C^-1. So a Jacobian by many parameters makes matrices for those few of the process alone.
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

Trio = tuple[Array, Array, Array]

LONGEST = 40.0
"""Degrees of a length scale whose prior is not given, at most: what is correlated farther would take the place of the
stack's level."""

LINEAR_BELOW, LEAST_SOFTNESS = 4.0, 1e-6
"""Standard deviations of the additive noise below which the logarithm is linear; and what that is at least, of the
median measurement, where nothing is said of additive noise."""

GRAZING = 85.0
"""Degrees from which the discrepancy grows no more."""

SHORTEST, LEAST_SHORTEST, REACHES = 5.0, 0.05, 16
"""Shortest length scale in degrees that inducing points carry where measurements reach far, and at least; and how many
of it there are across measurements that do not reach far."""

FEWEST_NODES, SOME_NODES, MOST_NODES, A_NODE, MOST_ROWS = 80, 160, 250, 50, 400
"""Inducing points at most: the first with many channels, the third with many measurements, every so many
of which (the fourth) add one; and the most rows of the matrix, points times channels."""

LOST, LONGER, CANDIDATES = 0.02, 1.25, 4000
"""Where the points leave more of the variance at a measurement, the shortest length scale grows by the second; chosen
among at most so many places."""

TYPICAL = 2.0
"""Measurements are regressed on the points with so many times the shortest length scale."""

JITTER, ROUNDING, TINY = 1e-8, 1e-10, 1e-9
LEAST_INFORMATION = 1e-6
"""Of the information about a parameter of the process: what is kept of its smallest eigenvalue."""


# ---- its parameters ----


class Correlation(NamedTuple):
    """The parameters of a process, as `Discrepancy` says of them."""

    amplitude: Any
    length_half: Any
    length_difference: Any
    grazing_exponent: Any
    channel_correlation: Any


ANGLES = (0.1, 360.0)
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
    """The parameters of a process, with the default of each that is None; shortest: (2,), see `InducingPoints`."""

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


# ---- places in half and difference angle, the kernel there, and inducing points ----


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


class InducingPoints(NamedTuple):
    """R places among those of N measurements.

    where: (R, 4), see `places`. weights: (N, R), from inducing points to measurements. shortest: (2,), what errors
    reach at least, in degrees of half vector and difference, so that inducing points carry them.
    """

    where: Floats
    weights: Floats
    shortest: Floats


def inducing_points(wi: ArrayLike, wo: ArrayLike, channels: int = 1) -> InducingPoints:
    """Of measurements along these directions, (N, 3) each: all of their places, where these are few.

    Else those that a pivoted Cholesky decomposition takes first (Fine & Scheinberg 2001): of what errors vary by given
    those at the inducing points before, the place where it is most. The other measurements are regressed on them.
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
    return InducingPoints(among, weights, shortest)


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


# ---- white numbers, and residuals less the discrepancy, with derivatives in closed form ----


class Roots(NamedTuple):
    """Roots of the covariance of channels, (C, C), and of inducing points, (R, R), but for the amplitude; that of all
    is their product."""

    channels: Array
    inducing_points: Array


class Move(NamedTuple):
    """X of a number of the process: a factor between channels, (C, C), or between inducing points, (R, R); the other is
    1."""

    between_channels: bool
    factor: Array


def _vector_of(at: Correlation, channels: int) -> Array:
    """Those of a process that matter, (4,) or (5,)."""
    return jnp.stack([jnp.asarray(number, float) for number in (at if channels > 1 else at[:4])])


def _with_jitter(matrix: Array) -> Array:
    """A matrix of correlations with what rounding leaves of its smallest eigenvalues on its diagonal."""
    rounding = 4.0 * len(matrix) * float(jnp.finfo(matrix.dtype).eps)  # above `JITTER` in single precision alone
    return matrix + max(JITTER, rounding) * jnp.eye(len(matrix), dtype=matrix.dtype)


def _roots_of(numbers: Array, where: Array, channels: int) -> Roots:
    """The roots of a process on inducing points `where`, (R, 4)."""
    _, half, difference, growth = numbers[:4]
    own = _with_jitter(correlation(where, where, half, difference))
    between = numbers[4] + (1.0 - numbers[4]) * jnp.eye(channels) if channels > 1 else jnp.ones((1, 1))
    sizes = jnp.exp(growth * log_scales(where))
    return Roots(jnp.linalg.cholesky(_with_jitter(between)), sizes[:, None] * jnp.linalg.cholesky(own))


def _moves_of(numbers: Array, where: Array, roots: Roots) -> list[Move]:
    """The moves of all numbers but the amplitude."""
    inverse = _triangular_inverse(roots.inducing_points)
    sizes = jnp.exp(numbers[3] * log_scales(where))
    by_lengths = jax.jacfwd(lambda lengths: correlation(where, where, *lengths))(numbers[1:3])
    scaled = inverse * sizes
    found = [Move(False, _halved(scaled @ by_lengths[..., k] @ scaled.T)) for k in range(2)]
    found.append(Move(False, inverse @ (log_scales(where)[:, None] * roots.inducing_points)))
    if len(numbers) > 4:
        inverse = _triangular_inverse(roots.channels)
        found.append(Move(True, _halved(inverse @ (1.0 - jnp.eye(len(inverse))) @ inverse.T)))
    return found


def _moved(rows: Array, move: Move, roots: Roots) -> Array:
    """Rows (M, C R) of white numbers times X."""
    split = rows.reshape(-1, len(roots.channels), len(roots.inducing_points))
    by = "mcr,cx->mxr" if move.between_channels else "mcr,rx->mcx"
    return jnp.einsum(by, split, move.factor).reshape(rows.shape)


def _on_points(roots: Roots, white: Array) -> Array:
    """Errors (C, R), at an amplitude of 1, from white numbers (C R,)."""
    return roots.channels @ white.reshape(len(roots.channels), -1) @ roots.inducing_points.T


def _from_points(roots: Roots, observed: Array) -> Array:
    """The transpose of `on_points`: (C R,) from (C, R)."""
    return (roots.channels.T @ observed @ roots.inducing_points).reshape(-1)


def _gram(weights: Array, relative: Array) -> Array:
    """What measurements say of inducing points, (C, R, R), by weights (N, R); relative: an error of 1 in units of
    noise, (N, C)."""
    return jnp.stack([weights.T @ (column[:, None] ** 2 * weights) for column in relative.T])


def _roots_and_square(
    numbers: Array, where: Array, weights: Array, gram: Array | None, relative: Array
) -> tuple[Roots, Array]:
    """The roots of a process, and A'A at an amplitude of 1, (C R, C R)."""
    roots = _roots_of(numbers, where, relative.shape[-1])
    gram = _gram(weights, relative) if gram is None else gram
    square = jnp.einsum("ri,crs,sj->cij", roots.inducing_points, gram, roots.inducing_points)
    if len(square) == 1:
        return roots, roots.channels[0, 0] ** 2 * square[0]
    size = square.shape[0] * square.shape[1]
    return roots, jnp.einsum("cx,cy,cij->xiyj", roots.channels, roots.channels, square).reshape(size, size)


def _root_of(amplitude: Array, square: Array) -> Array:
    """C, from A'A at an amplitude of 1."""
    return jnp.linalg.cholesky(amplitude**2 * square + jnp.eye(len(square)))


def _triangular_inverse(root: Array) -> Array:
    """The inverse of a lower triangular matrix."""
    return solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True)


@jax.custom_jvp
def _whitened(numbers: Array, where: Array, weights: Array, gram: Array | None, z: Array, relative: Array) -> Trio:
    """z - A c (N, C), c (C R,) and log diag C (C R,), of residuals z (N, C) in units of the noise.

    Inducing points, weights (N, R) and a `gram` (C, R, R) that is given do not depend on parameters, nor does
    `relative` (N, C) with it.
    """
    roots, square = _roots_and_square(numbers, where, weights, gram, relative)
    root, amplitude = _root_of(numbers[0], square), numbers[0]
    half = solve_triangular(root, amplitude * _from_points(roots, (weights.T @ (relative * z)).T), lower=True)
    white = solve_triangular(root, half, lower=True, trans=1)
    errors = relative * (weights @ (amplitude * _on_points(roots, white)).T)
    return z - errors, white, jnp.log(jnp.diagonal(root))


@_whitened.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Trio, Trio]:
    numbers, where, weights, gram, z, relative = primals
    by_numbers, _, _, _, by_z, by_relative = tangents
    amplitude, (roots, square) = numbers[0], _roots_and_square(numbers, where, weights, gram, relative)
    root = _root_of(amplitude, square)
    inverse = _triangular_inverse(root)

    def back(x: Array) -> Array:
        """Towards white numbers, (C R,), from measurements, (N, C)."""
        return _from_points(roots, (weights.T @ x).T)

    def solved(x: Array) -> Array:
        return inverse.T @ (inverse @ x)

    wanted = back(relative * z)
    white = amplitude * solved(wanted)
    discrepancy = weights @ (amplitude * _on_points(roots, white)).T
    left = z - relative * discrepancy

    steps = _moves_of(numbers, where, roots)
    pulled = [_moved(white[None], step._replace(factor=step.factor.T), roots)[0] for step in steps]
    pushed = [_moved(white[None], step, roots)[0] for step in steps]
    sums = [solved(one + other) for one, other in zip(pulled, pushed, strict=True)]
    by_amplitude = solved(wanted - 2.0 * amplitude * (square @ white))
    whites = [by_amplitude] + [total - one for total, one in zip(sums, pulled, strict=True)]
    errors = [white + amplitude * by_amplitude] + [amplitude * total for total in sums]

    safe = jnp.where(amplitude > 0.0, amplitude, 1.0)
    levels = [jnp.where(amplitude > 0.0, (1.0 - jnp.sum(inverse**2, axis=-1)) / safe, 0.0)]
    levels += [jnp.sum(_moved(root.T - inverse, step, roots) * inverse, axis=-1) for step in steps]

    by_levels, observed, by_discrepancy = by_numbers @ jnp.stack(levels), relative * by_z, 0.0
    if gram is None:
        by_discrepancy = by_relative * discrepancy
        observed = observed + by_relative * left - relative * by_discrepancy
        parts = inverse.reshape(len(root), *map(len, roots)), roots.channels, weights @ roots.inducing_points
        seen = amplitude * jnp.einsum("mcr,dc,nr->mnd", *parts)
        by_levels = by_levels + jnp.tensordot(seen**2, relative * by_relative, 2)
    own = amplitude * solved(back(observed))
    moved_nodes = _on_points(roots, by_numbers @ jnp.stack(errors) + amplitude * own)
    by_left = by_z - by_discrepancy - relative * (weights @ moved_nodes.T)
    found = left, white, jnp.log(jnp.diagonal(root))
    return found, (by_left, by_numbers @ jnp.stack(whites) + own, by_levels)


def _halved(matrix: Array) -> Array:
    """The lower triangle whose sum with its transpose is a symmetric matrix."""
    return jnp.tril(matrix) - 0.5 * jnp.diag(jnp.diagonal(matrix))


# ---- the process ----


class Whitened(NamedTuple):
    """Residuals that are independent, of N measurements in C channels, with C R white numbers.

    residuals: z - A c, (N, C). latent: c, (C R,). levels: the logarithms of the diagonal of B's root, (C R,), none
    below 0.
    """

    residuals: Array
    latent: Array
    levels: Array


class Process(eqx.Module):
    """A process on R `InducingPoints`. gram: `gram_of` measurements, (C, R, R), where their noise is known; else
    None."""

    where: Array
    weights: Array
    shortest: Array
    gram: Array | None = None

    def gram_of(self, relative: Array) -> Array:
        """What measurements say of inducing points, (C, R, R); relative: an error of 1 in units of the noise, (N,
        C)."""
        return _gram(self.weights, relative)

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals z (N, C) in units of the noise; relative: as for `gram_of`."""
        numbers = _vector_of(at, z.shape[-1])
        return Whitened(*_whitened(numbers, self.where, self.weights, self.gram, z, relative))

    def sample(self, white: Array, at: Correlation) -> Array:
        """Errors of the measurements, (N, C), from standard normal numbers (C, R)."""
        roots = _roots_of(_vector_of(at, len(white)), self.where, len(white))
        return at.amplitude * self.weights @ _on_points(roots, white.reshape(-1)).T

    def whitened_residuals(self, z: Array, relative: Array, at: Correlation) -> Array:
        """Residuals z (N, C) by the symmetric root of their covariance, K^-1/2 z with K = 1 + A A'.

        Where the model holds they are independent standard normal, and their squares add up to z'K^-1 z. What is left
        of z beside what the process explains (`whitened`) is neither: the process follows each datum, so that it is
        smaller than 1, and negatively correlated between neighbours. Leave-one-out residuals (`leave_one_out`) have
        variance 1, but are correlated, too.
        """
        roots, square = self._roots_and_square(relative, at)
        spread, axes = jnp.linalg.eigh(at.amplitude**2 * square)  # of A'A
        root = jnp.sqrt(1.0 + jnp.maximum(spread, 0.0))
        explained = at.amplitude * _from_points(roots, (self.weights.T @ (relative * z)).T)
        white = -(axes @ ((axes.T @ explained) / (root * (1.0 + root))))  # ((1 + s)^-1/2 - 1) / s
        return z + relative * (self.weights @ (at.amplitude * _on_points(roots, white)).T)

    def leave_one_out(self, whitened_data: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each measurement its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise.
        """
        roots, root = self._factors(relative, at)
        rows = at.amplitude * jnp.einsum(
            "nc,cx,nr->ncxr", relative, roots.channels, self.weights @ roots.inducing_points
        )
        solved = solve_triangular(root, rows.reshape(relative.size, -1).T, lower=True)
        return whitened_data.residuals, 1.0 - jnp.sum(solved**2, axis=0).reshape(relative.shape)

    def predict(
        self, whitened_data: Whitened, relative: Array, at_places: Array, at: Correlation
    ) -> tuple[Array, Array]:
        """Errors of the model at other `places`, given residuals that were whitened: mean and sd, (M, C)."""
        roots, root = self._factors(relative, at)
        sizes, own = (jnp.exp(at.grazing_exponent * log_scales(where)) for where in (self.where, at_places))
        across = sizes[:, None] * own * correlation(self.where, at_places, at.length_half, at.length_difference)
        across = solve_triangular(roots.inducing_points, across, lower=True)
        rows = at.amplitude * jnp.einsum("cx,rm->mcxr", roots.channels, across)
        rows = rows.reshape(*rows.shape[:2], -1)
        solved = solve_triangular(root, rows.reshape(-1, rows.shape[-1]).T, lower=True)
        explained = jnp.sum(rows**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(rows.shape[:2])
        size = at.amplitude * own
        return -rows @ whitened_data.latent, jnp.sqrt(jnp.maximum(size[:, None] ** 2 - explained, 0.0))

    def information_rows(self, relative: Array, at: Correlation) -> Array:
        """Rows whose Jacobian A has in A'A the Fisher information of the measurements about the numbers of the process.

        With M = 1 - B^-1 and E = X + X' (see `whitening`), it is tr(M E M E) / 2.
        """
        numbers = _vector_of(at, relative.shape[-1])
        held = jax.lax.stop_gradient(numbers)
        roots, root = self._factors(relative, Correlation(*held, *[0.0] * (5 - len(held))))
        inverse = _triangular_inverse(root)
        seen = jnp.eye(len(root)) - inverse.T @ inverse
        parts = [2.0 / jnp.where(held[0] > 0.0, held[0], 1.0) * seen]
        for step in _moves_of(held, self.where, roots):
            parts.append(_moved(seen, step._replace(factor=step.factor + step.factor.T), roots))
        flat = jnp.stack(parts)
        information = 0.5 * jnp.einsum("kij,lji->kl", flat, flat)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), LEAST_INFORMATION))
        scaled = information * scale[:, None] * scale + LEAST_INFORMATION * jnp.eye(len(scale))
        return jax.lax.stop_gradient(jnp.linalg.cholesky(scaled).T / scale) @ numbers

    def _factors(self, relative: Array, at: Correlation) -> tuple[Roots, Array]:
        """Roots of the covariances, and of B."""
        roots, square = self._roots_and_square(relative, at)
        return roots, _root_of(jnp.asarray(at.amplitude, float), square)

    def _roots_and_square(self, relative: Array, at: Correlation) -> tuple[Roots, Array]:
        return _roots_and_square(_vector_of(at, relative.shape[-1]), self.where, self.weights, self.gram, relative)


def make_process(wi: ArrayLike, wo: ArrayLike, channels: int = 1) -> Process:
    """The process of measurements along these directions, (N, 3) each, in so many channels."""
    return Process(*map(jnp.asarray, inducing_points(wi, wo, channels)))
