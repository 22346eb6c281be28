"""A sample of a map, fitted first from many starts: what all its chunks have in common, kept in the store.

It says at which resolution a transport is to be solved, or by which emulator, what the parameters are that all texels
have in common, where all other fits begin, and which chi-squares are to be expected. A run that is resumed fits the
chunks that are left as the first would have.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from fits.data.measurements import Measurements, channel_names
from fits.maps.common import Common, fit_common, with_common
from fits.maps.emulator import Emulator, emulate, with_emulator
from fits.maps.inputs import Block, MapData, Measured, map_data
from fits.maps.options import MapOptions
from fits.maps.search import Results, Starts, fit_first, reduced_chi_square, search, sigmas, starts_at
from fits.maps.store import PILOT, Store
from fits.maps.texels import Texels, make_texels, with_own_directions
from fits.optimise.fit import fit
from fits.optimise.multi_start import start_points
from fits.optimise.resolution import has_rays, leaves_rays_open, resolution_in_words, resolutions
from fits.problem.model import Model
from fits.problem.noise import DEFAULT_FLOOR, DEFAULT_RELATIVE, Noise
from fits.problem.parameters import Free, is_free
from fits.problem.problem import Problem, unit
from fits.problem.stack_file import transport_from_dict, transport_to_dict

Floats = NDArray[np.float64]

GOLDEN, MOST_TRIED, FEW = 0.6180339887498949, 4096, 8
"""Steps between the texels of a pilot, as a share of the map, how many are tried for it, and how many are enough where
most are of no use."""

MOST_PARAMETERS = 32


@dataclass(frozen=True, eq=False)
class Pilot:
    """What all chunks of a map have in common.

    Attributes:
        prototype: the problem of a texel, with common parameters held, and a resolution.
        emulator: in the place of its transport; None: that itself.
        starts: of all other fits.
        common: what was found of common parameters; None if there are none.
        numerical_error: of the model, in standard deviations, at most; None where the transport has none.
        words: on the resolution and the emulator.
        reduced: median of the reduced chi-squares of the pilot texels.
    """

    prototype: Problem
    emulator: Emulator | None
    starts: Starts
    common: Common | None
    numerical_error: float | None
    words: dict[str, str]
    reduced: float

    def __getstate__(self) -> dict[str, Any]:  # a model does not outlive its process
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def problem(self) -> Problem:
        """The problem of a texel, with the model of a map."""
        return map_problem(self.prototype, self.starts.known is None, self.emulator)

    def texels(self, measured: Measured) -> Texels:
        """Those of a block, one after the other."""
        return texels_of(measured, least_floor(self.prototype))


def map_problem(problem: Problem, own: bool, emulator: Emulator | None) -> Problem:
    """A problem with the model of a map; own: texels have directions of their own."""
    problem = with_own_directions(problem) if own else problem
    return problem if emulator is None else problem.with_model(with_emulator(problem.model, emulator))


def least_floor(problem: Problem) -> float:
    """The least that the floor of the noise can be, in 1/sr."""
    floor = problem.noise.floor
    return float(floor.arrays()[1]) if isinstance(floor, Free) else float(floor or 0.0)


def texels_of(measured: Measured, floor: float) -> Texels:
    """The texels of a block, one after the other; floor: the least of the noise's, in 1/sr."""
    rank = measured.mask.ndim
    values, sigma, _, wi, wo = (None if one is None else one.reshape(-1, *one.shape[rank:]) for one in measured)
    return make_texels(values, sigma, floor, wi, wo)  # type: ignore[arg-type]


# ---- which texels, and a problem for them ----


