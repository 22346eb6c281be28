"""A fit for every texel of a map, chunk by chunk, into a store.

A pilot sample of the texels is fitted first, from many starts (see `fits.maps.pilot`). Every texel then begins where
the likeliest of the pilot's ended, and is begun again only where its chi-square says that it ended poorly (see
`fits.maps.search`).
"""

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

import layerjax
from fits._files import locked
from fits.engines import Failure, connected, run
from fits.engines.compile_cache import programs_kept
from fits.engines.processes import end_if_again
from fits.maps.chunk import Job, Task, read_part, work
from fits.maps.fitted_map import FittedMap, open_map
from fits.maps.inputs import Block, MapData, map_data, words
from fits.maps.options import USUAL, VERDICTS, MapOptions
from fits.maps.pilot import Pilot, fit_pilot, load, require_smoothable, save
from fits.maps.spatial import smooth_map
from fits.maps.store import Store, blocks_of, create, described, require_folder, resume, throw_away
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.problem import unit, with_floor
from fits.store import fingerprint

if TYPE_CHECKING:
    from fits.data.geometry import Geometry

NAMED = 8
"""Chunks that an error names of those that could not be done."""


def fit_map(
    stack: Any,
    geometry: "Geometry | Any",
    values: Any,
    out: str | Path,
    noise: Noise | None = None,
    client: Any = None,
    *,
    transport: Transport = "auto",
    sigma: Any = None,
    mask: Any = None,
    options: MapOptions = USUAL,
) -> FittedMap:
    """Fit a stack to the measurements of every texel of a map, into a zarr store that grows chunk by chunk.

    What is in the store is not done again, and what comes to be in it does not depend on who did the work.

    Args:
        stack: holds `Free` where each texel has a number of its own, or with `same_for_all_texels=True` all have one in
            common, which is held from then on: errors of the others are conditional on it.
        geometry, values, sigma, mask: see `fits.maps.inputs.map_data`: arrays or files, values (..., N, C) in 1/sr.
        out: directory of the store, made here, or begun by an earlier call with the same arguments.
        noise: as in `fits.fit`, but independent; without a floor there is one for the whole map.
        client: a `distributed.Client`, or the address of a scheduler, whose workers see `out` under the same path; in
            place of `options.processes`.
        transport: as in `fits.fit`.
        options: the rest of the model, the work, and the thresholds of flags, see `MapOptions`.

    Raises:
        ValueError: arguments that do not fit together, a store of others, one that another process writes, or chunks
            that could not be read or done: all others are.
        OSError: of the store, such as a full disk: chunks that are in it stay.
    """
    if several := options.processes > 1 and client is None:
        end_if_again()
    data = map_data(values, geometry, sigma, mask)
    if not isinstance(noise, Noise | None):
        raise ValueError(f"noise is {noise!r}; it must be a fits.Noise, or None")
    if options.instrument is not None and data.geometry is None:
        raise ValueError("instrument is given, but every texel has directions of its own; there can be no instrument")
    size = min(options.chunk_size, max(MapOptions.chunk_size, math.prod(data.shape)))  # no program for a million texels
    path = Path(out).resolve() if Path(out).is_symlink() else Path(out)  # one lock for all links to a store
    require_folder(path)
    kept = programs_kept() if several else nullcontext()  # workers run the program that has fitted the pilot
    with locked(Path(f"{path}.lock"), str(path)), connected(client) as reached, kept:
        return _fit(path, data, stack, noise, transport, replace(options, chunk_size=size), reached)


