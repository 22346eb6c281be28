"""A sample of a map, fitted first from many starts: what all its chunks have in common, kept in the store.

It says at which resolution a transport is to be solved, or by which emulator, what the parameters are that all texels
have in common, where all other fits begin, and which chi-squares are to be expected. A run that is resumed fits the
chunks that are left as the first would have.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

import layerjax as lj
from fits.data.geometry import Booleans, Floats
from fits.data.measurements import Measurements, channel_names
from fits.maps.common import fit_common, with_common
from fits.maps.emulator import Emulator, emulate
from fits.maps.inputs import Block, MapData, Measured
from fits.maps.options import MapOptions
from fits.maps.search import Starts, fit_pilot_texels, reduced_chi_square, sigmas, starts_at
from fits.maps.store import PILOT, Store
from fits.maps.texels import Fits, Texels, make_texels, with_own_directions
from fits.optimise.fit import fit
from fits.optimise.multi_start import start_points
from fits.optimise.resolution import has_rays, leaves_rays_open, resolution_in_words, resolutions
from fits.problem.model import predict_each
from fits.problem.noise import Noise, noise_levels
from fits.problem.parameters import is_free
from fits.problem.problem import Problem
from fits.problem.stack_file import transport_from_dict, transport_to_dict
from fits.progress import silent

GOLDEN, MOST_TRIED = 0.6180339887498949, 4096
"""Steps between the texels that are tried for a pilot, as a share of the map, and how many are."""

MOST_PARAMETERS = 32


@dataclass(frozen=True, eq=False)
class Job:
    """What all chunks of a map have in common, for those who do the work.

    path: of the store. prototype: the problem of a texel, with common parameters held, and a resolution. emulator: in
    the place of its transport, if any. starts: of the fits of all chunks. options: their chunk size is the program's.
    """

    path: str
    prototype: Problem
    emulator: Emulator | None
    starts: Starts
    options: MapOptions
    data: MapData

    def __getstate__(self) -> dict[str, Any]:  # a model and an open store do not outlive their process
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def problem(self) -> Problem:
        """The problem of a texel, with the model of a map."""
        return map_problem(self.prototype, self.starts.known is None, self.emulator)

    @cached_property
    def store(self) -> Store:
        """The store, opened once in each process."""
        return Store(self.path)

    def texels(self, block: Block) -> tuple[Booleans, Texels]:
        """Which texels of a block take part, (block shape), and those of the block, one after the other."""
        measured = self.data.read(block)
        return measured.mask, texels_of(measured)


def map_problem(problem: Problem, own_directions: bool, emulator: Emulator | None) -> Problem:
    """A problem with the model of a map; own_directions: of each texel."""
    problem = with_own_directions(problem) if own_directions else problem
    return problem if emulator is None else problem.with_model(replace(problem.model, stand_in=emulator))


def texels_of(measured: Measured) -> Texels:
    """The texels of a block, one after the other."""
    rank = measured.mask.ndim
    values, sigma, _, wi, wo = (None if one is None else one.reshape(-1, *one.shape[rank:]) for one in measured)
    return make_texels(values, sigma, wi, wo)  # type: ignore[arg-type]


# ---- which texels, and a problem for them ----


def pilot_texels(data: MapData, count: int) -> Texels:
    """`count` texels from all over a map that take part and have a measurement, in their order, or ValueError."""
    candidates = np.flatnonzero(data.read_mask(tuple(slice(0, size) for size in data.shape)))
    if not candidates.size:
        raise ValueError("mask: no texel takes part, it is 0 everywhere")
    order = candidates[((np.arange(MOST_TRIED) + 0.5) * GOLDEN % 1.0 * candidates.size).astype(int)]
    chosen: dict[int, Texels] = {}
    for place in dict.fromkeys(order.tolist()):
        at = np.unravel_index(place, data.shape)
        row = texels_of(data.read(tuple(slice(int(one), int(one) + 1) for one in at)))
        if row.measurements[0]:
            chosen[place] = row
        if len(chosen) == count:
            break
    if not chosen:
        raise ValueError("values: no measurement of a texel that takes part is a finite number")
    rows = [chosen[place] for place in sorted(chosen)]
    return Texels(*(None if one[0] is None else np.concatenate(one) for one in zip(*rows, strict=True)))


def make_prototype(
    pilot: Texels, data: MapData, stack: Any, noise: Noise, transport: Any, options: MapOptions
) -> Problem:
    """A problem with the measurements of a typical texel, in whose place those of each texel come.

    ValueError for one that a map cannot have.
    """
    if noise.discrepancy:
        raise ValueError("noise.discrepancy is given; fits of maps have independent noise only")

    def median(values: Floats) -> Floats:  # of every datum over the texels where it counts, (N, C), or of all data
        medians = np.ma.median(np.ma.masked_array(values, ~pilot.used), axis=0)
        return np.asarray(np.ma.filled(medians, np.median(values[pilot.used])), float)

    bright = np.nanmean(np.where(pilot.used, pilot.values, np.nan), axis=(1, 2))
    typical = int(np.argsort(bright)[len(bright) // 2])
    values = np.where(pilot.used[typical], pilot.values[typical], median(pilot.values))
    sigma = np.sqrt(median(pilot.variance)) if noise.use_sigma and data.sigma is not None else None
    view = data.geometry
    wi, wo = (pilot.wi[typical], pilot.wo[typical]) if view is None else (view.wi, view.wo)
    measured = Measurements(wi, wo, values, sigma, np.ones(len(values), bool), channel_names(data.channels))
    levels = noise_levels(noise, measured, pilot.values[pilot.used])  # one floor for the whole map
    noise = replace(noise, relative=levels.relative, floor=levels.floor, discrepancy=False)
    problem = Problem(stack, measured, transport=transport, noise=noise, **options.model)

    names, common, prior = problem.names, problem.common_names, options.spatial_prior
    if len(names) > MOST_PARAMETERS:
        raise ValueError(f"stack: {len(names)} parameters are free; of a map at most {MOST_PARAMETERS} can be")
    if any(name.startswith("instrument.") for name in common):
        raise ValueError("instrument.tilt is common to all texels; hold it at a number")
    if len(common) == len(names):
        raise ValueError("stack: all free parameters are common; a map needs one that each texel has of its own")
    if not (pilot.measurements >= len(names)).any():
        raise ValueError(f"values: no texel has as many measurements as there are free parameters, {len(names)}")
    if prior is not None:
        if problem.objective != "likelihood":
            raise ValueError(
                f"spatial_prior is given, but objective {problem.objective!r} has no noise to weigh it with"
            )
        prior.scales([name for name in names if name not in common])
    return problem


# ---- the fits of the pilot ----


def fit_pilot(
    problem: Problem, texels: Texels, shape: tuple[int, ...], options: MapOptions
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Resolution, emulator, common parameters and starts, from the pilot texels of a map of this shape: the arrays that
    a store keeps of them, and what its root says. ValueError: there is no emulator that is required, or no fit."""
    own_directions = texels.wi is not None
    texels = texels.rows(texels.measurements >= len(problem.names))

    # the resolution that a fit of its own data ends with
    known = resolutions(problem)
    if leaves_rays_open(problem) or (known is not None and known.open):
        best = fit(problem, starts=options.starts, seed=options.seed, progress=options.progress).problem
        problem = replace(problem, transport=best.transport, instrument=best.instrument)

    common: dict[str, Any] = {}
    if problem.common_names:
        options.progress("common", 0, len(problem.common_names))
        common = fit_common(map_problem(problem, own_directions, None), texels, options)
        problem = with_common(problem, {name: one["value"] for name, one in common.items()})

    # the pilot, at finer resolutions until its noise hides their error
    options.progress("pilot", 0, texels.number)
    if own_directions and options.emulator:
        raise ValueError("emulator: there is none where every texel has directions of its own")
    pays = known is not None and np.prod(shape) >= options.emulator_min_texels
    wants_emulator = not own_directions and (pays if options.emulator is None else options.emulator)
    numerical: dict[str, Any] = {}
    while True:
        emulator, error = None, None
        if wants_emulator:
            emulator, numerical["emulator"] = emulate(problem, options)
            if emulator is None and options.emulator:
                raise ValueError(f"emulator: {numerical['emulator']}")
        ready = map_problem(problem, own_directions, emulator)
        points = start_points(ready, options.starts, options.seed)
        fits = fit_pilot_texels(ready, points, texels, options)
        if own_directions or (known is None and not has_rays(problem)):
            break
        finer = None if known is None else known.finer(problem.transport)  # type: ignore[arg-type]
        fine = None if finer is None else replace(problem, transport=finer)
        error = 0.0 if fine is None else _numerical_error(ready, fine, fits, texels)
        if known is None or not known.open or fine is None or error <= options.numerical_error:
            if has_rays(problem):
                error += _numerical_error(ready, problem.with_other_rays(), fits, texels)
            numerical["resolution"] = resolution_in_words(problem, known)
            break
        problem = fine
    options.progress("pilot", texels.number, texels.number)

    arrays = {"starts": fits.distinct(), **({} if emulator is None else emulator.arrays())}
    reduced = reduced_chi_square(fits, texels)
    has_words = isinstance(problem.transport, lj.Transport) or problem.transport == "auto"
    kept = {
        "floor": None if is_free(problem.noise.floor) else problem.noise.floor,
        "poor_above": options.pilot_factor * float(np.quantile(reduced[fits.finite], options.pilot_quantile)),
        "transport": transport_to_dict(problem.transport) if has_words else None,  # type: ignore[arg-type]
        "rings": None if problem.instrument is None else problem.instrument.rings,
    }
    about = {"transport": repr(problem.transport), "noise": repr(problem.noise), "pilot": kept, "common": common}
    return arrays, about | {"numerical": numerical | {"error": error}}


