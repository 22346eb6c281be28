"""The posterior along a ridge, or about several minima: a mixture of heavy-tailed densities in the box, to draw from.

In the box, not in log-odds: there a posterior has no long tails towards its bounds. What is drawn outside is refused.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats
from scipy.cluster.vq import ClusterError, kmeans2
from scipy.special import expit, logit, logsumexp

from fits.optimise.result import Fit
from fits.optimise.uncertainty import local_information
from fits.problem.problem import Problem
from fits.sampling.laplace import DEGREES_OF_FREEDOM, slope_at_bounds, student, student_draws, student_peak
from fits.sampling.modes import WITHIN, places
from fits.sampling.ridge import open_directions, ridge

LEAST_PART = 0.01  # of the squared length of an open direction
LOOSE = 10.0  # in the log-posterior, a box
SMALLEST_REACH, WIDEST_REACH = 1e-9, 0.3  # of the box
LEAST = 1e-12  # variance, of a unit, that a combination of parameters keeps
REFINEMENTS = 10
MOST_SAMPLES = 4000
OWN_SAMPLES = 2.0  # that a component counts as
KEPT = 0.1  # of a mixture that is refined
MIXTURE, MODES = "mixture_", "modes_"  # how names of arrays begin: of proposals, and of where modes are
COMPONENTS = 12  # of one that is fitted to samples
APART = 3.0  # standard deviations: minima that are closer are one mode
HALF_LOG = 0.5 * np.log(2.0 * np.pi)

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mixture:
    """A density over the unconstrained vectors of a problem with P parameters: M Student-t densities in the box.

    centre: (M, P). root: (M, P, P), whose product with its transpose is a covariance. log_weight: (M,). held: (P,)
    bool, at a bound: a component is folded over there, and the parameter independent of the others; none where there
    are several modes. modes: (M,), to which of the modes of the posterior a component belongs, 0 the best minimum's.
    """

    centre: Floats
    root: Floats
    log_weight: Floats
    held: NDArray[np.bool_]
    modes: NDArray[np.int64]

    @classmethod
    def of(cls, fit: Fit) -> "Mixture | None":
        """The mixture about the points of a fit's ridge, and of those of its other minima that hold a share of the
        posterior, as wide as the information there; None where there is one point alone."""
        parts: list[Mixture] = []
        for place in places(fit):
            if any(part._holds(place.unit) for part in parts):
                continue
            parts.append(cls._about(fit.problem, place.unit, place.held))
        # by Laplace's approximation; of what a bound holds it is half a density, and falls off otherwise
        masses = [logsumexp(part.log_weight) - HALF_LOG * np.sum(part.held) for part in parts]
        parts = [part for part, mass in zip(parts, masses, strict=True) if mass > max(masses) - WITHIN]
        if len(parts) == 1:
            (only,) = parts
            return None if len(only.centre) == 1 else only._normalised()
        weights = [part.log_weight - HALF_LOG * np.sum(part.held) for part in parts]
        return cls(
            np.concatenate([part.centre for part in parts]),
            np.concatenate([part.root for part in parts]),
            np.concatenate(weights),
            np.zeros(len(fit.problem.names), bool),
            np.repeat(np.arange(len(parts)), [len(part.centre) for part in parts]),
        )._normalised()

    @classmethod
    def _about(cls, problem: Problem, optimum: Floats, held: NDArray[np.bool_]) -> "Mixture":
        """The mixture about the points of the ridge of a minimum, its weights those of the posterior but for a factor
        that all minima have in common."""
        slope = slope_at_bounds(problem, optimum, held)
        # what is hardly pressed against its bound, and open with others, lies along the ridge
        if held.any():
            part = np.sum(open_directions(local_information(problem, optimum)[0]) ** 2, axis=0)
            held = held & ((part < LEAST_PART) | (slope > LOOSE))
        found = ridge(problem, optimum, ~held)
        count = len(found.points)
        reach = np.clip(1.0 / np.maximum(slope, SMALLEST_REACH), SMALLEST_REACH, WIDEST_REACH)
        data = np.where(held, 0.0, found.rows)
        at_bound, wide = np.diag(1.0 / reach)[held], np.eye(len(held)) / WIDEST_REACH
        rows = [data, found.bounds, *(np.tile(part, (count, 1, 1)) for part in (at_bound, wide))]
        _, values, directions = np.linalg.svd(np.concatenate(rows, axis=1), full_matrices=False)
        root = np.swapaxes(directions, 1, 2) / values[:, None]
        log_weight = found.height + np.linalg.slogdet(root)[1]
        return cls(found.points, root, log_weight, held, np.zeros(count, int))

    @property
    def mode_count(self) -> int:
        """How many modes the posterior has, as far as it is known."""
        return int(self.modes.max()) + 1

    def mode_of(self, positions: Floats) -> NDArray[np.int64]:
        """Which mode each of unconstrained `positions` (count, P) belongs to, (count,)."""
        return self.modes[np.argmax(self._log_parts(expit(positions)), axis=0)]

    def _holds(self, unit: Floats) -> bool:
        """Whether a point (P,) of the box lies so close to a component that it is no mode of its own."""
        away = np.linalg.solve(self.root, (unit - self.centre)[..., None])[..., 0]
        return bool(np.min(np.linalg.norm(away, axis=1)) < APART)

    def _normalised(self) -> "Mixture":
        return replace(self, log_weight=self.log_weight - logsumexp(self.log_weight))

    @classmethod
    def through(cls, positions: Floats, generator: np.random.RandomState) -> "Mixture":
        """The mixture fitted to samples (count, P) of a posterior, two at least; any may be there repeatedly."""
        samples = expit(positions)
        values, directions = np.linalg.eigh(np.atleast_2d(np.cov(samples.T)))
        root = directions * np.sqrt(np.maximum(values, SMALLEST_REACH**2))
        white = np.linalg.solve(root, samples.T).T
        centres, nearest = _clusters(white, generator)
        within = _root(np.atleast_2d(np.cov((white - centres[nearest]).T)))
        log_weight = np.full(len(centres), -np.log(len(centres)))
        roots = np.tile(root @ within, (len(centres), 1, 1))
        dimension = white.shape[1]
        mixture = cls(centres @ root.T, roots, log_weight, np.zeros(dimension, bool), np.zeros(len(centres), int))
        return mixture.refined(positions)

    def arrays(self, prefix: str = MIXTURE) -> dict[str, Any]:
        """What `from_arrays` makes it of, named apart from what else a chain keeps of its moves."""
        return {f"{prefix}{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def within(cls, arrays: dict[str, Any], prefix: str = MIXTURE) -> bool:
        """Whether a mixture's `arrays` are among these."""
        return f"{prefix}centre" in arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], prefix: str = MIXTURE) -> "Mixture":
        """The mixture of these `arrays`."""
        # of a chain that was begun before there were several modes
        one = {f"{prefix}modes": np.zeros(len(arrays[f"{prefix}log_weight"]), int)}
        return cls(*(np.asarray((one | arrays)[f"{prefix}{field.name}"]) for field in fields(cls)))

    def leaps(self) -> "Leaps":
        """The mixture in JAX; none of its parameters is held at a bound."""
        assert not self.held.any()
        dimension = self.centre.shape[1]
        level = self.log_weight - np.linalg.slogdet(self.root)[1] + student_peak(dimension)
        parts = self.centre, self.root, np.linalg.inv(self.root), self.log_weight, level
        return Leaps(*(jnp.asarray(part) for part in parts))

    def refined(self, positions: Floats) -> "Mixture":
        """The mixture fitted to samples (count, P) of the posterior, with a share of what it was.

        By expectation and maximisation; every component counts as samples of its own, so that it keeps its full rank.
        """
        samples = expit(positions[:: -(-len(positions) // MOST_SAMPLES)])
        dimension = samples.shape[1]
        prior = self.root @ np.swapaxes(self.root, 1, 2)
        now = self
        for _ in range(REFINEMENTS):
            parts = now._log_parts(samples)
            share = np.exp(parts - logsumexp(parts, axis=0))
            count = share.sum(axis=1)
            centre = (share @ samples + OWN_SAMPLES * self.centre) / (count + OWN_SAMPLES)[:, None]
            centre[:, self.held] = self.centre[:, self.held]
            away, moved = samples - centre[:, None], (self.centre - centre)[:, :, None]
            scatter = np.einsum("mn,mni,mnj->mij", share, away, away) + OWN_SAMPLES * moved * np.swapaxes(moved, 1, 2)
            own = OWN_SAMPLES + dimension
            covariance = (scatter + own * prior) / (count + own)[:, None, None]
            covariance *= np.where(self.held[:, None] | self.held, np.eye(dimension), 1.0)
            log_weight = np.log((count + 1.0) / (count + 1.0).sum())
            now = Mixture(centre, _root(covariance), log_weight, self.held, self.modes)
        centres, roots = np.concatenate([now.centre, self.centre]), np.concatenate([now.root, self.root])
        weights = np.concatenate([np.log1p(-KEPT) + now.log_weight, np.log(KEPT) + self.log_weight])
        return Mixture(centres, roots, weights, self.held, np.concatenate([self.modes, self.modes]))

    def mean_log_density(self, positions: Floats) -> float:
        """Mean log-density over samples of the posterior: the higher, the closer the mixture is to it."""
        return float(np.mean(self.log_density(positions)))

    def log_density(self, positions: Floats) -> Floats:
        """Log-density at unconstrained `positions` (count, P); what is drawn outside the box counts in its integral."""
        units = expit(positions)
        stretch = np.sum(stats.logistic.logpdf(positions), axis=1)  # d box / d log-odds
        return logsumexp(self._log_parts(units), axis=0) + np.log(2.0) * np.sum(self.held) + stretch

    def draw(self, generator: np.random.RandomState, count: int, shrink: float = 1.0) -> Floats:
        """(count, P) independent draws inside the box, `shrink` times closer to points of the ridge."""
        drawn = np.empty((0, len(self.held)))
        while len(drawn) < count:
            more = self._draw(generator, count, shrink)
            drawn = np.concatenate([drawn, more[_inside(more)]])
        return logit(drawn[:count])

    def draw_all(self, generator: np.random.RandomState, count: int) -> tuple[Floats, NDArray[np.bool_]]:
        """(count, P) independent draws, and which of them, (count,), lie inside the box; the others mean nothing."""
        drawn = self._draw(generator, count, 1.0)
        inside = _inside(drawn)
        return logit(np.where(inside[:, None], drawn, 0.5)), inside

    def propose(self, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
        """Independent proposals for `emcee.moves.MHMove`, and the log-ratio of densities it asks for."""
        drawn = self._draw(generator, len(positions), 1.0)
        inside = _inside(drawn)
        proposed = positions.copy()
        proposed[inside] = logit(drawn[inside])
        ratio = self.log_density(positions) - self.log_density(proposed)
        return proposed, np.where(inside, ratio, -np.inf)

    def _draw(self, generator: np.random.RandomState, count: int, shrink: float) -> Floats:
        which = generator.choice(len(self.centre), count, p=np.exp(self.log_weight))
        away = np.einsum("nij,nj->ni", self.root[which], student_draws(generator, count, len(self.held)))
        bound = np.where(self.centre[which] < 0.5, 1.0, -1.0)
        away = np.where(self.held, bound * np.abs(away), away)
        return self.centre[which] + shrink * away

    def _log_parts(self, units: Floats) -> Floats:
        """What every component adds to the log-density in the box, unfolded, (M, count)."""
        parts = zip(self.log_weight, self.centre, self.root, strict=True)
        return np.stack([weight + student(centre, root, units) for weight, centre, root in parts])


class Leaps(NamedTuple):
    """A `Mixture` for programs: inverse of its roots, and level: what a component adds to the log-density's peak."""

    centre: Array
    root: Array
    inverse: Array
    log_weight: Array
    level: Array

    def log_density(self, position: Array) -> Array:
        """Log-density at an unconstrained position (P,)."""
        white = jnp.einsum("mij,mj->mi", self.inverse, jax.nn.sigmoid(position) - self.centre)
        freedom = 0.5 * (DEGREES_OF_FREEDOM + position.shape[0])
        parts = self.level - freedom * jnp.log1p(jnp.sum(white**2, axis=1) / DEGREES_OF_FREEDOM)
        return jax.nn.logsumexp(parts) + jnp.sum(jax.nn.log_sigmoid(position) + jax.nn.log_sigmoid(-position))

    def draw(self, key: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """Independent draws (*shape, P), unconstrained, and whether they are inside the box (*shape)."""
        of_components, of_normals, of_widths = jax.random.split(key, 3)
        which = jax.random.categorical(of_components, self.log_weight, shape=shape)
        normal = jax.random.normal(of_normals, (*shape, self.centre.shape[1]), self.centre.dtype)
        squares = jax.random.normal(of_widths, (*shape, int(DEGREES_OF_FREEDOM)), normal.dtype) ** 2
        normal /= jnp.sqrt(jnp.mean(squares, axis=-1, keepdims=True))
        unit = self.centre[which] + jnp.einsum("...ij,...j->...i", self.root[which], normal)
        inside = jnp.all((unit > 0.0) & (unit < 1.0), axis=-1)
        return jax.scipy.special.logit(jnp.where(inside[..., None], unit, 0.5)), inside


def _clusters(points: Floats, generator: np.random.RandomState) -> tuple[Floats, NDArray[np.int_]]:
    """Centres of up to `COMPONENTS` clusters, none of them empty, and which one each point belongs to."""
    for count in range(min(COMPONENTS, len(np.unique(points.round(6), axis=0))), 1, -1):
        try:
            return kmeans2(points, count, minit="++", missing="raise", rng=generator)
        except ClusterError:
            continue
    return points.mean(axis=0, keepdims=True), np.zeros(len(points), int)


def _root(covariance: Floats) -> Floats:
    """Roots (..., P, P) of covariances, of full rank however little rounding has left of it."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    scale = np.sqrt(np.maximum(variance, SMALLEST_REACH**2))
    scaled = covariance / (scale[..., None] * scale[..., None, :])
    short = 1.0 - variance / scale**2  # of a unit, where there is next to no variance
    return scale[..., None] * np.linalg.cholesky(scaled + (short + LEAST)[..., None] * np.eye(scaled.shape[-1]))


def _inside(units: Floats) -> NDArray[np.bool_]:
    return np.all((units > 0.0) & (units < 1.0), axis=1)
