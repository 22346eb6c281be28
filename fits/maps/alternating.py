"""A map smoothed by block alternation: half of its texels are fitted again given their neighbours, then the others.

Texels are coloured like a chessboard, so that no edge joins two of one colour. With the other colour held, the
posterior of the whole map falls apart into texels: each has its readings, its prior, and a Gaussian by which its
neighbours draw it (see `fits.maps.smoothing.Edges.pull`). Every half round lowers minus the log-posterior of the map,
or leaves it where it is; its limit is a minimum, though not of all minima the lowest. A texel moves no farther in a
round than its neighbours allow: where smoothness weighs much more than the readings, many rounds are needed.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits._files import plain
from fits.engines import Failure, run
from fits.maps import smoothed
from fits.maps.chunk_files import Block, block_at, grid
from fits.maps.fitted_map import SMOOTHED, FittedMap
from fits.maps.inputs import Readings
from fits.maps.job import Job, Part, part_of, rows_of
from fits.maps.shared import shared_names
from fits.maps.smoothing import FLAT, Edges, Smoothness
from fits.maps.solving import solve
from fits.maps.texels import Texels, model_of
from fits.problem.model import Model
from fits.problem.parameters import Box
from fits.problem.problem import Problem
from fits.progress import Progress

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

SETTLED = 0.01
"""Of a standard error: where no texel moves farther in a round, it is the last."""

METHOD = (
    "block alternation from the plain fit: the texels of one colour of a chessboard are fitted again given the others; "
    "errors hold with the neighbours where they are"
)


class Half(NamedTuple):
    """The texels of one colour in a chunk.

    places: of M texels in the block, counted along its axes. units: where they are, (M, P), in the unit box. centre,
    inverse_sd: how their neighbours draw them, see `fits.maps.texels.Texels`. first: whether it is told what they cost
    where they are. part: the readings of the block, None where the job has them.
    """

    block: Block
    places: NDArray[np.int64]
    units: Floats
    centre: Floats
    inverse_sd: Floats
    first: bool
    part: Part | None


class Moved(NamedTuple):
    """What becomes of them: vectors and errors (M, P), and minus the log-posterior of their own readings, (M,), there
    and, where it is asked for, where they were."""

    vectors: Floats
    errors: Floats
    cost: Floats
    before: Floats | None


def work(job: Job, task: Half) -> Moved:
    """Fit texels given their neighbours."""
    part = part_of(job.readings, task.block) if task.part is None else task.part
    rows = rows_of(part, job.least).rows(task.places)
    pulled = rows._replace(centre=task.centre, inverse_sd=task.inverse_sd)
    found = solve(job.problem, task.units, pulled, job.size, fresh=False)
    filled = np.minimum(np.arange(job.size), rows.number - 1)  # one program for chunks of any size
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


def require_smoothable(problem: Problem, smooth: Smoothness | None) -> None:
    """ValueError for a problem whose fits have no posterior, or smoothness of numbers that texels do not have."""
    if smooth is None:
        return
    if problem.objective != "likelihood":
        raise ValueError(f"smooth is given, but the objective {problem.objective!r} has no noise to weigh it against")
    smooth.scales([name for name in problem.names if name not in shared_names(problem)])


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


@dataclass(frozen=True, eq=False)
class _Smoothing:
    """How a map is smoothed, and by whom."""

    map: FittedMap
    job: Job
    readings: Readings
    smooth: Smoothness
    client: Any

    @property
    def asked(self) -> dict[str, Any]:
        """By what a store tells whether it is there already, as JSON gives it back."""
        asked = {"kind": self.smooth.kind, "scale": self.smooth.scales(self.map.names), "rounds": self.smooth.rounds}
        return dict(json.loads(json.dumps(plain(asked))))

    @cached_property
    def edges(self) -> Edges:
        return self.smooth.edges(self.map.names)

    @property
    def box(self) -> Box:
        box: Box = self.job.problem.model.box
        return box

    @cached_property
    def ends(self) -> tuple[Floats, Floats]:
        """Of the box, (P,) each, in the coordinate where it is even."""
        logarithmic = np.asarray(self.box.logarithmic)
        low, high = (np.asarray(end, float) for end in (self.box.low, self.box.high))
        return _natural(low, logarithmic), _natural(high, logarithmic)

    def units(self, vectors: Floats) -> Floats:
        """Vectors (..., P) in the unit box."""
        low, high = self.ends
        return np.clip((_natural(vectors, np.asarray(self.box.logarithmic)) - low) / (high - low), 0.0, 1.0)

    def ended(self, state: _State) -> bool:
        return bool(state.moves) and (len(state.moves) >= self.smooth.rounds or state.moves[-1] <= SETTLED)

    def about(self, state: _State) -> dict[str, Any]:
        """What a group says of itself."""
        said = {"kind": "smoothed map", "smoothness": self.asked, "method": METHOD, "rounds": len(state.moves)}
        said |= {"settled": state.moves[-1] <= SETTLED, "largest_moves": state.moves, "left": _left(state.moves)}
        said |= {"objective": state.objective}
        return said | ({"eps": f"{FLAT:g} of the scale"} if self.smooth.kind == "total_variation" else {})


def _left(moves: list[float]) -> float:
    """What is left to go, in standard errors, if moves go on to shrink as the last two did."""
    before, last = moves[-2:] if len(moves) > 1 else (0.0, moves[-1])
    return last * last / (before - last) if last < before else (math.inf if last > 0.0 else 0.0)


def _natural(vectors: Floats, logarithmic: Truths) -> Floats:
    return np.where(logarithmic, np.log(np.where(logarithmic, vectors, 1.0)), vectors)


def smooth_map(
    map: FittedMap,
    job: Job,
    readings: Readings,
    smooth: Smoothness,
    client: Any,
    progress: Progress | None,
) -> None:
    """Smooth a map that is fitted whole, into groups of its store, from where an earlier call stopped.

    Without a client threads of this process do it, whoever fitted the map: a half round is short, and each would wait
    for processes to start.

    Raises:
        ValueError: readings that cannot be read again: they are named, and what was done of whole rounds is kept.
        OSError: of the store.
    """
    how = _Smoothing(map, job, readings, smooth, client)
    if smoothed.about_of(map, SMOOTHED).get("smoothness") == how.asked:
        return
    state = _taken_up(how)
    while not how.ended(state):
        _tell(progress, state, smooth.rounds)
        _round(how, state)
        name, about = f"{smoothed.STATE}{len(state.moves)}", how.about(state)
        arrays = _arrays(map, state)
        smoothed.write(map, name, arrays, about)
        smoothed.forget(map, but=name)
    _tell(progress, state, smooth.rounds)
    smoothed.finish(map, smoothed.states(map)[-1])


def _taken_up(how: _Smoothing) -> _State:
    """The state after the last whole round of the same smoothing, or the plain fit."""
    map = how.map
    fitted = map.has("fitted")
    for name in reversed(smoothed.states(map)):
        about = smoothed.about_of(map, name)
        if about.get("smoothness") == how.asked:
            arrays = smoothed.read(map, name)
            state = _state(map, arrays, fitted)
            state.moves, state.objective = list(about["largest_moves"]), list(about["objective"])
            if np.isfinite(state.vectors[fitted]).all():
                return state
    smoothed.forget(map)
    arrays = {f"values/{name}": map.values[name] for name in map.names}
    arrays |= {f"errors/{name}": map.errors[name] for name in map.names}
    return _state(map, arrays, fitted)


def _state(map: FittedMap, arrays: dict[str, Floats], fitted: Truths) -> _State:
    def together(group: str) -> Floats:
        return np.stack([arrays[f"{group}/{name}"] for name in map.names], axis=-1)

    return _State(together("values"), together("errors"), fitted)


def _arrays(map: FittedMap, state: _State) -> dict[str, Floats]:
    both = {"values": state.vectors, "errors": state.errors}
    return {f"{group}/{name}": whole[..., k] for group, whole in both.items() for k, name in enumerate(map.names)}


def _round(how: _Smoothing, state: _State) -> None:
    """Fit every texel again, those of one colour after those of the other."""
    first = not state.moves
    cost, before = np.zeros((2, *state.fitted.shape))
    were = how.units(np.where(state.fitted[..., None], state.vectors, 1.0)), state.errors.copy()
    if first:
        state.objective = [how.edges.cost(were[0], state.fitted)]
    for colour in (0, 1):
        _half(how, state, colour, cost, before)
    now = how.units(np.where(state.fitted[..., None], state.vectors, 1.0))
    if first:
        state.objective[0] += float(np.sum(before))
    state.objective.append(float(np.sum(cost)) + how.edges.cost(now, state.fitted))
    state.moves.append(_farthest(how, state, now - were[0], were[1]))


def _half(how: _Smoothing, state: _State, colour: int, cost: Floats, before: Floats) -> None:
    """Fit the texels of one colour."""
    tasks = list(_tasks(how, state, colour))
    for index, result in run(work, how.job, tasks, client=how.client):
        task = tasks[index]
        if isinstance(result, Failure):
            block = ", ".join(f"{one.start}:{one.stop}" for one in task.block)
            raise ValueError(
                f"{how.map.path}: smoothing of chunk [{block}]: {result.error}; the map is fitted, and another run "
                "goes on with the last whole round"
            )
        size = tuple(one.stop - one.start for one in task.block)
        at = tuple(axis + one.start for axis, one in zip(np.unravel_index(task.places, size), task.block, strict=True))
        finite = np.isfinite(result.cost) & np.isfinite(result.vectors).all(axis=1)
        state.vectors[at] = np.where(finite[:, None], result.vectors, state.vectors[at])
        state.errors[at] = np.where(finite[:, None], result.errors, state.errors[at])
        cost[at] = result.cost
        if result.before is not None:
            before[at] = result.before


def _tasks(how: _Smoothing, state: _State, colour: int) -> Iterator[Half]:
    low, high = how.ends
    shape, here = state.fitted.shape, how.job.source is not None
    units = how.units(np.where(state.fitted[..., None], state.vectors, 1.0))
    for place in grid(shape, how.map.chunk):
        block = block_at(place, shape, how.map.chunk)
        start = sum(one.start for one in block)
        odd = (np.indices([one.stop - one.start for one in block]).sum(axis=0) + start) % 2
        mine = state.fitted[block] & (odd == colour)
        if not mine.any():
            continue
        centre, precision = how.edges.pull(units, state.fitted, block)
        centre, inverse_sd = low + centre * (high - low), np.sqrt(precision) / (high - low)
        part = None if here else part_of(how.readings, block)
        yield Half(
            block,
            np.flatnonzero(mine),
            units[block][mine],
            centre[mine],
            inverse_sd[mine],
            not state.moves,
            part,
        )


def _farthest(how: _Smoothing, state: _State, moved: Floats, errors: Floats) -> float:
    """How far a texel moved at most, in standard errors: those of now, or of before where there are none."""
    low, high = how.ends
    slope = (high - low) * np.where(np.asarray(how.box.logarithmic), state.vectors, 1.0)
    error = np.where(np.isfinite(state.errors), state.errors, np.where(np.isfinite(errors), errors, np.inf))
    share = np.abs(moved) * slope / np.where(error > 0.0, error, np.inf)
    return float(np.max(share[state.fitted], initial=0.0))


def _tell(progress: Progress | None, state: _State, rounds: int) -> None:
    if progress is not None:
        note = f"the farthest moved by {state.moves[-1]:.2g} errors" if state.moves else ""
        progress("smoothing", len(state.moves), rounds, note)
