"""A spatial prior: neighbouring texels held together, by block alternation beside the plain fit and after it.

Texels are coloured like a chessboard, so that no edge joins two of one colour. With the other colour held, the
posterior of the whole map falls apart into texels: each has its measurements, its prior, and a Gaussian by which its
neighbours draw it. Every half round lowers minus the log-posterior of the map, or leaves it where it is; its limit is a
minimum, though not of all minima the lowest. A texel moves no farther in a round than its neighbours allow: where the
spatial prior weighs much more than the data, many rounds are needed.

All is said in the coordinate of the fit, the unit box: 0 and 1 are the bounds of a parameter, between which it runs in
the value, or in its logarithm for the priors `LogUniform` and `LogNormal`. Edges lead from each texel to those beside
it along the axes of the map, and join fitted texels alone. After each round the state is kept in the store as the group
``smoothing_3``, from which an interrupted run resumes; the last one becomes ``smoothed``.
"""

import json
import math
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits._files import named, plain
from fits.engines import Failure, run
from fits.maps.chunk import Job, Part, read_part
from fits.maps.descent import Texels, model_of
from fits.maps.fitted_map import SMOOTHED
from fits.maps.inputs import Block, MapData, words
from fits.maps.options import Kind, MapOptions, SpatialPrior
from fits.maps.search import solve
from fits.maps.store import PARTIAL, Store, blocks_of
from fits.problem.model import Model

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

FLAT = 0.1
"""Of the scale: below, a difference counts by its square in a total variation, which has no derivative at 0."""

STATE = "smoothing_"
METHOD = (
    "block alternation from the plain fit: the texels of one colour of a chessboard are fitted again given the others; "
    "errors hold with the neighbours where they are"
)
GIVEN = {"values": "given its neighbours", "errors": "standard error with the neighbours held where they are"}
"""What the arrays of each group say of themselves."""


# ---- the prior ----


@dataclass(frozen=True, eq=False)
class Edges:
    """What differences between neighbours cost; scales: of each parameter, (P,), infinite where it is not smoothed."""

    kind: Kind
    scales: Floats

    def cost(self, units: Floats, fitted: Truths) -> float:
        """Part of minus the log-posterior of a map, of all its edges.

        units: (map shape, P), in the unit box, finite where `fitted`, (map shape).
        """
        smoothed, total = np.isfinite(self.scales), 0.0
        for axis in range(fitted.ndim):
            along, there = np.moveaxis(units, axis, 0), np.moveaxis(fitted, axis, 0)
            share = np.abs((along[1:] - along[:-1])[there[1:] & there[:-1]][:, smoothed]) / self.scales[smoothed]
            if self.kind == "gaussian":
                total += 0.5 * float(np.sum(share**2))
            else:
                total += float(np.sum(np.where(share < FLAT, 0.5 * share**2 / FLAT + 0.5 * FLAT, share)))
        return total

    def pull(self, units: Floats, fitted: Truths) -> tuple[Floats, Floats]:
        """What the neighbours of each texel draw it to, and how strongly: (map shape, P) each.

        As a Gaussian prior has it: its centre in the unit box, and its precision, 0 where no edge ends. Its logarithm
        and that of the spatial prior have the same slope where the texel is, and it lies below elsewhere: what lowers
        the cost with it lowers that with the spatial prior at least as much.
        """
        total, moment = np.zeros((2, *units.shape))
        with np.errstate(invalid="ignore"):
            for axis in range(fitted.ndim):
                for here, there in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
                    own, other = ((*[slice(None)] * axis, cut) for cut in (here, there))
                    joined = fitted[own] & fitted[other]
                    share = np.abs(units[other] - units[own]) / self.scales
                    flat = np.ones_like(share) if self.kind == "gaussian" else np.maximum(share, FLAT)
                    weight = np.where(joined[..., None], 1.0 / (np.square(self.scales) * flat), 0.0)
                    total[own] += weight
                    moment[own] += np.where(joined[..., None], weight * units[other], 0.0)
        return moment / np.where(total > 0.0, total, 1.0), total


# ---- half a round ----


class Half(NamedTuple):
    """The texels of one colour in a chunk.

    places: of M texels in the block, counted along its axes. units: where they are, (M, P), in the unit box. centre,
    inverse_sd: how strongly their neighbours hold them, see `fits.maps.descent.Texels`. first: whether it is told what
    they cost where they are. part: the measurements of the block, None where the job has them.
    """

    block: Block
    places: NDArray[np.int64]
    units: Floats
    centre: Floats
    inverse_sd: Floats
    first: bool
    part: Part | None


class Moved(NamedTuple):
    """What becomes of them: vectors and errors (M, P), and minus the log-posterior of their own data, (M,), there and,
    where it is asked for, where they were."""

    vectors: Floats
    errors: Floats
    cost: Floats
    before: Floats | None