def job_of(store: Store, problem: Problem, options: MapOptions, data: MapData) -> Job:
    """The work of a map by what a store keeps of its pilot, see `fit_pilot`; problem: as that was called with."""
    kept, group = store.attributes["pilot"], store.load_group(PILOT)
    assert group is not None
    arrays, _ = group
    if kept["transport"] is not None:
        problem = replace(problem, transport=transport_from_dict(kept["transport"]))
    if problem.instrument is not None:
        problem = replace(problem, instrument=replace(problem.instrument, rings=kept["rings"]))
    if common := store.attributes["common"]:
        problem = with_common(problem, {name: float(one["value"]) for name, one in common.items()})
    emulator, own_directions = Emulator.of(arrays) if "orders" in arrays else None, data.geometry is None
    ready = map_problem(problem, own_directions, emulator)
    starts = starts_at(ready, arrays["starts"], own_directions, options.chunk_size, kept["poor_above"])
    return Job(str(store.path.resolve()), problem, emulator, starts, replace(options, progress=silent), data)


def _numerical_error(ready: Problem, fine: Problem, fits: Fits, texels: Texels) -> float:
    """Largest numerical error of the pilot, in standard deviations, by a finer problem."""
    good = np.isfinite(fits.cost)
    fits, texels = fits.rows(good), texels.rows(good)
    exact = np.asarray(fine.call(predict_each, fits.vector), float)
    own = np.where(texels.used, np.sqrt(texels.variance), 0.0)
    error = np.abs(fits.predicted - exact) / np.hypot(sigmas(ready, fits.vector, exact), own)
    return float(np.max(np.where(texels.used, error, 0.0), initial=0.0))
