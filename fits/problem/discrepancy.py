"""Model discrepancy: what a stack systematically misses, a Gaussian process of log BSDF (Kennedy & O'Hagan 2001).

With model value f, datum d and noise n, g(d) = g(f) + e + n, where g is the logarithm and, below four standard
deviations of the noise, a straight line (`logarithm`). e has Matern kernels of the angles of half vector and difference
(Rusinkiewicz 1998), folded so that light and viewer may change places: errors follow a lobe from one incidence to the
next, and a measurement at 10 and 70 degrees says something of that at 70 and 10. Their standard deviation grows towards
grazing, by a power of the mean cosine of light and viewer, cos half cos difference. Channels have one correlation. The
process lives on inducing points, and costs a matrix of as many rows: the places of all measurements where these are
few, else of some, on which the others are regressed. Noise is that of the datum, so that the covariance does not depend
on the model, and most of its derivatives vanish.

What N measurements say of the errors at the inducing points is what their least squares y say, whose covariance by
independent noise is G^-1. With residuals z and errors W u of measurements in standard deviations of the noise, G = W'W,
K the covariance of u, and S = G^-1 + K that of y, the negative log-density is half a sum of squares again, up to a
constant:

    z'(1 + W K W')^-1 z + log det (1 + W K W') = |z - W y|^2 + y'S^-1 y + log det S - log det G^-1.

Where the noise is known G^-1 is, too, and a density costs one Cholesky decomposition of S.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.lax.linalg import cholesky
from jax.scipy.linalg import block_diag, solve_triangular
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

    Each parameter is a number, `Free`, or None for a free one with a wide prior. The kernel is a Matern kernel.

    Args:
        amplitude: standard deviation where light and viewer are along the normal, unitless, in [1e-6, 1].
        length_half: length scale in the half angle, in degrees in [0.1, 360].
        length_difference: length scale in the difference angle, in degrees in [0.1, 360].
        grazing_exponent: power of 2 / (cos i + cos o), by which the standard deviation increases, in [0, 2].
        channel_correlation: correlation of two channels, in [0, 1].
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


def size(x: Any, s: Any) -> Any:
    """1 / g'(x), in the unit of x: by so much does x change with an error of 1 in the logarithm."""
    return x.__array_namespace__().hypot(x, s)


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


class Projection(NamedTuple):
    """How well the measurements by themselves tell the errors at inducing points, in each channel.

    covariance: G^-1 of the least squares, (C, R, R). root: its Cholesky factor, (C, R, R).
    """

    covariance: Array
    root: Array


def project(weights: Any, relative: Any) -> Projection:
    """The projection of measurements with these weights (N, R) and errors, see `Process`; of numpy or JAX."""
    xp = weights.__array_namespace__()

    def root(column: Any) -> Any:
        rows = column[:, None] * weights
        scale = 1.0 / xp.linalg.norm(rows, axis=0)
        gram = _with_jitter((rows * scale).T @ (rows * scale), 0.0)
        upper = xp.linalg.cholesky(gram[::-1, ::-1])[::-1, ::-1]  # G = U U', so that G^-1 = U^-1' U^-1
        return scale[:, None] * xp.linalg.inv(upper).T

    roots = xp.stack([root(column) for column in relative.T])
    return Projection(roots @ xp.swapaxes(roots, 1, 2), roots)


class Whitened(NamedTuple):
    """Independent residuals, of N measurements in C channels and R inducing points, as `fits.problem.discrepancy` says.

    unfitted: z - W y, (N, C). estimates: (S^-1/2) y, (C R,). levels: logarithms of the diagonal of the root of S over
    that of G^-1, (C R,), none below 0. information: rows whose Jacobian A has in A'A the Fisher information of the
    measurements about what they are predicted to be, and about the numbers of the process, tr(S^-1 dS S^-1 dS) / 2.
    """

    unfitted: Array
    estimates: Array
    levels: Array
    information: Array


