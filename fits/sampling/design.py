"""Where a surrogate is fitted: at draws of the fit's approximation, then at draws of the surrogate's own posterior.

Without points farther out its tails are cut off, and nothing says so: a quarter of the draws is tempered, which
follows a ridge however it bends, a quarter moved away from their mean, which does not rely on the surrogate's own
tails, and a quarter comes from the approximation, which knows a ridge from end to end. A tail that is missed costs more
than its share of the posterior: a chain stays there. Every round is a check of the surrogate at points that it has not
seen, and the last one is used as it was checked.
"""

import io
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fits._files import write_bytes
from fits.problem.model import Model
from fits.problem.problem import Problem
from fits.progress import Progress
from fits.sampling.delayed_acceptance import DelayedAcceptance
from fits.sampling.laplace import Approximation
from fits.sampling.mixture import Mixture
from fits.sampling.surrogate import (
    Evaluated,
    Surrogate,
    affordable_degrees,
    evaluate_many,
    fitted,
    term_count,
    with_polynomials,
)

FIRST_POINTS, MORE_POINTS = 1.6, 1.3  # a term
FEWEST_POINTS = 128
AT_HIGHEST = 6  # rounds at most, of the highest degree
POINTS = FIRST_POINTS + MORE_POINTS * (AT_HIGHEST + 1)  # a term, at most
HOTTEST, COOLER_FROM = 2.5, 6  # temperature, with up to so many parameters: draws of more would miss the posterior
A_FEW = 5.0  # effective points
LOW = 7.0  # in the log-posterior below its height: points count no less that lie lower
NARROWEST = 1e-9
STRATA = 4  # of draws
SAMPLES = 1024  # of the surrogate's posterior, that a mixture is fitted to
SELDOM = 0.02  # chance to leave a point: less counts as this, for other moves see to it
GOOD, LONGEST = 1.2, 4.0  # steps that a chain would stay: no more points are needed, and it is of no use

Floats = NDArray[np.float64]


class Draws(NamedTuple):
    """Points (n, P), the surrogate's log-posterior there (n,), and the log-density that they were drawn from (n,)."""

    positions: Floats
    heights: Floats
    log_density: Floats


class Walked(NamedTuple):
    """A surrogate, and the root of a covariance and a mixture to walk with in its posterior."""

    surrogate: Surrogate
    root: Floats
    mixture: Mixture

    def moves(self) -> DelayedAcceptance:
        """The proposals of it."""
        return DelayedAcceptance(*self)

    def arrays(self) -> dict[str, Any]:
        """What `from_arrays` makes it of."""
        return {"root": self.root, **self.surrogate.arrays(), **self.mixture.arrays()}

    @classmethod
    def from_arrays(cls, model: Model, arrays: dict[str, Any]) -> "Walked | None":
        """That of a model, of these `arrays`; None where there are none."""
        if "root" not in arrays:
            return None
        return cls(with_polynomials(model, arrays), arrays["root"], Mixture.from_arrays(arrays))


class Built(NamedTuple):
    """What came of it: None where no surrogate holds; and words on it."""

    walked: Walked | None
    words: str


