"""What a map is fitted with: the prototype of its texels' problems, what is shared, the starts, and a table if any.

All of it is found from a sample of texels before the first chunk, and kept in the store: a run that is taken up again
fits the chunks that are left as the first would have.
"""

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits._files import plain
from fits.data.measurements import Measurements, channel_names
from fits.maps import chunk_files
from fits.maps.inputs import Readings
from fits.maps.job import completed, part_of
from fits.maps.pilot import fly, resolved
from fits.maps.searching import Starts, starts_at
from fits.maps.shared import shared_names
from fits.maps.sharing import Shared, fit_shared, held
from fits.maps.tabulated import Table, Tabulated
from fits.maps.tabulating import tabulate
from fits.maps.texels import Texels, texels, with_floor, with_own_directions
from fits.problem.noise import DEFAULT_FLOOR, DEFAULT_RELATIVE, Noise
from fits.problem.parameters import Free, is_free
from fits.problem.problem import Problem
from fits.problem.toml import transport_from_dict, transport_to_dict
from fits.progress import Progress

if TYPE_CHECKING:
    import zarr

Floats = NDArray[np.float64]

WORTH_A_TABLE = 1_000
"""Texels from which on a table of an exact transport is made where nothing is said of it."""

GROUP = "pilot"
"""Of the store, in which all this is kept."""

GOLDEN = 0.6180339887498949

FEW, MOST_TRIED = 8, 4096
"""Texels that a sample is to have, or be that of all that there are, and how many are tried for it."""


@dataclass(frozen=True)
class Prepared:
    """What all chunks of a map have in common.

    Attributes:
        problem: the prototype, with shared numbers held, a resolution, and a table in it if there is one.
        starts: of all fits.
        shared: what was found of shared numbers; None if there are none.
        numerical_error: of the model, in standard deviations; None where the transport has none.
        words: on the resolution and the table.
        reduced: chi-squares of the sample, (S,).
        texels: places of the sample, (S, rank).
    """

    problem: Problem
    starts: Starts
    shared: Shared | None
    numerical_error: float | None
    words: dict[str, str]
    reduced: Floats
    texels: NDArray[np.int64]

    @property
    def least(self) -> float:
        """Of the noise's floor, in 1/sr."""
        return least_floor(self.problem)


def least_floor(problem: Problem) -> float:
    """The least that the floor of a problem's noise can be, in 1/sr."""
    floor = problem.noise.floor
    return float(floor.arrays()[1]) if isinstance(floor, Free) else float(floor or 0.0)


def sampled(readings: Readings, count: int, least: int) -> tuple[Texels, NDArray[np.int64]]:
    """Texels from all over a map that take part and have at least so many readings: `count` of them, and their places.

    Raises:
        ValueError: there is none.
    """
    mask = readings.read_mask(tuple(slice(0, size) for size in readings.shape))
    wanted = np.flatnonzero(mask)
    if not len(wanted):
        raise ValueError("mask: no texel takes part, it is 0 everywhere")
    failure: ValueError | None = None
    parts: list[Texels] = []
    places: list[tuple[int, ...]] = []
    for turn, where in enumerate(wanted[_spread(len(wanted), 4 * count)]):
        place = tuple(int(at) for at in np.unravel_index(where, readings.shape))
        if place in places:
            continue
        if turn >= 4 * count and len(places) >= FEW:
            break
        try:
            part = part_of(readings, tuple(slice(at, at + 1) for at in place))
        except ValueError as error:  # what cannot be read is told of with its chunk
            failure = failure or error
            continue
        own = [None if one is None else one.reshape(1, *one.shape[len(place) :]) for one in part]
        row = texels(own[0], own[1], 0.0, own[3], own[4])  # type: ignore[arg-type]
        if row.readings[0] >= least:
            parts.append(row)
            places.append(place)
        if len(places) == count:
            break
    if not parts:
        raise failure or ValueError("values: no reading of a texel that takes part is a finite number")
    order = sorted(range(len(places)), key=lambda k: places[k])
    stacked = [None if one[0] is None else np.concatenate([one[k] for k in order]) for one in zip(*parts, strict=True)]
    return Texels(*stacked), np.array([places[k] for k in order])


