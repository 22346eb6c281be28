"""A sample of a map, fitted first from many starts: what all its chunks have in common, kept in the store.

It says at which resolution a transport is to be solved, or by which emulator, what the parameters are that all texels
have in common, where all other fits begin, and which chi-squares are to be expected. A run that is resumed fits the
chunks that are left as the first would have.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from fits.data.measurements import Measurements, channel_names
from fits.maps.chunk import map_problem, read_part
from fits.maps.common import Common, common_names, distinct, fit_common, fit_first, with_common
from fits.maps.descent import Texels, with_floor, with_own_directions
from fits.maps.emulator import EmulatedModel, Emulator, emulate
from fits.maps.inputs import MapData
from fits.maps.options import MapOptions
from fits.maps.search import Results, Starts, predict_all, reduced_chi_square, search, starts_at
from fits.maps.store import Store
from fits.optimise.fit import fit
from fits.optimise.multi_start import start_points
from fits.optimise.resolution import Resolutions, has_rays, leaves_rays_open, resolution_in_words, resolutions
from fits.problem.model import Model
from fits.problem.noise import DEFAULT_FLOOR, DEFAULT_RELATIVE, Noise
from fits.problem.parameters import Free, is_free
from fits.problem.problem import Problem
from fits.problem.stack_file import transport_from_dict, transport_to_dict

Floats = NDArray[np.float64]

GROUP = "pilot"
"""Path of the store, in which all this is kept."""

GOLDEN, MOST_TRIED, FEW = 0.6180339887498949, 4096, 8
"""Steps between the texels of a pilot, as a share of the map, how many are tried for it, and how many are enough where
most are of no use."""

MOST_PARAMETERS = 32


@dataclass(frozen=True)
class Pilot:
    """What all chunks of a map have in common.

    Attributes:
        problem: the prototype, with common parameters held, a resolution, and an emulator in it if there is one.
        starts: of all other fits.
        common: what was found of common parameters; None if there are none.
        numerical_error: of the model, in standard deviations, at most; None where the transport has none.
        words: on the resolution and the emulator.
        reduced: reduced chi-squares of the pilot texels, (S,).
        places: of these texels, (S, rank).
    """

    problem: Problem
    starts: Starts
    common: Common | None
    numerical_error: float | None
    words: dict[str, str]
    reduced: Floats
    places: NDArray[np.int64]

    @property
    def floor(self) -> float:
        """The least that the floor of the noise can be, in 1/sr."""
        return _least_floor(self.problem)


def _least_floor(problem: Problem) -> float:
    floor = problem.noise.floor
    return float(floor.arrays()[1]) if isinstance(floor, Free) else float(floor or 0.0)


# ---- which texels, and a problem for them ----


def pilot_texels(data: MapData, count: int) -> tuple[Texels, NDArray[np.int64]]:
    """`count` texels from all over a map that take part and have a measurement, and their places, or ValueError."""
    mask = data.read_mask(tuple(slice(0, size) for size in data.shape))
    candidates = np.flatnonzero(mask)
    if not candidates.size:
        raise ValueError("mask: no texel takes part, it is 0 everywhere")
    first = np.arange(min(4 * count, candidates.size))  # evenly, then others in case those are of no use
    rest = np.linspace(0, candidates.size - 1, min(candidates.size, MOST_TRIED))
    order = np.concatenate([((first + 0.5) * GOLDEN % 1.0) * candidates.size, rest]).astype(int)
    parts: dict[tuple[int, ...], Texels] = {}
    failure: ValueError | None = None
    for turn, place in enumerate(np.transpose(np.unravel_index(candidates[order], data.shape)).tolist()):
        if len(parts) == count or (turn >= 4 * count and len(parts) >= FEW):
            break
        if tuple(place) in parts:
            continue
        try:
            row = read_part(data, tuple(slice(at, at + 1) for at in place)).texels(0.0)
        except ValueError as error:  # what cannot be read is reported with its chunk
            failure = failure or error
            continue
        if row.measurements[0]:
            parts[tuple(place)] = row
    if not parts:
        raise failure or ValueError("values: no measurement of a texel that takes part is a finite number")
    rows = [parts[place] for place in sorted(parts)]
    stacked = [None if one[0] is None else np.concatenate(one) for one in zip(*rows, strict=True)]
    return Texels(*stacked), np.array(sorted(parts))


def prototype(
    pilot: Texels, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions
) -> Problem:
    """A problem with the measurements of a typical texel, in whose place those of each texel come."""
    noise = Noise() if noise is None else noise
    if noise.discrepancy:
        raise ValueError("noise.discrepancy is given; fits of maps have independent noise only")
    bright = np.nanmean(np.where(pilot.used, pilot.values, np.nan), axis=(1, 2))
    typical = int(np.argsort(bright)[len(bright) // 2])
    with np.errstate(all="ignore"):
        middle = _median(pilot.values, pilot.used)
    values = np.where(pilot.used[typical], pilot.values[typical], middle)
    known = noise.use_sigma and data.sigma is not None
    sigma = np.sqrt(_median(pilot.variance, pilot.used)) if known else None
    relative, floor = noise.relative, noise.floor
    if relative is None:
        relative = DEFAULT_RELATIVE if sigma is None and floor is None else 0.0
    if floor is None:  # one for the whole map
        alone = not is_free(relative) and relative == 0
        floor = 0.0 if alone else DEFAULT_FLOOR * float(np.median(np.abs(pilot.values[pilot.used])))
    own = data.geometry is None
    wi, wo = (pilot.wi[typical], pilot.wo[typical]) if own else (data.geometry.wi, data.geometry.wo)  # type: ignore[union-attr]
    measured = Measurements(wi, wo, values, sigma, np.ones(len(values), bool), channel_names(data.channels))
    noise = replace(noise, relative=relative, floor=floor, discrepancy=False)
    return Problem(stack, measured, transport=transport, noise=noise, **options.model)


def _median(values: Floats, used: NDArray[np.bool_]) -> Floats:
    """Median of every datum over the texels where it counts, (N, C); of all data where it counts nowhere."""
    found = np.ma.median(np.ma.masked_array(values, ~used), axis=0)
    return np.asarray(np.ma.filled(found, np.median(values[used])), float)


# ---- the fits of the pilot ----


def fit_pilot(data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions) -> Pilot:
    """Find resolution, emulator, common parameters and starts from the pilot texels.

    Raises:
        ValueError: too many parameters, too few measurements, an emulator is required that cannot be made, all
            parameters are common, or no texel has a fit.
    """
    texels, places = pilot_texels(data, options.pilot_texels)
    problem, own = prototype(texels, data, stack, noise, transport, options), data.geometry is None
    if len(problem.names) > MOST_PARAMETERS:
        raise ValueError(f"stack: {len(problem.names)} parameters are free; of a map at most {MOST_PARAMETERS} can be")
    names = common_names(problem)
    require_smoothable(problem, options)
    if any(name.startswith("instrument.") for name in names):
        raise ValueError(
            "instrument.tilt is common to all texels; of an instrument nothing can be, hold it at a number"
        )
    if len(names) == len(problem.names):
        raise ValueError("stack: all free parameters are common; a map needs one that each texel has of its own")
    enough = texels.measurements >= len(problem.names)
    if not enough.any():
        raise ValueError(
            f"values: no texel has as many measurements as there are free parameters, {len(problem.names)}"
        )
    texels = with_floor(texels.rows(enough), _least_floor(problem))
    problem, known = _resolved(problem, options)
    if own:
        problem = with_own_directions(problem)
    common = None
    if names:
        options.tell("common", 0, len(names))
        problem, common = fit_common(problem, texels, options)
        problem = with_own_directions(problem) if own else problem
    words: dict[str, str] = {}

    def cheap(problem: Problem) -> Problem:
        """The problem with an emulator, where one is required or pays."""
        if own and options.emulator:
            raise ValueError("emulator: there is none where every texel has directions of its own")
        pays = options.emulator is None and known is not None and np.prod(data.shape) >= options.emulator_min_texels
        if own or not (options.emulator or pays):
            return problem
        tried = emulate(problem, options)
        words["emulator"] = tried.words
        if tried.problem is None and options.emulator:
            raise ValueError(f"emulator: {tried.words}")
        return tried.problem or problem

    options.tell("pilot", 0, texels.number)
    problem, starts, results, error, resolution = _fit_at_resolution(problem, known, texels, options, cheap)
    options.tell("pilot", texels.number, texels.number)
    if resolution:
        words["resolution"] = resolution
    reduced = reduced_chi_square(results.fits, texels)
    return Pilot(problem, starts, common, error, words, reduced, places[enough])


def require_smoothable(problem: Problem, options: MapOptions) -> None:
    """ValueError for a problem whose fits have no posterior, or a prior of parameters that texels do not have."""
    if options.spatial_prior is None:
        return
    if problem.objective != "likelihood":
        raise ValueError(
            f"spatial_prior is given, but the objective {problem.objective!r} has no noise to weigh it with"
        )
    options.spatial_prior.scales([name for name in problem.names if name not in common_names(problem)])


def _resolved(problem: Problem, options: MapOptions) -> tuple[Problem, Resolutions | None]:
    """The problem at the resolution that a fit of its own data ends with, and the resolutions that there are."""
    known = resolutions(problem)
    if not (leaves_rays_open(problem) or (known is not None and known.open)):
        return problem, known
    found = fit(problem, starts=options.starts, seed=options.seed, progress=options.progress).problem
    return replace(problem, transport=found.transport, instrument=found.instrument), known


def _fit_at_resolution(
    problem: Problem,
    known: Resolutions | None,
    texels: Texels,
    options: MapOptions,
    cheap: Callable[[Problem], Problem],
) -> tuple[Problem, Starts, Results, float | None, str]:
    """Fit the pilot, at finer resolutions until its noise hides the error: the problem, starts of all other fits, what
    was found of the pilot, the numerical error, and the resolution in words."""
    while True:
        ready = cheap(problem)
        starts, results = _fit_texels(ready, texels, options)
        if (known is None and not has_rays(problem)) or texels.wi is not None:
            return ready, starts, results, None, ""
        finer = None if known is None else known.finer(problem.transport)  # type: ignore[arg-type]
        fine = None if finer is None else replace(problem, transport=finer)
        error = 0.0 if fine is None else _numerical_error(ready, fine, results, texels)
        rays = 0.0
        if has_rays(problem):
            rays = _numerical_error(ready, problem.with_other_rays(), results, texels)
        if not (known is not None and known.open and fine is not None and error > options.numerical_error):
            return ready, starts, results, error + rays, resolution_in_words(problem, known)
        problem = fine


def _fit_texels(problem: Problem, texels: Texels, options: MapOptions) -> tuple[Starts, Results]:
    """Fits of the pilot: a few from all starts, the others from where these ended; and starts of all other fits."""
    points, own, size = start_points(problem, options.starts, options.seed), texels.wi is not None, options.chunk_size
    first = starts_at(problem, distinct(fit_first(problem, points, texels, size)), points[1:], own, size)
    results = search(problem, first, texels, size, options)
    reduced = reduced_chi_square(results.fits, texels)
    finite = reduced[np.isfinite(reduced)]
    explained = options.pilot_factor * float(np.quantile(finite, options.pilot_quantile)) if finite.size else 0.0
    return starts_at(problem, distinct(results.fits), points[1:], own, size, explained), results


def _numerical_error(ready: Problem, fine: Problem, results: Results, texels: Texels) -> float:
    """Largest numerical error of the pilot, in standard deviations, by a finer problem."""
    good = np.isfinite(results.fits.cost)
    if not good.any():
        return 0.0
    found, rows = results.fits.rows(good), texels.rows(good)
    exact = predict_all(fine, found.vector)
    sigma = np.asarray(ready.call(_sigmas, found.vector, exact), float)
    own = np.where(rows.used, np.sqrt(rows.variance), 0.0)
    error = np.abs(found.predicted - exact) / np.hypot(sigma, own)
    return float(np.max(np.where(rows.used, error, 0.0)))


def _sigmas(model: Model, vectors: Array, predicted: Array) -> Array:
    return jax.vmap(model.sigma_at)(vectors, predicted)


# ---- in the store ----


def save(pilot: Pilot, store: Store) -> None:
    """Keep it in a store."""
    problem, starts, model = pilot.problem, pilot.starts, pilot.problem.model
    emulator = model.emulator if isinstance(model, EmulatedModel) else None
    arrays: dict[str, Any] = {"vectors": starts.vectors, "random": starts.random, "reduced": pilot.reduced}
    arrays |= {"places": pilot.places, "values": problem.data.values, "wi": problem.data.wi, "wo": problem.data.wo}
    if problem.data.sigma is not None:
        arrays["sigma"] = problem.data.sigma
    if emulator is not None:
        arrays |= {f"emulator/{name}": np.asarray(getattr(emulator, name)) for name in _arrays_of_emulator()}
    known = isinstance(problem.transport, lj.Transport) or problem.transport == "auto"
    levels = [problem.noise.relative, problem.noise.floor]
    about = {
        "noise": [None if is_free(level) else float(level) for level in levels],  # type: ignore[arg-type]
        "transport": transport_to_dict(problem.transport) if known else None,  # type: ignore[arg-type]
        "rings": None if problem.instrument is None else problem.instrument.rings,
        "explained": starts.explained,
        "highest": None if emulator is None else emulator.highest,
        "numerical_error": pilot.numerical_error,
        "words": pilot.words,
        "common": None if pilot.common is None else list(pilot.common),
    }
    store.save_group(GROUP, arrays, about)


def load(
    store: Store, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions
) -> Pilot | None:
    """What `save` kept, for the same arguments as those of `prototype`; None where it is not there whole."""
    kept = store.load_group(GROUP)
    if kept is None:
        return None
    array, about = kept
    given, rest = Noise() if noise is None else noise, dict(options.model)
    levels = {
        name: getattr(given, name) if is_free(getattr(given, name)) and value is None else value
        for name, value in zip(("relative", "floor"), about["noise"], strict=True)
    }
    transport = transport if about["transport"] is None else transport_from_dict(about["transport"])
    if rest["instrument"] is not None:
        rest["instrument"] = replace(rest["instrument"], rings=about["rings"])
    values, own = array["values"], data.geometry is None
    used = np.ones(len(values), bool)
    measured = Measurements(array["wi"], array["wo"], values, array.get("sigma"), used, channel_names(values.shape[1]))
    problem = Problem(stack, measured, transport=transport, noise=replace(given, **levels, discrepancy=False), **rest)
    common = None
    if about["common"] is not None:
        numbers, errors, converged = about["common"]
        common = Common(numbers, {name: float(error) for name, error in errors.items()}, converged)
        problem = with_common(problem, common.values)
    emulator = None
    if about["highest"] is not None:
        parts = {name: jnp.asarray(array[f"emulator/{name}"]) for name in _arrays_of_emulator()}
        emulator = Emulator(**parts, highest=about["highest"])
    problem = map_problem(problem, own, emulator)
    starts = starts_at(problem, array["vectors"], array["random"], own, options.chunk_size, about["explained"])
    return Pilot(problem, starts, common, about["numerical_error"], about["words"], array["reduced"], array["places"])


def _arrays_of_emulator() -> list[str]:
    return [entry.name for entry in fields(Emulator) if entry.name != "highest"]