def _fit(
    path: Path, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions, client: Any
) -> FittedMap:
    if noise is not None and not noise.use_sigma:
        data = replace(data, sigma=None)

    # whose map it is
    numbers = options.numbers()
    said = {"stack": stack, "noise": noise, "transport": transport, **options.model}
    said |= {name: one for name, one in numbers.items() if name not in VERDICTS}
    identity = fingerprint(**{name: described(one) for name, one in said.items()})
    identity |= {"measurements": data.fingerprint(), "precision": str(np.dtype(jnp.result_type(float)))}
    store = resume(path, identity, options.force)

    # what all chunks have in common
    if options.instrument is not None:  # the floor of a map's noise stands in one place
        noise = with_floor(noise or Noise(), options.instrument)
        options = replace(options, instrument=replace(options.instrument, floor=None))
    given = (data, stack, noise, transport, options)
    pilot = None if store is None else load(store, *given)
    if pilot is None:
        pilot = fit_pilot(*given)
        if store is None:
            throw_away(path)  # not before it is known that there can be another
            store = _create(path, pilot, data, stack, identity, options)
        save(pilot, store)
        pilot = load(store, *given)  # as a run that is resumed has it
    assert store is not None
    assert pilot is not None
    require_smoothable(pilot.problem, options)

    # all chunks
    source = data if client is None and options.processes == 1 else data.portable
    common = (pilot.problem, pilot.starts, pilot.floor, replace(options, progress=None), pilot.numerical_error)
    job = Job(str(path.resolve()), *common, source)
    if failures := _fit_chunks(store, job, data, client, options):
        named = [*failures[:NAMED], *([f"and {len(failures) - NAMED} more"] if len(failures) > NAMED else [])]
        raise ValueError(f"{path}: {'; '.join(named)}; all other chunks are done, and another run does these")
    if options.spatial_prior is not None:
        job = replace(job, source=data) if client is None else job
        smooth_map(store, job, data, options.spatial_prior, client, options)
    return open_map(path)


def _create(
    path: Path, pilot: Pilot, data: MapData, stack: Any, identity: dict[str, str], options: MapOptions
) -> Store:
    """An empty store that says how its map is fitted."""
    problem, reduced, common = pilot.problem, pilot.reduced[np.isfinite(pilot.reduced)], {}
    if pilot.common is not None:
        for name, value in pilot.common.values.items():
            error, converged = pilot.common.errors[name], pilot.common.converged
            common[name] = {"value": value, "error": error, "unit": unit(name), "converged": converged}
    about = {
        "version": layerjax.__version__,
        "fingerprints": identity,
        "samples": data.samples,
        "channels": list(problem.data.channels),
        "stack": repr(stack),
        "transport": repr(problem.transport),
        "noise": repr(problem.noise),
        "options": options.numbers(),
        "pilot": {
            "texels": len(pilot.places),
            "reduced_chi_square": float(np.median(reduced)) if reduced.size else math.nan,
            "poor_above": pilot.starts.explained,
        },
        "numerical": {**pilot.words, "error": pilot.numerical_error},
        "common": common,
    }
    return create(
        path,
        names=problem.names,
        units=problem.units,
        shape=data.shape,
        chunk=tile(data.shape, options.chunk_size),
        attributes=about,
        numerical=pilot.numerical_error is not None,
    )


def tile(shape: tuple[int, ...], texels: int) -> tuple[int, ...]:
    """The shape of a chunk of at most so many texels, as square as the last axes of a map allow."""
    sides, left_over = [1] * len(shape), texels
    if len(shape) > 1:
        sides[-1] = min(shape[-1], max(math.isqrt(texels), texels // shape[-2]))
        left_over //= sides[-1]
    for axis in reversed(range(max(1, len(shape) - 1))):
        sides[axis] = max(1, min(shape[axis], left_over))
        left_over //= sides[axis]
    return tuple(sides)


def _fit_chunks(store: Store, job: Job, data: MapData, client: Any, options: MapOptions) -> list[str]:
    """Fit the chunks that are left; what became of those that could not be."""
    blocks, failures, tasks = store.unfinished(), [], []
    for block in blocks:
        try:
            tasks.append(Task(block, None if job.source is not None else read_part(data, block)))
        except ValueError as error:
            failures.append(str(error))
    total = sum(1 for _ in blocks_of(store.shape, store.chunk))
    done, poor, fitted = total - len(blocks), 0, 0
    options.tell("map", done, total)
    for index, result in run(work, job, tasks, processes=options.processes, client=client):
        if isinstance(result, Failure):
            failures.append(f"{_name(tasks[index].block)}: {result.error}")
        else:
            fitted, poor = fitted + result["fitted"], poor + result["poor"]
        done += 1
        options.tell("map", done, total, f"{100.0 * poor / fitted:.1f} % poor" if fitted else "")
    left = store.unfinished()
    if client is None:  # of a cluster, some may still write what others have done
        store.clean(left)
    return failures or [f"{_name(block)}: was written, and is not there" for block in left]


def _name(block: Block) -> str:
    return f"chunk {words(block)}"
