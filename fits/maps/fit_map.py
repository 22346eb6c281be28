"""A fit for every texel of a map, chunk by chunk, into a store.

A sample of the texels is fitted first, from many starts: it says at which resolution an exact transport has to be
solved, what numbers are that all texels share (a joint fit of the sample, see `fits.maps.sharing`), and where all
other fits begin. Every texel then begins where the likeliest of the sample ended, and is begun again, from others of
these ends, from its neighbours within the chunk and from points all over the box, only where its chi-square says that
it ended poorly: a second minimum that fits as well is not looked for.
"""

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
import zarr

import layerjax
from fits._files import locked, named
from fits.engines import Failure, connected, run
from fits.engines.compile_cache import programs_kept
from fits.engines.processes import end_if_again
from fits.maps.alternating import require_smoothable, smooth_map
from fits.maps.chunk_files import Block, grid
from fits.maps.fitted_map import FittedMap, open_map
from fits.maps.identity import digest
from fits.maps.inputs import Readings, readings
from fits.maps.job import Job, Task, part_of, work
from fits.maps.posterior import sample_texels
from fits.maps.prepared import GROUP, Prepared, load, prepare, prototype, sampled, save
from fits.maps.resuming import begun, require_folder, throw_away
from fits.maps.settings import USUAL_CHUNK, Settings
from fits.maps.sharing import Shared
from fits.maps.smoothing import Smoothness
from fits.maps.store import clean, create, left
from fits.names import Objective
from fits.problem.instrument import Instrument
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import unit, with_floor
from fits.progress import Progress

if TYPE_CHECKING:
    from fits.data.geometry import Geometry

MOST_PARAMETERS = 32

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
    scale: float | Free | None = None,
    objective: Objective = "likelihood",
    instrument: Instrument | None = None,
    sigma: Any = None,
    mask: Any = None,
    starts: int = 8,
    seed: int = 0,
    sample: int = 64,
    chunk: int = 1024,
    processes: int = 1,
    tabulate: bool | None = None,
    posterior: int = 0,
    smooth: Smoothness | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedMap:
    """Fit a stack to the readings of every texel of a map, into a zarr store that grows chunk by chunk.

    What is in the store is not done again, and what comes to be in it does not depend on who did the work.

    Args:
        stack: holds `Free` where each texel has a number of its own, or with `shared=True` all have one in common,
            which is held from then on: errors of the others are conditional on it.
        geometry, values, sigma, mask: see `fits.maps.inputs.readings`: arrays or files, values (..., N, C) in 1/sr.
        out: directory of the store, made here, or begun by an earlier call with the same arguments.
        noise: as in `fits.fit`, but independent; a floor that it leaves out is one for the whole map.
        client: a `distributed.Client`, or the address of a scheduler, whose workers see `out` under the same path.
        transport, scale, objective, instrument: as in `fits.fit`; no instrument where texels have own directions.
        starts, seed, sample, chunk, tabulate, posterior, smooth: see `Settings`.
        processes: 1: threads of this process, one a core; of more each has a core of its own, and finds in the user's
            cache of programs, which is on while this runs, what this process has compiled.
        force: throw away a store of other arguments, and begin anew.
        progress: called with (stage, done, all, note): "sample", "map" and so on.

    Raises:
        ValueError: arguments that do not fit together, a store of others, one that another process writes, or chunks
            that could not be read or done: all others are.
        OSError: of the store, such as a full disk: chunks that are in it stay.
    """
    if several := processes > 1 and client is None:
        end_if_again()
    settings = Settings(starts, seed, sample, chunk, tabulate, posterior, smooth)
    rest = {"transport": transport, "scale": scale, "objective": objective, "instrument": instrument}
    found = readings(values, geometry, sigma=sigma, mask=mask)
    _require_fitting(settings, found, noise, rest)
    settings = replace(settings, chunk=min(settings.chunk, max(USUAL_CHUNK, math.prod(found.shape))))
    path = Path(out).resolve() if Path(out).is_symlink() else Path(out)  # one lock for all links to a store
    require_folder(path)
    kept = programs_kept() if several else nullcontext()  # workers run the program that has fitted the sample
    with locked(Path(f"{path}.lock"), str(path)), connected(client) as reached, kept:
        return _fitted(path, found, stack, noise, rest, settings, reached, processes, force, progress)