def work(job: Job, task: Half) -> Moved:
    """Fit texels given their neighbours."""
    part = read_part(job.data, task.block) if task.part is None else task.part
    rows, size = part.texels(job.floor).rows(task.places), job.options.chunk_size
    pulled = rows._replace(centre=task.centre, inverse_sd=task.inverse_sd)
    found = solve(job.problem, task.units, pulled, size, fresh=False)
    filled = np.minimum(np.arange(size), rows.number - 1)  # one program for chunks of any size
    same, before = rows.rows(filled), None
    cost = job.problem.call(_costs, found.vector[filled], found.predicted[filled], same)
    if task.first:
        before = np.asarray(job.problem.call(_first_costs, task.units[filled], same), float)[: rows.number]
    return Moved(found.vector, found.errors, np.asarray(cost, float)[: rows.number], before)


def _costs(model: Model, vectors: Array, predicted: Array, texels: Texels) -> Array:
    return jax.vmap(lambda vector, seen, row: model_of(model, row).cost_at(vector, seen))(vectors, predicted, texels)


def _first_costs(model: Model, units: Array, texels: Texels) -> Array:
    def one(unit: Array, row: Texels) -> Array:
        own, vector = model_of(model, row), model.box.from_unit(unit)
        return own.cost_at(vector, own.predict(vector))

    return jax.lax.map(lambda pair: one(*pair), (units, texels))


# ---- all rounds ----


@dataclass
class _State:
    """A map between two rounds. vectors, errors: (map shape, P). fitted: (map shape).

    moves: the farthest that a texel moved in each round, in its standard errors. objective: minus the log-posterior of
    the map up to a constant, before the first round and after each.
    """

    vectors: Floats
    errors: Floats
    fitted: Truths
    moves: list[float] = field(default_factory=list)
    objective: list[float] = field(default_factory=list)


def smooth_map(store: Store, job: Job, data: MapData, prior: SpatialPrior, client: Any, options: MapOptions) -> None:
    """Smooth a map that is fitted whole, into groups of its store, from where an earlier call stopped.

    Without a client threads of this process do it, whoever fitted the map: a half round is short, and each would wait
    for processes to start.

    Raises:
        ValueError: measurements that cannot be read again: they are named, and what was done of whole rounds is kept.
        OSError: of the store.
    """
    _Smoothing(store, job, data, prior, client, options).run()