def _spread(count: int, first: int) -> NDArray[np.int64]:
    """Places among so many: the first ones from all over them, then others, in case those are of no use."""
    turns = np.arange(min(first, count))
    rest = np.linspace(0, count - 1, min(count, MOST_TRIED))
    return np.concatenate([((turns + 0.5) * GOLDEN % 1.0) * count, rest]).astype(int)


def prototype(sample: Texels, readings: Readings, stack: Any, noise: Noise | None, **rest: Any) -> Problem:
    """A problem with the readings of a typical texel, in whose place those of each texel come."""
    noise = Noise() if noise is None else noise
    if noise.discrepancy:
        raise ValueError("noise.discrepancy is given; fits of maps have independent errors only")
    bright = np.nanmean(np.where(sample.used, sample.values, np.nan), axis=(1, 2))
    typical = int(np.argsort(bright)[len(bright) // 2])
    with np.errstate(all="ignore"):
        middle = _median(sample.values, sample.used)
    values = np.where(sample.used[typical], sample.values[typical], middle)
    known = noise.use_sigma and readings.sigma is not None
    sigma = np.sqrt(_median(sample.variance, sample.used)) if known else None
    relative, floor = noise.relative, noise.floor
    if relative is None:
        relative = DEFAULT_RELATIVE if sigma is None and floor is None else 0.0
    if floor is None:  # one for the whole map
        alone = not is_free(relative) and relative == 0
        floor = 0.0 if alone else DEFAULT_FLOOR * float(np.median(np.abs(sample.values[sample.used])))
    wi, wo = (sample.wi[typical], sample.wo[typical]) if readings.geometry is None else _common(readings)
    channels = channel_names(readings.channels)
    data = Measurements(wi, wo, values, sigma, np.ones(len(values), bool), channels)
    return Problem(stack, data, noise=replace(noise, relative=relative, floor=floor, discrepancy=False), **rest)


def _common(readings: Readings) -> tuple[Floats, Floats]:
    assert readings.geometry is not None
    return readings.geometry.wi, readings.geometry.wo


def _median(values: Floats, used: NDArray[np.bool_]) -> Floats:
    """Of every reading over the texels where it counts, (N, C); of all readings where it counts nowhere."""
    found = np.ma.median(np.ma.masked_array(values, ~used), axis=0)
    return np.asarray(np.ma.filled(found, np.median(values[used])), float)


def prepare(
    problem: Problem,
    readings: Readings,
    sample: Texels,
    places: NDArray[np.int64],
    *,
    starts: int,
    seed: int,
    size: int,
    table: bool | None,
    progress: Progress | None,
) -> Prepared:
    """Find resolution, shared numbers, table and starts from a sample of the map.

    table: whether there is to be one; None: where it is worth it.

    Raises:
        ValueError: a table is asked for that cannot be made, all numbers are shared, or no texel has a fit.
    """
    own, sample = readings.geometry is None, with_floor(sample, least_floor(problem))
    names, words = shared_names(problem), {}
    for name in names:
        if name.startswith("instrument."):
            raise ValueError(f"{name} is shared; of an instrument nothing can be, hold it at a number")
    if len(names) == len(problem.names):
        raise ValueError("stack: all free parameters are shared; a map needs one that each texel has of its own")
    problem, known = resolved(problem, starts, seed, progress)
    if own:
        problem = with_own_directions(problem)
    shared = None
    if names:
        _tell(progress, "shared", 0, len(names))
        problem, shared = fit_shared(problem, sample, starts=starts, seed=seed, size=size)
        problem = with_own_directions(problem) if own else problem

    def ready(problem: Problem) -> Problem:
        if table is False or own or (table is None and (known is None or np.prod(readings.shape) < WORTH_A_TABLE)):
            if table and own:
                raise ValueError("tabulate: there is no table where every texel has directions of its own")
            return problem
        tried = tabulate(problem, progress)
        words["table"] = tried.words
        if tried.problem is None and table:
            raise ValueError(f"tabulate: {tried.words}")
        return tried.problem or problem

    _tell(progress, "sample", 0, sample.number)
    pilot = fly(problem, known, sample, starts=starts, seed=seed, size=size, prepare=ready)
    _tell(progress, "sample", sample.number, sample.number)
    if pilot.resolution:
        words["resolution"] = pilot.resolution
    return Prepared(pilot.problem, pilot.starts, shared, pilot.numerical_error, words, pilot.reduced, places)


def _tell(progress: Progress | None, stage: str, done: int, total: int) -> None:
    if progress is not None:
        progress(stage, done, total)


def save(prepared: Prepared, root: "zarr.Group") -> None:
    """Keep it in a store."""
    problem, starts, table = prepared.problem, prepared.starts, _table_of(prepared.problem)
    arrays: dict[str, Any] = {"vectors": starts.vectors, "random": starts.random, "reduced": prepared.reduced}
    arrays |= {"texels": prepared.texels, "values": problem.data.values, "wi": problem.data.wi, "wo": problem.data.wo}
    if problem.data.sigma is not None:
        arrays["sigma"] = problem.data.sigma
    if table is not None:
        arrays |= {f"table/{name}": np.asarray(getattr(table, name)) for name in _arrays_of_table()}
    group = root.create_group(GROUP)
    for name, array in arrays.items():
        group.create_array(name, data=np.ascontiguousarray(array), compressors=chunk_files.codecs())
    shared = prepared.shared
    group.attrs.update(  # last: with them it is whole
        {
            "arrays": list(arrays),
            "noise": [_plain(problem.noise.relative), _plain(problem.noise.floor)],
            "transport": _transport(problem.transport),
            "rings": None if problem.instrument is None else problem.instrument.rings,
            "expected": starts.expected,
            "highest": None if table is None else table.highest,
            "numerical_error": prepared.numerical_error,
            "words": prepared.words,
            "shared": None if shared is None else [shared.values, plain(shared.errors), shared.converged],
        }
    )


def is_whole(root: "zarr.Group") -> bool:
    """Whether a store has it, undamaged: it may have been killed while it wrote this."""
    try:
        group: Any = root[GROUP]
        for name in group.attrs["arrays"]:
            group[name][...]
    except (LookupError, ValueError, OSError, TypeError):
        return False
    return True


def load(root: "zarr.Group", readings: Readings, stack: Any, noise: Noise | None, size: int, **rest: Any) -> Prepared:
    """What `save` kept, for the same arguments as those of `prototype`."""
    group: Any = root[GROUP]
    about = dict(group.attrs)
    array = {name: chunk_files.checked(group[name]) for name in about["arrays"]}
    given = Noise() if noise is None else noise
    levels = {
        name: getattr(given, name) if is_free(getattr(given, name)) and value is None else value
        for name, value in zip(("relative", "floor"), about["noise"], strict=True)
    }
    if about["transport"] is not None:
        rest["transport"] = transport_from_dict(about["transport"])
    if rest.get("instrument") is not None:
        rest["instrument"] = replace(rest["instrument"], rings=about.get("rings"))
    values = array["values"]
    channels, used = channel_names(values.shape[1]), np.ones(len(values), bool)
    data = Measurements(array["wi"], array["wo"], values, array.get("sigma"), used, channels)
    problem = Problem(stack, data, noise=replace(given, **levels, discrepancy=False), **rest)
    shared = None if about["shared"] is None else Shared(*about["shared"])
    if shared is not None:
        # None: of one at a bound, in stores of former versions
        errors = {name: np.nan if error is None else float(error) for name, error in shared.errors.items()}
        shared = shared._replace(errors=errors)
        problem = held(problem, shared.values)
    table = None
    if about["highest"] is not None:
        parts = {name: jnp.asarray(array[f"table/{name}"]) for name in _arrays_of_table()}
        table = Table(**parts, highest=about["highest"])
    problem = completed(problem, readings.geometry is None, table)
    starts = starts_at(problem, array["vectors"], array["random"], readings.geometry is None, size, about["expected"])
    return Prepared(
        problem, starts, shared, about["numerical_error"], about["words"], array["reduced"], array["texels"]
    )


def _arrays_of_table() -> list[str]:
    return [entry.name for entry in fields(Table) if entry.name != "highest"]


def _table_of(problem: Problem) -> Table | None:
    return problem.model.table if isinstance(problem.model, Tabulated) else None


def _transport(transport: Any) -> str | dict[str, Any] | None:
    known = isinstance(transport, lj.Transport) or transport == "auto"
    return transport_to_dict(transport) if known else None


def _plain(level: Any) -> float | None:
    return None if is_free(level) else float(level)