class Kept:
    """Exact evaluations of the rounds so far, in a file that a killed run goes on from. None keeps none."""

    def __init__(self, path: Path | None, identity: Mapping[str, Any]):
        self.path = path
        self._tag = f"{zlib.crc32(repr(sorted(identity.items())).encode()):08x}"
        self.rounds = [] if path is None or not path.is_file() else self._read(path)

    def add(self, points: Evaluated) -> None:
        """Keep one more round."""
        self.rounds.append(points)
        if self.path is not None:
            file = io.BytesIO()
            np.savez(
                file, **{f"{part}{n}": a for n, one in enumerate(self.rounds) for part, a in one._asdict().items()}
            )
            content = file.getvalue()
            head = f"{self._tag} {zlib.crc32(content):08x}\n".encode()
            write_bytes(self.path, head + content, force=True)

    def remove(self) -> None:
        """They are needed no more."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _read(self, path: Path) -> list[Evaluated]:
        head, _, content = path.read_bytes().partition(b"\n")
        if head != f"{self._tag} {zlib.crc32(content):08x}".encode():
            return []  # of another posterior, or damaged: evaluated again
        with np.load(io.BytesIO(content)) as stored:
            count = len(stored.files) // len(Evaluated._fields)
            return [Evaluated(*(stored[f"{part}{n}"] for part in Evaluated._fields)) for n in range(count)]


class Design:
    """Builds the surrogate of a problem, by evaluations of as many points at a time as there are walkers."""

    def __init__(self, problem: Problem, walkers: int, seed: int, kept: Kept, progress: Progress | None):
        self.problem, self.walkers, self.seed, self.kept, self.progress = problem, walkers, seed, kept, progress
        self.evaluations, self.note = 0, ""

    def build(self, initial: Approximation | Mixture) -> Built:
        """The surrogate of the lowest degree that is found to be good, or the last one of the highest."""
        dimension = len(self.problem.names)
        residuals = self.problem.model.rows
        degrees = affordable_degrees(dimension, residuals, POINTS)
        if not degrees:
            return Built(None, f"no surrogate of {dimension} parameters: exact evaluations alone")
        first = self._batches(FIRST_POINTS * term_count(dimension, degrees[0]) / 2.0)
        points = self._evaluated(self._first_draws(initial, first), 0).finite()
        if len(points.positions) < term_count(dimension, degrees[0]):
            return Built(None, "no surrogate, for want of finite values about the best fit")
        generator = self._generator(0)
        mixture = Mixture.through(initial.draw(generator, SAMPLES), generator)
        root, stay = _root(points), np.inf
        for number, degree in enumerate([*degrees, *degrees[-1:] * (AT_HIGHEST - 1)], 1):
            terms = term_count(dimension, degree)
            if len(points.positions) < terms:
                break
            surrogate = fitted(self.problem.model, degree, points)
            move = DelayedAcceptance(surrogate, root, mixture)
            settled = self._settled(move, points, number)
            draws = self._draws(move, settled, initial, self._batches(MORE_POINTS * terms / STRATA), number)
            new = self._evaluated(np.concatenate([part.positions for part in draws]), number)
            exact = np.split(new.log_posterior, len(draws))
            stay = mean_stay(draws, exact)
            root = _root(Evaluated(*(part[: len(exact[0])] for part in new)).finite(), root)
            mixture = Mixture.through(settled, self._generator(number))
            self.note = f"a chain would stay {stay:.1f} steps where it is"
            if stay <= GOOD:
                break
            points = points.joined(new.finite())
        if stay > LONGEST:
            return Built(None, f"the surrogate does not hold ({self.note}) and is left out")
        words = f"proposals from a surrogate of degree {surrogate.degree}, built with {self.evaluations} evaluations"
        return Built(Walked(surrogate, root, mixture), words)

    def _first_draws(self, initial: Approximation | Mixture, count: int) -> Floats:
        """Draws of the approximation, and as many whose parameters are shuffled: where it takes the posterior for
        narrower than it is in a direction, as derivatives of a rough model make it, these see that."""
        generator = self._generator(0)
        drawn = initial.draw(generator, count)
        shuffled = np.stack([generator.permutation(column) for column in drawn.T], axis=1)
        return np.concatenate([drawn, shuffled])

    @property
    def _temperature(self) -> float:
        return 1.0 + (HOTTEST - 1.0) * min(1.0, COOLER_FROM / len(self.problem.names))

    def _batches(self, count: float) -> int:
        """So many points, or a few more: as many at a time as there are walkers."""
        return self.walkers * int(np.ceil(max(count, FEWEST_POINTS) / self.walkers))

    def _generator(self, number: int) -> np.random.RandomState:
        return np.random.RandomState([self.seed, number])

    def _settled(self, move: DelayedAcceptance, points: Evaluated, number: int) -> Floats:
        """Samples of the surrogate's posterior: ends of walks one after another, from the best points on."""
        generator = self._generator(number)
        highest = np.argsort(-points.log_posterior)[: max(len(points.positions) // 2, 1)]
        visited = [points.positions[generator.choice(highest, self.walkers)]]
        while len(visited) * self.walkers < 2 * SAMPLES:
            visited.append(move.walk(visited[-1], generator)[0])
        return np.concatenate(visited[len(visited) // 2 :])

    def _draws(
        self, move: DelayedAcceptance, settled: Floats, initial: Approximation | Mixture, count: int, number: int
    ) -> list[Draws]:
        """Of the surrogate's posterior: `count` draws, as many tempered ones, and as many as far from their mean; and
        as many of the approximation."""
        generator = self._generator(number)
        positions = settled[generator.permutation(len(settled))[: 2 * count]]
        heights = move.heights(positions)
        plain, again = (
            Draws(positions[part], heights[part], heights[part]) for part in (slice(count), slice(count, None))
        )
        walks = [
            move.walk(part, generator, self._temperature) for part in np.split(plain.positions, count // self.walkers)
        ]
        ends, _, warm = (np.concatenate(parts) for parts in zip(*walks, strict=True))
        centre = again.positions.mean(axis=0)
        away = centre + np.sqrt(self._temperature) * (again.positions - centre)
        wide = initial.draw(generator, count)
        return [
            plain,
            Draws(ends, warm, warm / self._temperature),
            Draws(away, move.heights(away), again.heights),
            Draws(wide, move.heights(wide), initial.log_density(wide)),
        ]

    def _evaluated(self, positions: Floats, number: int) -> Evaluated:
        """Exact evaluations at the points of a round, those that were kept of it."""
        if number < len(self.kept.rounds) and np.array_equal(self.kept.rounds[number].positions, positions):
            self.evaluations += len(positions)
            return self.kept.rounds[number]
        del self.kept.rounds[number:]
        found = []
        for part in np.split(positions, len(positions) // self.walkers):
            found.append(evaluate_many(self.problem, part, self.walkers))
            self.evaluations += len(part)
            if self.progress is not None:
                self.progress("surrogate", self.evaluations, None, self.note)
        points = Evaluated(positions, *(np.concatenate(parts) for parts in zip(*found, strict=True)))
        self.kept.add(points)
        return points


def mean_stay(draws: Sequence[Draws], exact: Sequence[Floats]) -> float:
    """Steps that a chain of independent proposals from the surrogate stays where it is, on average, by unseen points.

    draws: of the surrogate's posterior, the proposals; then others that, weighted, stand for the exact posterior, where
    they come from: the longest of the stays, of those that stand for it with more than a few points. exact: its log at
    the points of each.
    """
    with np.errstate(invalid="ignore"):  # of points where nothing is finite
        to = _or_nowhere(exact[0] - draws[0].heights)
        stays = []
        for drawn, log_posterior in zip(draws[1:], exact[1:], strict=True):
            log_weight = _or_nowhere(log_posterior - drawn.log_density)
            seen = np.isfinite(log_weight)
            if not seen.any():
                continue
            weight = np.exp(log_weight[seen] - np.max(log_weight[seen]))
            off = to[None, :] - (log_posterior - drawn.heights)[seen, None]
            chance = np.exp(np.minimum(off, 0.0)).mean(axis=1)
            stay = np.average(1.0 / np.maximum(chance, SELDOM), weights=weight)
            stays.append((float(np.sum(weight) ** 2 / np.sum(weight**2)), float(stay)))
    if not stays:
        return np.inf
    return max([stay for effective, stay in stays if effective >= A_FEW] or [max(stays)[1]])


def _or_nowhere(log_density: Floats) -> Floats:
    return np.where(np.isfinite(log_density), log_density, -np.inf)


def _root(points: Evaluated, before: Floats | None = None) -> Floats:
    """A root of the covariance of the posterior, by its draws, or by points about it that count by their height."""
    if before is not None and len(points.positions) <= points.positions.shape[1]:
        return before
    height = np.zeros(len(points.positions))
    if before is None:
        height = np.maximum(points.log_posterior - np.max(points.log_posterior), -LOW)
    covariance = np.atleast_2d(np.cov(points.positions.T, aweights=np.exp(height)))
    spread, directions = np.linalg.eigh(covariance)
    return directions * np.sqrt(np.maximum(spread, NARROWEST**2))
