"""A fit for every texel of a map, chunk by chunk, into a store.

A pilot sample of the texels is fitted first, from many starts (see `fits.maps.pilot`). Every texel then begins where
the likeliest of the pilot's ended, and is fitted again only where its chi-square says that it ended poorly (see
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
from fits._files import given_path, locked
from fits.data.geometry import direction
from fits.engines import Failure, connected, run
from fits.maps.inputs import Block, block_words, map_data
from fits.maps.options import DEFAULT, VERDICTS, MapOptions
from fits.maps.pilot import Job, fit_pilot, job_of, make_prototype, pilot_texels
from fits.maps.search import reduced_chi_square, search
from fits.maps.spatial import smooth_map
from fits.maps.store import FLAGS, FittedMap, Store, arrays_of, blocks_of, create, open_map, resume
from fits.maps.texels import standard_errors
from fits.problem.model import Transport
from fits.problem.noise import Noise, is_assumed
from fits.problem.parameters import at_start, is_free
from fits.problem.problem import with_floor
from fits.store import fingerprint, portable_repr
from layerjax._checks import require_kind
from layerjax.compiling import program_cache

if TYPE_CHECKING:
    from fits.data.geometry import Geometry

NAMED = 8  # chunks that an error names of those that could not be done


@program_cache()
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
    options: MapOptions = DEFAULT,
) -> FittedMap:
    """Fit a stack to the measurements of every texel of a map, into a zarr store that grows chunk by chunk.

    Finished chunks are not repeated, and results do not depend on the engine.

    Args:
        stack: a stack with `Free` in the place of each number that is fitted. With `same_for_all_texels=True` it is
            common to all texels, and the errors of the others are conditional on it.
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
    require_kind("options", options, MapOptions)
    data = map_data(values, geometry, sigma, mask)
    require_kind("noise", noise, Noise, None)
    if options.instrument is not None and data.geometry is None:
        raise ValueError("instrument is given, but every texel has directions of its own; there can be no instrument")
    noise = noise or Noise()
    if not noise.use_sigma:
        data = replace(data, sigma=None)
    size = min(options.chunk_size, max(MapOptions.chunk_size, math.prod(data.shape)))  # no program for a million texels
    options, path = replace(options, chunk_size=size), given_path("out", out)
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")
    with connected(client, options.processes) as connection, locked(Path(f"{path}.lock"), str(path)):
        # 1. whose map it is
        identity = _identity(stack, noise, transport, data.samples, options) | {"measurements": data.fingerprint()}
        store = resume(path, identity, options.force)

        # 2. the pilot: what all chunks have in common
        if options.instrument is not None:  # the floor of a map's noise stands in one place
            noise = with_floor(noise, options.instrument)
            options = replace(options, instrument=replace(options.instrument, floor=None))
        texels = pilot_texels(data, options.pilot_texels)
        problem = make_prototype(texels, data, stack, noise, transport, options)
        if store is None:
            arrays, about = fit_pilot(problem, texels, data.shape, options)
            names = [name for name in problem.names if name not in about["common"]]
            about |= {
                "names": names,
                "units": {name: problem.units[name] for name in names},
                "shape": data.shape,
                "chunk": tile(data.shape, options.chunk_size),
                "samples": data.samples,
                "channels": list(problem.data.channels),
                "options": options.numbers(),
                "stack": repr(stack),
                "noise_assumed": problem.objective == "likelihood" and is_assumed(noise, problem.data),
                "version": lj.__version__,
                "fingerprints": identity,
            }
            store = create(path, about, arrays)

        # 3. all chunks
        job = job_of(store, problem, options, data)
        if failures := _fit_chunks(store, job, connection, options):
            more = f"; and {len(failures) - NAMED} more" if len(failures) > NAMED else ""
            words = f"{'; '.join(failures[:NAMED])}{more}"
            raise ValueError(f"{path}: {words}; all other chunks are done, and another run does these")

        # 4. neighbours held together
        if options.spatial_prior is not None:
            smooth_map(store, job, connection, options)
    return open_map(path)