def pilot_texels(data: MapData, count: int) -> Texels:
    """`count` texels from all over a map that take part and have a measurement, in their order, or ValueError."""
    candidates = np.flatnonzero(data.read_mask(tuple(slice(0, size) for size in data.shape)))
    if not candidates.size:
        raise ValueError("mask: no texel takes part, it is 0 everywhere")
    first = np.arange(min(4 * count, candidates.size))  # evenly, then others in case those are of no use
    rest = np.linspace(0, candidates.size - 1, min(candidates.size, MOST_TRIED))
    order = candidates[np.concatenate([((first + 0.5) * GOLDEN % 1.0) * candidates.size, rest]).astype(int)]
    found: dict[int, Texels] = {}
    failure: ValueError | None = None
    for turn, place in enumerate(order.tolist()):
        if len(found) == count or (turn >= 4 * count and len(found) >= FEW):
            break
        if place in found:
            continue
        try:
            at = np.unravel_index(place, data.shape)
            row = texels_of(data.read(tuple(slice(int(one), int(one) + 1) for one in at)), 0.0)
        except ValueError as error:  # what cannot be read is reported with its chunk
            failure = failure or error
            continue
        if row.measurements[0]:
            found[place] = row
    if not found:
        raise failure or ValueError("values: no measurement of a texel that takes part is a finite number")
    rows = [found[place] for place in sorted(found)]
    return Texels(*(None if one[0] is None else np.concatenate(one) for one in zip(*rows, strict=True)))


