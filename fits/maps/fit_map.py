"""A fit for every texel of a map, chunk by chunk, into a store.

A pilot sample of the texels is fitted first, from many starts (see `fits.maps.pilot`). Every texel then begins where
the likeliest of the pilot's ended, and is begun again only where its chi-square says that it ended poorly (see
`fits.maps.search`). With a spatial prior the whole map is fitted again beside that (see `fits.maps.spatial`).
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits._files import locked
from fits.data.geometry import direction
from fits.engines import Failure, connected, run
from fits.engines.processes import end_if_again
from fits.maps.inputs import Block, MapData, Measured, map_data, words
from fits.maps.options import USUAL, VERDICTS, MapOptions
from fits.maps.pilot import Job, described, fit_pilot, load, save
from fits.maps.search import neighbours, reduced_chi_square, search
from fits.maps.spatial import smooth_map
from fits.maps.store import FLAGS, FittedMap, Store, arrays_of, blocks_of, create, open_map, resume, throw_away
from fits.maps.texels import standard_errors
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import is_free, with_values
from fits.problem.problem import with_floor
from fits.store import fingerprint, portable_repr
from layerjax._checks import require_kind
from layerjax.compiling import programs_kept

if TYPE_CHECKING:
    from fits.data.geometry import Geometry

NAMED = 8
"""Chunks that an error names of those that could not be done."""


@programs_kept()
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
    if options.processes > 1 and client is None:
        end_if_again()
    data = map_data(values, geometry, sigma, mask)
    require_kind("noise", noise, Noise, None)
    if options.instrument is not None and data.geometry is None:
        raise ValueError("instrument is given, but every texel has directions of its own; there can be no instrument")
    if noise is not None and not noise.use_sigma:
        data = replace(data, sigma=None)
    size = min(options.chunk_size, max(MapOptions.chunk_size, math.prod(data.shape)))  # no program for a million texels
    path = Path(out).resolve() if Path(out).is_symlink() else Path(out)  # one lock for all links to a store
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")
    with locked(Path(f"{path}.lock"), str(path)), connected(client) as reached:
        return _fit(path, data, stack, noise, transport, replace(options, chunk_size=size), reached)


def _fit(
    path: Path, data: MapData, stack: Any, noise: Noise | None, transport: Any, options: MapOptions, client: Any
) -> FittedMap:
    # 1. whose map it is
    identity, measurements = _identity(stack, noise, transport, data.samples, options), data.fingerprints()
    store = resume(path, identity, measurements, options.force)

    # 2. the pilot: what all chunks have in common
    if options.instrument is not None:  # the floor of a map's noise stands in one place
        noise = with_floor(noise or Noise(), options.instrument)
        options = replace(options, instrument=replace(options.instrument, floor=None))
    given = (data, stack, noise, transport, options)
    pilot = None if store is None else load(store, *given)
    if pilot is None:
        pilot = fit_pilot(*given)
        if store is None:
            throw_away(path)  # not before it is known that there can be another
            about: dict[str, Any] = {"version": lj.__version__, "stack": repr(stack), "options": options.numbers()}
            about |= {"samples": data.samples, "channels": list(pilot.problem.data.channels), **described(pilot)}
            store = create(
                path,
                names=pilot.problem.names,
                units=pilot.problem.units,
                shape=data.shape,
                chunk=tile(data.shape, options.chunk_size),
                attributes=about | {"fingerprints": identity, "measurements": measurements},
            )
        save(pilot, store)
        pilot = load(store, *given)  # as a run that is resumed has it
    assert store is not None
    assert pilot is not None

    # 3. all chunks
    source = data if client is None and options.processes == 1 else data.portable
    job = Job(str(path.resolve()), pilot, replace(options, progress=None), source)
    if failures := _fit_chunks(store, job, data, client, options):
        named = [*failures[:NAMED], *([f"and {len(failures) - NAMED} more"] if len(failures) > NAMED else [])]
        raise ValueError(f"{path}: {'; '.join(named)}; all other chunks are done, and another run does these")

    # 4. neighbours held together
    if options.spatial_prior is not None:
        smooth_map(store, job, data, client, options)
    return open_map(path)


def _identity(stack: Any, noise: Noise | None, transport: Any, samples: int, options: MapOptions) -> dict[str, str]:
    """Fingerprints of what makes a fit, by name; of a transport that is a function, by what it predicts."""

    def parts_of(tree: Any) -> list[Any]:
        leaves, structure = jax.tree.flatten(tree, is_leaf=is_free)
        return [portable_repr(structure), *leaves]

    said = {"stack": stack, "noise": noise, "transport": transport, **options.model}
    said = {name: parts_of(one) for name, one in said.items()}
    if not isinstance(transport, str | lj.Transport):
        start = jax.tree.map(
            lambda leaf: jnp.asarray(leaf.arrays()[0]) if is_free(leaf) else leaf, stack, is_leaf=is_free
        )
        angles = np.linspace(5.0, 75.0, samples)
        wi, wo = direction(angles, 0.0 * angles), direction(angles[::-1], 20.0 * angles)
        said["transport"] += [np.asarray(jax.jit(transport)(with_values(start), wi, wo), np.float32)]
    numbers = {name: one for name, one in options.numbers().items() if name not in VERDICTS}
    return fingerprint(**said, **numbers, precision=str(np.dtype(jnp.result_type(float))))


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


# ---- chunks, wherever they are done ----


def _fit_chunks(store: Store, job: Job, data: MapData, client: Any, options: MapOptions) -> list[str]:
    """Fit the chunks that are left; what became of those that could not be."""
    blocks, failures, tasks = store.unfinished(), [], []
    for block in blocks:
        try:
            tasks.append((block, job.sent(data, block)))
        except ValueError as error:
            failures.append(str(error))
    total = sum(1 for _ in blocks_of(store.shape, store.chunk))
    done, poor, fitted = total - len(blocks), 0, 0
    options.tell("map", done, total)
    for index, result in run(work, job, tasks, processes=options.processes, client=client):
        if isinstance(result, Failure):
            failures.append(f"chunk {words(tasks[index][0])}: {result.error}")
        else:
            fitted, poor = fitted + result["fitted"], poor + result["poor"]
        done += 1
        options.tell("map", done, total, f"{100.0 * poor / fitted:.1f} % poor" if fitted else "")
    left = store.unfinished()
    if client is None:  # of a cluster, some may still write what others have done
        store.clean()
    return failures or [f"chunk {words(block)}: was written, and is not there" for block in left]


def work(job: Job, task: tuple[Block, Measured | None]) -> dict[str, int]:
    """Fit a chunk and write it, if a worker that was killed has not; returns how many texels have which flag."""
    block, sent = task
    flags = job.store.whole(block)
    if flags is None:
        results = fit_chunk(job, job.measured(block, sent))
        job.store.write(block, results)
        flags = results["flags"]
    return {meaning: int(np.sum(flags & bit > 0)) for meaning, bit in FLAGS.items()}


def fit_chunk(job: Job, measured: Measured) -> dict[str, NDArray[Any]]:
    """The arrays of a store for one chunk, by their names, each of the chunk's shape."""
    problem, size, shape = job.pilot.problem, job.options.chunk_size, measured.mask.shape
    names, mask, texels = problem.names, measured.mask.reshape(-1), job.pilot.texels(measured)
    results = {name: np.full(texels.number, fill, dtype) for name, (dtype, fill) in arrays_of(names).items()}
    results["measurements"][:] = texels.measurements
    enough = texels.measurements >= len(names)
    flags = results["flags"]
    flags[~mask] |= FLAGS["masked"]
    flags[mask & ~enough] |= FLAGS["too_few_measurements"]
    fitted = np.flatnonzero(mask & enough)
    if len(fitted):
        rows = texels.rows(fitted)
        among = np.full(texels.number + 1, -1)  # places among the texels that are fitted; the last is none
        among[fitted] = np.arange(len(fitted))
        beside = among[neighbours(shape)[fitted]]
        found, start, poor, restarted = search(problem, job.pilot.starts, rows, size, job.options, beside)
        finite, (errors, at_bound, unidentified) = found.finite, standard_errors(problem, found, rows)
        numbers = {"reduced_chi_square": reduced_chi_square(found, rows)}
        for place, name in enumerate(names):
            numbers |= {f"values/{name}": found.vector[:, place], f"errors/{name}": errors[:, place]}
        for name, array in numbers.items():
            results[name][fitted] = np.where(finite, array, np.nan)
        bits = 1 << np.arange(len(names), dtype=np.uint64)
        results["at_bound"][fitted] = np.sum(np.where(at_bound & finite[:, None], bits, 0), axis=1)
        results["start"][fitted] = start
        for meaning, holds in {
            "fitted": finite,
            "failed": ~finite,
            "converged": finite & found.converged,
            "at_bound": finite & at_bound.any(axis=1),
            "poor": finite & poor,
            "restarted": restarted,
            "unidentified": finite & unidentified,
        }.items():
            flags[fitted[holds]] |= FLAGS[meaning]
    return {name: array.reshape(shape) for name, array in results.items()}