class _Smoothing:
    """How a map is smoothed, and by whom."""

    def __init__(self, store: Store, job: Job, data: MapData, prior: SpatialPrior, client: Any, options: MapOptions):
        self.store, self.job, self.data, self.client, self.options = store, job, data, client, options
        self.rounds, scales = prior.rounds, prior.scales(store.names)
        said = {"kind": prior.kind, "scale": scales, "rounds": prior.rounds, "settled": options.settled}
        self.prior = json.loads(json.dumps(plain(said)))
        """What identifies it in a store, as JSON gives it back."""
        self.edges = Edges(prior.kind, np.array([scales.get(name, math.inf) for name in store.names]))
        box: Any = job.problem.model.box
        self.logarithmic = np.asarray(box.logarithmic)
        self.low, self.high = (self.natural(np.asarray(end, float)) for end in (box.low, box.high))

    def natural(self, vectors: Floats) -> Floats:
        """In the coordinate where the box is even."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, vectors, 1.0)), vectors)

    def units(self, state: _State) -> Floats:
        """Where texels are in the unit box, (map shape, P); whatever of those that are not fitted."""
        vectors = np.where(state.fitted[..., None], state.vectors, 1.0)
        return np.clip((self.natural(vectors) - self.low) / (self.high - self.low), 0.0, 1.0)

    def run(self) -> None:
        kept = self.store.load_group(SMOOTHED)
        if kept is not None and kept[1].get("prior") == self.prior:
            return
        state = self.resumed()
        while not state.moves or (len(state.moves) < self.rounds and state.moves[-1] > self.options.settled):
            self.tell(state)
            self.one_round(state)
            self.keep(state)
        self.tell(state)
        with named(self.store.path):  # the last state becomes the smoothed map
            place, old = self.store.path / SMOOTHED, self.store.path / f"{SMOOTHED}{PARTIAL}"
            if place.exists():
                os.rename(place, old)
            os.rename(self.store.path / f"{STATE}{len(state.moves)}", place)
            shutil.rmtree(old, ignore_errors=True)
        self.forget()

    def tell(self, state: _State) -> None:
        note = f"the farthest moved by {state.moves[-1]:.2g} errors" if state.moves else ""
        self.options.tell("smoothing", len(state.moves), self.rounds, note)

    # ---- states in the store ----

    def states(self) -> list[str]:
        """Names of the states that are kept, the latest last."""
        found = [name for name in os.listdir(self.store.path) if re.fullmatch(rf"{STATE}\d+", name)]
        return sorted(found, key=lambda name: int(name.removeprefix(STATE)))

    def forget(self, but: str = "") -> None:
        for name in self.states():
            if name != but:
                shutil.rmtree(self.store.path / name, ignore_errors=True)

    def resumed(self) -> _State:
        """The state after the last whole round of the same prior, or the plain fit."""
        plain_fit = {path: np.asarray(array[...]) for path, array in self.store.arrays.items()}
        fitted = (plain_fit["flags"] & 1) != 0
        for name in reversed(self.states()):
            kept = self.store.load_group(name)
            if kept is not None and kept[1].get("prior") == self.prior:
                return _State(*self.stacked(kept[0]), fitted, kept[1]["largest_moves"], kept[1]["objective"])
        self.forget()
        return _State(*self.stacked(plain_fit), fitted)

    def stacked(self, arrays: dict[str, Floats]) -> tuple[Floats, Floats]:
        names = self.store.names
        values, errors = (np.stack([arrays[f"{group}/{name}"] for name in names], axis=-1) for group in GIVEN)
        return values, errors

    def keep(self, state: _State) -> None:
        """Write a state as a group, then remove those before it."""
        said: dict[str, Any] = {"kind": "smoothed map", "prior": self.prior, "method": METHOD}
        said |= {"rounds": len(state.moves), "settled": state.moves[-1] <= self.options.settled}
        said |= {"largest_moves": state.moves, "left": _left(state.moves), "objective": state.objective}
        if self.prior["kind"] == "total_variation":
            said["eps"] = f"{FLAT:g} of the scale"
        arrays, attributes = {}, {}
        for group, whole in (("values", state.vectors), ("errors", state.errors)):
            for place, name in enumerate(self.store.names):
                arrays[f"{group}/{name}"] = whole[..., place]
                attributes[f"{group}/{name}"] = {
                    "units": self.store.units[name], "long_name": f"{name}, {GIVEN[group]}"
                }  # fmt: skip
        axes = self.store.arrays["flags"].metadata.dimension_names
        name, chunk = f"{STATE}{len(state.moves)}", self.store.chunk
        try:
            self.store.save_group(name, arrays, said, attributes, chunks=chunk, dimension_names=axes, fill_value=np.nan)
        except BaseException:
            shutil.rmtree(self.store.path / name, ignore_errors=True)
            raise
        self.forget(but=name)

    # ---- a round ----

    def one_round(self, state: _State) -> None:
        """Fit every texel again, those of one colour after those of the other."""
        first, (cost, before) = not state.moves, np.zeros((2, *state.fitted.shape))
        were, errors = self.units(state), state.errors.copy()
        for colour in (0, 1):
            self.half(state, colour, cost, before)
        if first:
            state.objective = [float(np.sum(before)) + self.edges.cost(were, state.fitted)]
        now = self.units(state)
        state.objective.append(float(np.sum(cost)) + self.edges.cost(now, state.fitted))
        # how far a texel moved at most, in standard errors: those of now, or of before where there are none
        slope = (self.high - self.low) * np.where(self.logarithmic, state.vectors, 1.0)
        error = np.where(np.isfinite(state.errors), state.errors, np.where(np.isfinite(errors), errors, np.inf))
        share = np.abs(now - were) * slope / np.where(error > 0.0, error, np.inf)
        state.moves.append(float(np.max(share[state.fitted], initial=0.0)))

    def half(self, state: _State, colour: int, cost: Floats, before: Floats) -> None:
        """Fit the texels of one colour."""
        tasks = list(self.tasks(state, colour))
        for index, result in run(work, self.job, tasks, client=self.client):
            task = tasks[index]
            if isinstance(result, Failure):
                raise ValueError(
                    f"{self.store.path}: smoothing of chunk {words(task.block)}: {result.error}; the map is fitted, "
                    "and another run resumes after the last whole round"
                )
            size = tuple(one.stop - one.start for one in task.block)
            at = tuple(
                axis + one.start for axis, one in zip(np.unravel_index(task.places, size), task.block, strict=True)
            )
            finite = (np.isfinite(result.cost) & np.isfinite(result.vectors).all(axis=1))[:, None]
            state.vectors[at] = np.where(finite, result.vectors, state.vectors[at])
            state.errors[at] = np.where(finite, result.errors, state.errors[at])
            cost[at] = result.cost
            if result.before is not None:
                before[at] = result.before

    def tasks(self, state: _State, colour: int) -> Iterator[Half]:
        """One for each chunk that has texels of a colour."""
        units, width = self.units(state), self.high - self.low
        centre, precision = self.edges.pull(units, state.fitted)
        centre, inverse_sd = self.low + centre * width, np.sqrt(precision) / width
        coloured = state.fitted & (np.indices(state.fitted.shape).sum(axis=0) % 2 == colour)
        for block in blocks_of(state.fitted.shape, self.store.chunk):
            mine = coloured[block]
            if mine.any():
                part = None if self.job.source is not None else read_part(self.data, block)
                own = (units[block][mine], centre[block][mine], inverse_sd[block][mine])
                yield Half(block, np.flatnonzero(mine), *own, not state.moves, part)


def _left(moves: list[float]) -> float:
    """What is left to go, in standard errors, if moves go on to shrink as the last two did."""
    before, last = moves[-2:] if len(moves) > 1 else (0.0, moves[-1])
    return last * last / (before - last) if last < before else (math.inf if last > 0.0 else 0.0)