def _identity(stack: Any, noise: Noise, transport: Any, samples: int, options: MapOptions) -> dict[str, str]:
    """Fingerprints of what makes a fit, by name; of a transport that is a function, by what it predicts."""

    def parts_of(tree: Any) -> list[Any]:
        leaves, structure = jax.tree.flatten(tree, is_leaf=is_free)
        return [portable_repr(structure), *leaves]

    parts = {"stack": stack, "noise": noise, "transport": transport, **options.model}
    numbers = {name: one for name, one in options.numbers().items() if name not in VERDICTS}
    precision, parts = str(np.dtype(jnp.result_type(float))), {name: parts_of(one) for name, one in parts.items()}
    if not isinstance(transport, str | lj.Transport):
        angles = np.linspace(5.0, 75.0, samples)
        wi, wo = direction(angles, 0.0 * angles), direction(angles[::-1], 20.0 * angles)
        parts["transport"] += [np.asarray(jax.jit(transport)(at_start(stack), wi, wo), np.float32)]
    return fingerprint(**parts, **numbers, precision=precision)


def tile(shape: tuple[int, ...], texels: int) -> tuple[int, ...]:
    """The shape of a chunk of at most so many texels, as square as the last axes of a map allow."""
    sides, remaining = [1] * len(shape), texels
    for axis in reversed(range(len(shape))):
        square = (
            max(math.isqrt(texels), texels // shape[-2]) if len(shape) > 1 and axis == len(shape) - 1 else remaining
        )
        sides[axis] = max(1, min(shape[axis], square))
        remaining //= sides[axis]
    return tuple(sides)


# ---- chunks, wherever they are done ----


def _fit_chunks(store: Store, job: Job, client: Any, options: MapOptions) -> list[str]:
    """Fit the chunks that are left; the failures of those that could not be done."""
    blocks, failures = store.unfinished(), []
    total = sum(1 for _ in blocks_of(store.shape, store.chunk))
    done, poor, fitted = total - len(blocks), 0, 0
    options.progress("map", done, total)
    for index, result in run(work, job, blocks, client=client, short=True):
        if isinstance(result, Failure):
            failures.append(f"chunk {block_words(blocks[index])}: {result.error}")
        else:
            fitted, poor = fitted + result[0], poor + result[1]
        done += 1
        options.progress("map", done, total, f"{100.0 * poor / fitted:.1f} % poor" if fitted else "")
    if client is None:  # of a cluster, some may still write what others have done
        store.clean()
    return failures


def work(job: Job, block: Block) -> tuple[int, int]:
    """Fit a chunk and write it; returns how many texels are fitted, and how many of them are poor."""
    results = fit_chunk(job, block)
    job.store.write(block, results)
    fitted, poor = (int(np.sum(results["flags"] & FLAGS[meaning] > 0)) for meaning in ("fitted", "poor"))
    return fitted, poor


def fit_chunk(job: Job, block: Block) -> dict[str, NDArray[Any]]:
    """The arrays of a store for one chunk, by their names, each of the chunk's shape."""
    mask, texels = job.texels(block)
    problem, shape, mask = job.problem, mask.shape, mask.reshape(-1)
    names = problem.names
    results = {name: np.full(texels.number, fill, dtype) for name, (dtype, fill) in arrays_of(names).items()}
    results["measurements"][:] = texels.measurements
    enough = texels.measurements >= len(names)
    flags = results["flags"]
    flags[~mask] |= FLAGS["masked"]
    flags[mask & ~enough] |= FLAGS["too_few_measurements"]
    fitted = np.flatnonzero(mask & enough)
    if len(fitted):
        rows = texels.rows(fitted)
        best, poor, restarted = search(problem, job.starts, rows, job.options)
        finite, (errors, at_bound, unidentified) = best.finite, standard_errors(problem, best, rows)
        numbers = {"reduced_chi_square": reduced_chi_square(best, rows)}
        for place, name in enumerate(names):
            numbers |= {f"values/{name}": best.vector[:, place], f"errors/{name}": errors[:, place]}
        for name, array in numbers.items():
            results[name][fitted] = np.where(finite, array, np.nan)
        bits = 1 << np.arange(len(names), dtype=np.uint64)
        results["at_bound"][fitted] = np.sum(np.where(at_bound & finite[:, None], bits, 0), axis=1)
        for meaning, holds in {
            "fitted": finite,
            "failed": ~finite,
            "converged": finite & best.converged,
            "at_bound": finite & at_bound.any(axis=1),
            "poor": finite & poor,
            "restarted": restarted,
            "unidentified": finite & unidentified,
        }.items():
            flags[fitted[holds]] |= FLAGS[meaning]
    return {name: array.reshape(shape) for name, array in results.items()}