class Regression(NamedTuple):
    """A process beside measurements: their projection, the least-squares errors y at inducing points, (C, R), and the
    Cholesky factor of the covariance S of y, (C R, C R)."""

    projection: Projection
    estimate: Array
    root: Array

    @property
    def white(self) -> Array:
        """The estimates as independent numbers of variance 1, (C R,)."""
        return solve_triangular(self.root, self.estimate.reshape(-1), lower=True)

    @property
    def levels(self) -> Array:
        """See `Whitened`."""
        own = jnp.diagonal(self.projection.root, axis1=1, axis2=2)
        return jnp.log(jnp.diagonal(self.root)) - jnp.log(own).reshape(-1)


class Process(eqx.Module):
    """A process on R inducing points among the places of N measurements.

    `misfit`, (N, C), is the logarithm of what is predicted less that of measurements; `relative`, (N, C), an error of 1
    in it in units of the noise. Residuals z are their product.

    Attributes:
        where: the inducing points, (R, 4), see `places`.
        weights: (N, R), from inducing points to measurements.
        shortest: (2,), what errors reach at least, in degrees of half vector and difference, so that inducing points
            carry them.
        projection: that of the measurements where their noise is known; else None.
    """

    where: Array
    weights: Array
    shortest: Array
    projection: Projection | None = None

    def regress(self, misfit: Array, relative: Array, numbers: Array) -> Regression:
        """What measurements say of errors at inducing points, beside what the process does."""
        projection = project(self.weights, relative) if self.projection is None else self.projection
        estimate = _each_channel(projection.covariance, self.observed(relative * misfit, relative))
        both = block_diag(*projection.covariance) + self._covariance(numbers, relative.shape[-1])
        return Regression(projection, estimate, _root(both))

    def observed(self, z: Array, relative: Array) -> Array:
        """W'z, (C, R)."""
        return (relative * z).T @ self.weights

    def errors(self, at_points: Array, relative: Array) -> Array:
        """Errors of measurements, W u, (N, C), from those at inducing points, (C, R)."""
        return relative * (self.weights @ at_points.T)

    def whitened(self, misfit: Array, relative: Array, at: Correlation) -> Whitened:
        """Residuals as independent numbers."""
        return Whitened(*_whitened(misfit, relative, self._numbers(at, relative.shape[-1]), process=self))

    def sample(self, white: Array, at: Correlation) -> Array:
        """Errors of the measurements, (N, C), from standard normal numbers (C, R)."""
        between, own = map(_root, self._covariances(self._numbers(at, len(white)), len(white)))
        return at.amplitude * self.weights @ (between @ white @ own.T).T

    def whitened_residuals(self, misfit: Array, relative: Array, at: Correlation) -> Array:
        """Residuals z by the symmetric root of their covariance, (N, C): K^-1/2 z with K = 1 + W K W'.

        Where the model holds they are independent standard normal, and their squares add up to z'K^-1 z. What is left
        of z beside what the process explains (`leave_one_out`) is neither: the process follows each datum, so that it
        is smaller than 1, and negatively correlated between neighbours. Leave-one-out residuals have variance 1, but
        are correlated, too.
        """
        found, z = self.regress(misfit, relative, self._numbers(at, relative.shape[-1])), relative * misfit
        own = block_diag(*found.projection.root)  # W times it has orthonormal columns
        half = solve_triangular(own, found.root, lower=True)
        spread, axes = jnp.linalg.eigh(half @ half.T)
        explained = (own @ axes).T @ self.observed(z, relative).reshape(-1)
        shrunk = own @ axes @ ((1.0 / jnp.sqrt(jnp.maximum(spread, 1.0)) - 1.0) * explained)
        return z + self.errors(shrunk.reshape(found.estimate.shape), relative)

    def leave_one_out(self, misfit: Array, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Weighted residuals, z less the errors that the process implies, and precisions, (N, C).

        Given all others a measurement has mean residual / precision and variance 1 / precision, in units of the noise.
        """
        found = self.regress(misfit, relative, self._numbers(at, relative.shape[-1]))
        weighted = solve_triangular(found.root, found.white, lower=True, trans=1).reshape(found.estimate.shape)
        explained = found.estimate - _each_channel(found.projection.covariance, weighted)
        rows = self._estimate_rows(relative, found.projection)  # of the precision: 1 - W G^-1 W' + W G^-1 S^-1 G^-1 W'
        both = jnp.einsum("cx,crn->crxn", jnp.eye(len(rows)), rows).reshape(len(found.root), -1)
        inside = jnp.sum(solve_triangular(found.root, both, lower=True) ** 2, axis=0).reshape(relative.shape[::-1])
        precision = 1.0 - relative * jnp.einsum("crn,nr->nc", rows, self.weights) + inside.T
        # no less than that of a measurement by itself, which rounding may lose beside much smaller noise
        between, own = self._covariances(self._numbers(at, relative.shape[-1]), relative.shape[-1])
        variances = (
            at.amplitude**2 * jnp.sum(self.weights @ own * self.weights, axis=1)[:, None] * jnp.diagonal(between)
        )
        precision = jnp.maximum(precision, 1.0 / (1.0 + relative**2 * variances))
        return relative * misfit - self.errors(explained, relative), precision

    def predict(self, at_places: Array, misfit: Array, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Errors of the model at other `places`, given those of measurements: mean and sd, (M, C)."""
        numbers, channels = self._numbers(at, relative.shape[-1]), relative.shape[-1]
        found, between = self.regress(misfit, relative, numbers), self._covariances(numbers, channels)[0]
        sizes, own = (at.amplitude * jnp.exp(at.grazing_exponent * log_scales(x)) for x in (self.where, at_places))
        across = sizes[:, None] * own * correlation(self.where, at_places, at.length_half, at.length_difference)
        rows = jnp.einsum("cx,rm->crmx", between, across).reshape(len(found.root), -1)
        solved = solve_triangular(found.root, rows, lower=True).reshape(-1, len(own), channels)
        variance = own[:, None] ** 2 - jnp.sum(solved**2, axis=0)
        return -jnp.tensordot(found.white, solved, 1), jnp.sqrt(jnp.maximum(variance, 0.0))

    def _numbers(self, at: Correlation, channels: int) -> Array:
        """Those of a process that matter, (4,) or (5,)."""
        return jnp.stack([jnp.asarray(number, float) for number in (at if channels > 1 else at[:4])])

    def _covariances(self, numbers: Array, channels: int) -> tuple[Array, Array]:
        """Covariances between channels, (C, C), and between inducing points, (R, R), at an amplitude of 1."""
        together = numbers[4] if channels > 1 else jnp.zeros(())
        sizes = jnp.exp(numbers[3] * log_scales(self.where))
        own = _with_jitter(correlation(self.where, self.where, numbers[1], numbers[2]))
        return _with_jitter(together + (1.0 - together) * jnp.eye(channels)), sizes[:, None] * own * sizes

    def _covariance(self, numbers: Array, channels: int) -> Array:
        """Covariance of errors at inducing points, (C R, C R)."""
        between, own = self._covariances(numbers, channels)
        rounding = _rounding(own, len(between) * len(own))  # smallest eigenvalues are products of those of the two
        both, variances = jnp.kron(between, own), jnp.kron(jnp.diagonal(between), jnp.diagonal(own))
        return (both + rounding * jnp.diag(variances)) * numbers[0] ** 2

    def _estimate_rows(self, relative: Array, projection: Projection) -> Array:
        """G^-1 W', (C, R, N): the estimate by each measurement."""
        return projection.covariance @ (relative[:, None] * self.weights[..., None]).T


@eqx.filter_custom_jvp
def _whitened(misfit: Array, relative: Array, numbers: Array, *, process: Process) -> tuple[Array, ...]:
    """What `Whitened` holds. Where the noise is known `relative` depends on no parameter."""
    found = process.regress(misfit, relative, numbers)
    unfitted = relative * misfit - process.errors(found.estimate, relative)
    return unfitted, found.white, found.levels, jnp.concatenate([unfitted.reshape(-1), found.white, numbers])


@_whitened.def_jvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...], *, process: Process) -> tuple[Any, Any]:
    """In closed form: with X = S^-1/2 dS S^-1/2', and L(X) its lower triangle with half of its diagonal,

        d(S^-1/2 y) = S^-1/2 dy - L(X) S^-1/2 y,    d log diag S^1/2 = diag X / 2.

    So a Jacobian by many parameters makes matrices for the few numbers of the process alone. Noise that is fitted
    changes `relative` by shares s: dW = s W, dy = G^-1 W'(s (2 z - 2 W y)), dG^-1 = -2 G^-1 W's W G^-1.
    """
    misfit, relative, numbers = primals
    by_misfit, by_relative, by_numbers = (
        jnp.zeros_like(one) if tangent is None else tangent for one, tangent in zip(primals, tangents, strict=True)
    )
    found = process.regress(misfit, relative, numbers)
    own, fitted = found.projection, process.errors(found.estimate, relative)
    inverse = solve_triangular(found.root, jnp.eye(len(found.root), dtype=found.root.dtype), lower=True)
    unfitted, white = relative * misfit - fitted, inverse @ found.estimate.reshape(-1)

    # by what is predicted
    estimate = _each_channel(own.covariance, process.observed(relative * by_misfit, relative))
    by_unfitted, by_white = relative * by_misfit - process.errors(estimate, relative), inverse @ estimate.reshape(-1)
    information = [by_unfitted.reshape(-1), by_white]

    # by the numbers of the process
    changes = jax.jacfwd(lambda numbers: process._covariance(numbers, relative.shape[-1]))(numbers)
    changes = inverse @ jnp.moveaxis(changes, -1, 0) @ inverse.T
    halves = 0.5 * jnp.diagonal(changes, axis1=1, axis2=2)
    by_white = by_white - by_numbers @ (jnp.tril(changes) @ white - halves * white)
    by_levels = by_numbers @ halves
    information.append(_information_root(0.5 * jnp.einsum("kij,lij->kl", changes, changes)) @ by_numbers)

    # by the noise
    if process.projection is None:
        shares = by_relative / relative
        estimate = _each_channel(own.covariance, process.observed(2.0 * shares * unfitted, relative))
        by_unfitted = by_unfitted + shares * unfitted - process.errors(estimate, relative)
        rows = process._estimate_rows(relative, own)
        alone = solve_triangular(own.root, rows, lower=True)
        rows = jnp.einsum("mcr,crn->mcn", inverse.reshape(len(inverse), *found.estimate.shape), rows)
        weighted = rows * white[:, None, None]
        below = jnp.cumsum(weighted, axis=0) - 0.5 * weighted
        by_white = by_white + inverse @ estimate.reshape(-1) + 2.0 * jnp.einsum("mcn,mcn,nc->m", rows, below, shares)
        by_levels = by_levels - jnp.einsum("mcn,nc->m", rows**2, shares)
        by_levels = by_levels + jnp.einsum("crn,nc->cr", alone**2, shares).reshape(-1)
    value = unfitted, white, found.levels, jnp.concatenate([unfitted.reshape(-1), white, numbers])
    return value, (by_unfitted, by_white, by_levels, jnp.concatenate(information))