def _fitted(
    path: Path,
    found: Readings,
    stack: Any,
    noise: Noise | None,
    rest: Mapping[str, Any],
    settings: Settings,
    client: Any,
    processes: int,
    force: bool,
    progress: Progress | None,
) -> FittedMap:
    if noise is not None and not noise.use_sigma:
        found = replace(found, sigma=None)
    identity = {name: digest(one) for name, one in {"stack": stack, "noise": noise, **rest}.items()}
    identity |= {name: digest(one) for name, one in settings.told().items()}
    identity |= {"readings": found.digest(), "precision": str(np.dtype(jnp.result_type(float)))}
    if rest["instrument"] is not None:  # the floor of a map's noise stands in one place
        noise = with_floor(noise or Noise(), rest["instrument"])
        rest = {**rest, "instrument": replace(rest["instrument"], floor=None)}
    root = begun(path, identity, force)
    prepared = _prepared(root, found, stack, noise, rest, settings, progress)
    if root is None:
        throw_away(path)  # not before it is known that there can be another
        root = _created(path, prepared, found, identity, settings, stack)
    if GROUP not in root:
        with named(path):
            save(prepared, root)
    prepared = load(root, found, stack, noise, settings.chunk, **rest)  # as a run that is taken up again has it
    require_smoothable(prepared.problem, settings.smooth)
    job = _job(path, prepared, found, settings, client is None and processes == 1)
    failures = _run(root, job, found, client, processes, progress)
    if failures:
        words = [*failures[:NAMED], *([f"and {len(failures) - NAMED} more"] if len(failures) > NAMED else [])]
        raise ValueError(f"{path}: {'; '.join(words)}; all other chunks are done, and another run does these")
    if settings.smooth is not None:
        here = replace(job, source=found) if client is None else job
        smooth_map(open_map(path), here, found, settings.smooth, client, progress)
    if settings.posterior:
        sample_texels(root, prepared, found, settings.posterior, settings.seed, progress)
    return open_map(path)


def _require_fitting(settings: Settings, found: Readings, noise: Any, rest: Mapping[str, Any]) -> None:
    """Refuse arguments that are none, or mean nothing together."""
    if not isinstance(noise, Noise | None):
        raise ValueError(f"noise is {noise!r}; it must be a fits.Noise, or None")
    if rest["instrument"] is not None and found.geometry is None:
        raise ValueError("instrument is given, but every texel has directions of its own; there can be no instrument")
    if settings.posterior and rest["objective"] != "likelihood":
        raise ValueError(f"posterior is {settings.posterior}; it must be 0 with objective {rest['objective']!r}")


def _prepared(
    root: zarr.Group | None,
    found: Readings,
    stack: Any,
    noise: Noise | None,
    rest: Mapping[str, Any],
    settings: Settings,
    progress: Progress | None,
) -> Prepared:
    if root is not None and GROUP in root:
        return load(root, found, stack, noise, settings.chunk, **rest)
    some, places = sampled(found, settings.sample, 1)
    problem = prototype(some, found, stack, noise, **rest)
    if len(problem.names) > MOST_PARAMETERS:
        raise ValueError(f"stack: {len(problem.names)} parameters are free; of a map at most {MOST_PARAMETERS} can be")
    require_smoothable(problem, settings.smooth)
    enough = some.readings >= len(problem.names)
    if not enough.any():
        raise ValueError(f"values: no texel has as many readings as there are free parameters, {len(problem.names)}")
    return prepare(
        problem,
        found,
        some.rows(enough),
        places[enough],
        starts=settings.starts,
        seed=settings.seed,
        size=settings.chunk,
        table=settings.tabulate,
        progress=progress,
    )