def prototype(
    pilot: Texels, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions
) -> Problem:
    """A problem with the measurements of a typical texel, in whose place those of each texel come."""
    noise = Noise() if noise is None else noise
    if noise.discrepancy:
        raise ValueError("noise.discrepancy is given; fits of maps have independent noise only")

    def median(values: Floats) -> Floats:  # of every datum over the texels where it counts, (N, C), or of all data
        found = np.ma.median(np.ma.masked_array(values, ~pilot.used), axis=0)
        return np.asarray(np.ma.filled(found, np.median(values[pilot.used])), float)

    bright = np.nanmean(np.where(pilot.used, pilot.values, np.nan), axis=(1, 2))
    typical = int(np.argsort(bright)[len(bright) // 2])
    values = np.where(pilot.used[typical], pilot.values[typical], median(pilot.values))
    known = noise.use_sigma and data.sigma is not None
    sigma = np.sqrt(median(pilot.variance)) if known else None
    relative, floor = noise.relative, noise.floor
    if relative is None:
        relative = DEFAULT_RELATIVE if sigma is None and floor is None else 0.0
    if floor is None:  # one for the whole map
        alone = not is_free(relative) and relative == 0
        floor = 0.0 if alone else DEFAULT_FLOOR * float(np.median(np.abs(pilot.values[pilot.used])))
    view = data.geometry
    wi, wo = (pilot.wi[typical], pilot.wo[typical]) if view is None else (view.wi, view.wo)
    measured = Measurements(wi, wo, values, sigma, np.ones(len(values), bool), channel_names(data.channels))
    noise = replace(noise, relative=relative, floor=floor, discrepancy=False)
    return Problem(stack, measured, transport=transport, noise=noise, **options.model)


def require_fitting(problem: Problem, texels: Texels, options: MapOptions) -> None:
    """ValueError for a problem that a map cannot have."""
    names, common = problem.names, problem.common_names
    if len(names) > MOST_PARAMETERS:
        raise ValueError(f"stack: {len(names)} parameters are free; of a map at most {MOST_PARAMETERS} can be")
    if any(name.startswith("instrument.") for name in common):
        raise ValueError("instrument.tilt is common to all texels; hold it at a number")
    if len(common) == len(names):
        raise ValueError("stack: all free parameters are common; a map needs one that each texel has of its own")
    if not (texels.measurements >= len(names)).any():
        raise ValueError(f"values: no texel has as many measurements as there are free parameters, {len(names)}")
    if options.spatial_prior is not None:
        if problem.objective != "likelihood":
            raise ValueError(
                f"spatial_prior is given, but objective {problem.objective!r} has no noise to weigh it with"
            )
        options.spatial_prior.scales([name for name in names if name not in common])


# ---- the fits of the pilot ----


def fit_pilot(data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions) -> Pilot:
    """Find resolution, emulator, common parameters and starts from the pilot texels.

    Raises:
        ValueError: a problem that a map cannot have, an emulator is required that cannot be made, or no texel has a
            fit.
    """
    texels = pilot_texels(data, options.pilot_texels)
    problem, own = prototype(texels, data, stack, noise, transport, options), data.geometry is None
    require_fitting(problem, texels, options)
    texels = texels.rows(texels.measurements >= len(problem.names)).with_floor(least_floor(problem))

    # the resolution that a fit of its own data ends with
    known = resolutions(problem)
    if leaves_rays_open(problem) or (known is not None and known.open):
        found = fit(problem, starts=options.starts, seed=options.seed, progress=options.progress).problem
        problem = replace(problem, transport=found.transport, instrument=found.instrument)

    common = None
    if problem.common_names:
        options.tell("common", 0, len(problem.common_names))
        held, common = fit_common(map_problem(problem, own, None), texels, options)
        problem = replace(held)  # without the model of a map

    # the pilot, at finer resolutions until its noise hides their error
    options.tell("pilot", 0, texels.number)
    if own and options.emulator:
        raise ValueError("emulator: there is none where every texel has directions of its own")
    pays = known is not None and np.prod(data.shape) >= options.emulator_min_texels
    wants_emulator = not own and (pays if options.emulator is None else options.emulator)
    words: dict[str, str] = {}
    while True:
        emulator = None
        if wants_emulator:
            emulator, words["emulator"] = emulate(problem, options)
            if emulator is None and options.emulator:
                raise ValueError(f"emulator: {words['emulator']}")
        ready = map_problem(problem, own, emulator)
        starts, results = _fit_texels(ready, texels, options)
        if own or (known is None and not has_rays(problem)):
            error = None
            break
        finer = None if known is None else known.finer(problem.transport)  # type: ignore[arg-type]
        fine = None if finer is None else replace(problem, transport=finer)
        error = 0.0 if fine is None else _numerical_error(ready, fine, results, texels)
        if known is None or not known.open or fine is None or error <= options.numerical_error:
            if has_rays(problem):
                error += _numerical_error(ready, problem.with_other_rays(), results, texels)
            words["resolution"] = resolution_in_words(problem, known)
            break
        problem = fine
    options.tell("pilot", texels.number, texels.number)
    reduced = reduced_chi_square(results.fits, texels)
    return Pilot(problem, emulator, starts, common, error, words, float(np.nanmedian(reduced)))


def _fit_texels(problem: Problem, texels: Texels, options: MapOptions) -> tuple[Starts, Results]:
    """Fits of the pilot: a few from all starts, the others from where these ended; and starts of all other fits."""
    points, own, size = start_points(problem, options.starts, options.seed), texels.wi is not None, options.chunk_size
    first = starts_at(problem, fit_first(problem, points, texels, size).distinct(), points[1:], own, size)
    results = search(problem, first, texels, size, options)
    reduced = reduced_chi_square(results.fits, texels)
    finite = reduced[np.isfinite(reduced)]
    explained = options.pilot_factor * float(np.quantile(finite, options.pilot_quantile)) if finite.size else 0.0
    return starts_at(problem, results.fits.distinct(), points[1:], own, size, explained), results


def _numerical_error(ready: Problem, fine: Problem, results: Results, texels: Texels) -> float:
    """Largest numerical error of the pilot, in standard deviations, by a finer problem."""
    good = np.isfinite(results.fits.cost)
    found, rows = results.fits.rows(good), texels.rows(good)
    exact = predict_all(fine, found.vector)
    own = np.where(rows.used, np.sqrt(rows.variance), 0.0)
    error = np.abs(found.predicted - exact) / np.hypot(sigmas(ready, found.vector, exact), own)
    return float(np.max(np.where(rows.used, error, 0.0), initial=0.0))


def predict_all(problem: Problem, vectors: Floats) -> Floats:
    """What vectors (K, P) predict, (K, N, C), in 1/sr."""
    return np.asarray(problem.call(_predict_all, vectors), float)


def _predict_all(model: Model, vectors: Array) -> Array:
    return jax.lax.map(model.predict, vectors)


# ---- in the store ----


def described(pilot: Pilot) -> dict[str, Any]:
    """What the root of a store says of it."""
    problem, common = pilot.prototype, {}
    if pilot.common is not None:
        for name, value in pilot.common.values.items():
            error, converged = pilot.common.errors[name], pilot.common.converged
            common[name] = {"value": value, "error": error, "unit": unit(name), "converged": converged}
    known = isinstance(problem.transport, lj.Transport) or problem.transport == "auto"
    kept = {
        "reduced_chi_square": pilot.reduced,
        "poor_above": pilot.starts.explained,
        "floor": None if is_free(problem.noise.floor) else problem.noise.floor,
        "transport": transport_to_dict(problem.transport) if known else None,  # type: ignore[arg-type]
        "rings": None if problem.instrument is None else problem.instrument.rings,
    }
    numerical = {**pilot.words, "error": pilot.numerical_error}
    words = {"transport": repr(problem.transport), "noise": repr(problem.noise)}
    return {**words, "pilot": kept, "numerical": numerical, "common": common}


def save(pilot: Pilot, store: Store) -> None:
    """Keep its arrays in a store."""
    arrays: dict[str, Any] = {"vectors": pilot.starts.vectors, "random": pilot.starts.random}
    if pilot.emulator is not None:
        arrays |= {f"emulator/{name}": np.asarray(getattr(pilot.emulator, name)) for name in _arrays_of_emulator()}
    store.save_group(PILOT, arrays, {})


def load(
    store: Store, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions
) -> Pilot | None:
    """What a store keeps of it, for the same arguments as those of `fit_pilot`; None where it is not there whole."""
    found = store.load_group(PILOT)
    if found is None:
        return None
    array, kept, own, common, emulator = found[0], store.attributes["pilot"], data.geometry is None, None, None
    texels = pilot_texels(data, options.pilot_texels)
    problem = prototype(texels, data, stack, noise, transport, options)
    require_fitting(problem, texels, options)
    if kept["floor"] is not None:
        problem = replace(problem, noise=replace(problem.noise, floor=kept["floor"]))
    if kept["transport"] is not None:
        problem = replace(problem, transport=transport_from_dict(kept["transport"]))
    if problem.instrument is not None:
        problem = replace(problem, instrument=replace(problem.instrument, rings=kept["rings"]))
    if said := store.attributes["common"]:
        values, errors = ({name: float(one[part]) for name, one in said.items()} for part in ("value", "error"))
        common = Common(values, errors, all(one["converged"] for one in said.values()))
        problem = with_common(problem, values)
    if "emulator/orders" in array:
        parts = {name: jnp.asarray(array[f"emulator/{name}"]) for name in _arrays_of_emulator()}
        emulator = Emulator(**parts, highest=int(np.max(array["emulator/orders"])))
    ready, reduced = map_problem(problem, own, emulator), float(kept["reduced_chi_square"])
    starts = starts_at(ready, array["vectors"], array["random"], own, options.chunk_size, kept["poor_above"])
    words = {name: one for name, one in store.attributes["numerical"].items() if name != "error"}
    return Pilot(problem, emulator, starts, common, store.numerical_error, words, reduced)


def _arrays_of_emulator() -> list[str]:
    return [entry.name for entry in fields(Emulator) if entry.name != "highest"]


# ---- for those who do the work ----


@dataclass(frozen=True, eq=False)
class Job:
    """What all chunks of a map have in common.

    Attributes:
        path: of the store.
        pilot: what was found of a sample of the map.
        options: of the map; its chunk size is that of the program.
        source: of the measurements, or what `map_data` opens them from; None where each task brings its own.
    """

    path: str
    pilot: Pilot
    options: MapOptions
    source: MapData | tuple[Any, Any, Any, Any] | None

    def __getstate__(self) -> dict[str, Any]:  # open files do not outlive their process
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def data(self) -> MapData:
        """The measurements, opened once in each process."""
        assert self.source is not None
        return self.source if isinstance(self.source, MapData) else map_data(*self.source)

    @cached_property
    def store(self) -> Store:
        """The store, opened once in each process."""
        return Store(self.path)

    def sent(self, data: MapData, block: Block) -> Measured | None:
        """What a task brings of its block."""
        return None if self.source is not None else data.read(block)

    def measured(self, block: Block, sent: Measured | None) -> Measured:
        """The measurements of a block, wherever they are."""
        return self.data.read(block) if sent is None else sent
