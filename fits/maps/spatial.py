"""A spatial prior: neighbouring texels held together, by block alternation beside the plain fit and after it.

Texels are coloured like a chessboard, so that no edge joins two of one colour. With the other colour held, each texel
has a posterior of its own: its measurements, its prior, and a Gaussian that draws it to its neighbours. Every half
round lowers minus the log-posterior of the map, or leaves it where it is. Where the spatial prior weighs much more than
the data, many rounds are needed. Edges join fitted texels that lie side by side along an axis of the map.

Differences are in the unit box, between the bounds of a parameter or of its logarithm (`LogUniform`, `LogNormal`). The
state after each round is the group ``smoothed`` of the store, from which an interrupted run resumes.
"""

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from fits._files import plain
from fits.data.geometry import Booleans, Floats
from fits.engines import Failure, run
from fits.maps.inputs import Block, block_words
from fits.maps.options import Kind, MapOptions
from fits.maps.pilot import Job
from fits.maps.store import FLAGS, SMOOTHED, Store, blocks_of
from fits.maps.texels import fit_texels, standard_errors, to_units, widths

FLAT = 0.1  # of the scale: below, a difference counts by its square in a total variation, which has no derivative at 0


def neighbour_prior(kind: Kind, scales: Floats, units: Floats, fitted: Booleans) -> tuple[Floats, Floats]:
    """The Gaussian by which the neighbours of each texel hold it: its centre in the unit box and its precision, 0 where
    no edge ends, (map shape, P) each.

    Its logarithm has the slope of the spatial prior's where the texel is, and lies below it elsewhere: what lowers the
    cost with it lowers that with the spatial prior. scales: (P,), infinite where a parameter is not smoothed. units:
    (map shape, P), finite where `fitted`, (map shape).
    """
    total, moment = np.zeros((2, *units.shape))
    with np.errstate(invalid="ignore"):
        for axis in range(fitted.ndim):
            for first, second in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
                own, other = ((*[slice(None)] * axis, cut) for cut in (first, second))
                joined = fitted[own] & fitted[other]
                share = np.abs(units[other] - units[own]) / scales
                flat = np.ones_like(share) if kind == "gaussian" else np.maximum(share, FLAT)
                weight = np.where(joined[..., None], 1.0 / (np.square(scales) * flat), 0.0)
                total[own] += weight
                moment[own] += np.where(joined[..., None], weight * units[other], 0.0)
    return moment / np.where(total > 0.0, total, 1.0), total


class Half(NamedTuple):
    """The M texels of one colour in a chunk: which of the block, where they are, (M, P), in the unit box, and how
    strongly their neighbours hold them, see `Texels`."""

    block: Block
    mine: Booleans
    units: Floats
    centre: Floats
    inverse_sd: Floats


def work(job: Job, task: Half) -> tuple[Floats, Floats]:
    """Fit texels given their neighbours: vectors and errors, (M, P), NaN where there is no finite fit."""
    problem = job.problem
    rows = job.texels(task.block)[1].rows(task.mine.reshape(-1))
    rows = rows._replace(centre=task.centre, inverse_sd=task.inverse_sd)
    best = fit_texels(problem, task.units, rows, job.options.chunk_size, fresh=False)
    errors, finite = standard_errors(problem, best, rows)[0], best.finite[:, None]
    return np.where(finite, best.vector, np.nan), np.where(finite, errors, np.nan)


def smooth_map(store: Store, job: Job, client: Any, options: MapOptions) -> None:
    """Smooth a map that is fitted whole, into a group of its store, from where an earlier call stopped.

    ValueError: measurements that cannot be read again; whole rounds are kept.
    """
    names, problem, prior = store.names, job.problem, options.spatial_prior
    assert prior is not None
    scales = prior.scales(names)
    said = {"kind": prior.kind, "scale": scales, "rounds": prior.rounds, "settled": options.settled}
    widest = np.array([scales.get(name, math.inf) for name in names])
    paths = [f"{group}/{name}" for group in ("values", "errors") for name in names]

    # where an earlier call stopped, or the plain fit
    fitted = (store.flags & FLAGS["fitted"]) != 0
    kept, moves = None, list[float]()
    with suppress(ValueError):  # damaged: smoothed anew
        kept = store.load_group(SMOOTHED)
    if kept is not None and kept[1]["smoothing"]["prior"] == plain(said):
        if kept[1]["finished"]:
            return
        moves = list(kept[1]["smoothing"]["largest_moves"])
    arrays = kept[0] if kept is not None and moves else {path: store.read(path) for path in paths}
    vectors, errors = np.moveaxis(
        np.stack([arrays[path] for path in paths]).reshape(2, len(names), *fitted.shape), 1, -1
    )

    def units_now() -> Floats:  # whatever of texels that are not fitted
        return to_units(problem, np.where(fitted[..., None], vectors, problem.low))

    while len(moves) < prior.rounds and not (moves and moves[-1] <= options.settled):
        note = f"the farthest moved by {moves[-1]:.2g} errors" if moves else ""
        options.progress("smoothing", len(moves), prior.rounds, note)
        before, errors_before = units_now(), errors.copy()
        for colour in (0, 1):
            units = units_now()
            centre, precision = neighbour_prior(prior.kind, widest, units, fitted)
            coloured = fitted & (np.indices(fitted.shape).sum(axis=0) % 2 == colour)
            tasks = []
            for block in blocks_of(fitted.shape, store.chunk):
                if (mine := coloured[block]).any():
                    at, to, inverse_sd = (one[block][mine] for one in (units, centre, np.sqrt(precision)))
                    tasks.append(Half(block, mine, at, to, inverse_sd))
            for index, result in run(work, job, tasks, client=client, short=True):
                block, mine, *_ = tasks[index]
                if isinstance(result, Failure):
                    raise ValueError(
                        f"{store.path}: smoothing of chunk {block_words(block)}: {result.error}; the map is fitted, "
                        "and another run resumes after the last whole round"
                    )
                for whole, part in zip((vectors, errors), result, strict=True):
                    chunk = whole[block]  # a view
                    chunk[mine] = np.where(np.isfinite(result[0]), part, chunk[mine])
        # how far a texel moved at most, in standard errors: those of now, or of before where there are none
        error = np.where(np.isfinite(errors), errors, np.where(np.isfinite(errors_before), errors_before, np.inf))
        share = np.abs(units_now() - before) * widths(problem, vectors) / np.where(error > 0.0, error, np.inf)
        moves.append(float(np.max(share[fitted], initial=0.0)))

        # the state after a round; the last one is the smoothed map
        settled = moves[-1] <= options.settled
        about = {"prior": said, "rounds": len(moves), "settled": settled, "largest_moves": moves, "eps": FLAT}
        state = np.moveaxis(np.stack([vectors, errors]), -1, 1).reshape(len(paths), *fitted.shape)
        store.save_group(
            SMOOTHED,
            dict(zip(paths, state, strict=True)),
            {"smoothing": about, "finished": settled or len(moves) == prior.rounds},
            chunks=store.chunk,
            dimension_names=store.arrays["flags"].metadata.dimension_names,
            fill_value=np.nan,
        )
    options.progress("smoothing", len(moves), prior.rounds)