def _created(
    path: Path,
    prepared: Prepared,
    found: Readings,
    identity: Mapping[str, str],
    settings: Settings,
    stack: Any,
) -> zarr.Group:
    problem, reduced = prepared.problem, prepared.reduced[np.isfinite(prepared.reduced)]
    about = {
        "version": layerjax.__version__,
        "digests": dict(identity),
        "samples": found.samples,
        "channels": list(problem.data.channels),
        "stack": repr(stack),
        "transport": repr(problem.transport),
        "noise": repr(problem.noise),
        "settings": settings.told(),
        "pilot": {
            "texels": len(prepared.texels),
            "reduced_chi_square": float(np.median(reduced)) if reduced.size else math.nan,
            "poor_above": prepared.starts.expected,
        },
        "numerical": {**prepared.words, "error": prepared.numerical_error},
        "shared": {} if prepared.shared is None else _told(prepared.shared),
    }
    return create(
        path,
        names=problem.names,
        units=problem.units,
        shape=found.shape,
        chunk=tile(found.shape, settings.chunk),
        attributes=about,
        numerical=prepared.numerical_error is not None,
    )


def _told(shared: Shared) -> dict[str, dict[str, Any]]:
    return {
        name: {"value": value, "error": shared.errors[name], "unit": unit(name), "converged": shared.converged}
        for name, value in shared.values.items()
    }


def tile(shape: tuple[int, ...], texels: int) -> tuple[int, ...]:
    """The shape of a chunk of at most so many texels, as square as the last axes of a map allow."""
    sides, left_over = [1] * len(shape), texels
    if len(shape) > 1:
        sides[-1] = min(shape[-1], max(math.isqrt(texels), texels // shape[-2]))
        left_over //= sides[-1]
    for axis in reversed(range(len(shape) - 1 if len(shape) > 1 else 1)):
        sides[axis] = max(1, min(shape[axis], left_over))
        left_over //= sides[axis]
    return tuple(sides)


def _job(path: Path, prepared: Prepared, found: Readings, settings: Settings, here: bool) -> Job:
    """What all chunks have in common; here: threads of this process do them."""
    return Job(
        str(path.resolve()),
        prepared.problem,
        prepared.starts,
        prepared.least,
        settings.chunk,
        prepared.numerical_error,
        found if here else found.portable,
    )


def _run(
    root: zarr.Group, job: Job, found: Readings, client: Any, processes: int, progress: Progress | None
) -> list[str]:
    """Fit the chunks that are left; what became of those that could not be."""
    blocks = left(root)
    every = len(list(grid(found.shape, tile(found.shape, job.size))))
    failures = []
    tasks, unreadable = _tasks(blocks, found, job.source is None)
    failures += unreadable
    done = every - len(blocks)
    _tell(progress, done, every, "")
    poor = fitted = 0
    for index, result in run(work, job, tasks, processes=processes, client=client):
        if isinstance(result, Failure):
            failures.append(f"{_words(tasks[index].block)}: {result.error}")
        else:
            fitted, poor = fitted + result["fitted"], poor + result["poor"]
        done += 1
        share = f"{100.0 * poor / fitted:.1f} % poor" if fitted else ""
        _tell(progress, done, every, share)
    if client is None:  # of a cluster, some may still write what others have done
        clean(job.path)
    if not failures:
        failures += [f"{_words(block)}: was written, and is not there" for block in left(root)]
    return failures


def _tasks(blocks: list[Block], found: Readings, with_readings: bool) -> tuple[list[Task], list[str]]:
    """One for each chunk, with its readings where workers cannot read them; and what cannot be read."""
    if not with_readings:
        return [Task(block) for block in blocks], []
    tasks, failures = [], []
    for block in blocks:
        try:
            tasks.append(Task(block, part_of(found, block)))
        except ValueError as error:
            failures.append(str(error))
    return tasks, failures


def _words(block: Block) -> str:
    return f"chunk [{', '.join(f'{one.start}:{one.stop}' for one in block)}]"


def _tell(progress: Progress | None, done: int, every: int, note: str) -> None:
    if progress is not None:
        progress("map", done, every, note)