def _information_root(information: Array) -> Array:
    """A root of the information about the numbers of a process, (K, K), of which some may have no effect."""
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), LEAST_INFORMATION))
    scaled = information * scale[:, None] * scale + LEAST_INFORMATION * jnp.eye(len(scale))
    return jnp.linalg.cholesky(scaled).T / scale


def _each_channel(matrices: Array, columns: Array) -> Array:
    """Matrices (C, R, R) times columns (C, R)."""
    return jnp.einsum("crs,cs->cr", matrices, columns)


def _root(matrix: Array) -> Array:
    """Cholesky factor of a symmetric matrix: XLA would compute its elements twice to symmetrise it."""
    return cholesky(matrix, symmetrize_input=False)


def _with_jitter(matrix: Any, least: float = JITTER) -> Any:
    """A matrix of correlations with what rounding leaves of its smallest eigenvalues on its diagonal."""
    rounding = _rounding(matrix, len(matrix))  # above `JITTER` in single precision alone
    return matrix + max(least, rounding) * np.eye(len(matrix), dtype=matrix.dtype)


def _rounding(matrix: Any, rows: int) -> float:
    """What rounding leaves of the eigenvalues of so many rows, as a share of the largest."""
    return 4.0 * rows * float(jnp.finfo(matrix.dtype).eps)


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
    return Process(jnp.asarray(among), jnp.asarray(weights), jnp.asarray(shortest))
