"""Posteriors of a few texels of a fitted map: how far the standard errors of all of them hold."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.maps import chunk_files
from fits.maps.fitted_map import FittedMap, open_map
from fits.maps.inputs import Readings
from fits.maps.job import Part, part_of, rows_of
from fits.maps.prepared import GOLDEN, Prepared
from fits.maps.sampled import GROUP, QUANTILES
from fits.maps.texels import model_of
from fits.optimise.fit import refit
from fits.problem.problem import Problem
from fits.progress import Progress
from fits.sampling.sample import sample

Floats = NDArray[np.float64]

MOST_STEPS = 20_000


def sample_texels(
    root: zarr.Group, prepared: Prepared, readings: Readings, count: int, seed: int, progress: Progress | None
) -> None:
    """Sample the posteriors of `count` texels from all over a finished map, and keep them in its store.

    What is there of as many texels is not done again. Where none has converged, there are none to sample.
    """
    path = Path(root.store.root)  # type: ignore[attr-defined]
    fitted = open_map(path)
    places = chosen(fitted, count)
    if not len(places) or (GROUP in root and dict(root[GROUP].attrs).get("texels") == len(places)):
        return
    shutil.rmtree(path / GROUP, ignore_errors=True)
    vectors, rows = np.stack([fitted.values[name][tuple(places.T)] for name in fitted.names], axis=1), []
    for index, (place, vector) in enumerate(zip(places, vectors, strict=True)):
        if progress is not None:
            progress("posterior", index, len(places))
        rows.append(_sampled(prepared, readings, tuple(int(at) for at in place), vector, seed))
    if progress is not None:
        progress("posterior", len(places), len(places))
    group = root.create_group(GROUP)
    group.create_array("places", data=places.astype(np.int64), compressors=chunk_files.codecs())
    for name, arrays in zip(("mean", "sd", "quantiles", "converged"), zip(*rows, strict=True), strict=True):
        group.create_array(name, data=np.stack(arrays), compressors=chunk_files.codecs())
    group.attrs.update({"names": list(fitted.names), "quantiles": list(QUANTILES), "seed": seed, "texels": len(places)})


def chosen(fitted: FittedMap, count: int) -> NDArray[np.int64]:
    """Places of texels that converged, evenly from all over the map, (T, rank)."""
    candidates = np.argwhere(fitted.has("converged"))
    turns = (np.arange(min(4 * count, len(candidates))) + 0.5) * GOLDEN % 1.0
    picked = list(dict.fromkeys((turns * len(candidates)).astype(int).tolist()))[:count]
    return candidates[sorted(picked)]


def _sampled(
    prepared: Prepared, readings: Readings, place: tuple[int, ...], vector: Floats, seed: int
) -> tuple[Floats, Floats, Floats, np.bool_]:
    part = part_of(readings, tuple(slice(at, at + 1) for at in place))
    posterior = sample(
        refit(problem_at(prepared, part), vector), seed=seed, max_steps=MOST_STEPS, allow_unconverged=True
    )
    draws = posterior.samples
    quantiles = np.quantile(draws, QUANTILES, axis=0).T
    return draws.mean(axis=0), draws.std(axis=0), quantiles, np.bool_(posterior.converged)


def problem_at(prepared: Prepared, part: Part) -> Problem:
    """The problem of one texel, whose readings are a block of its own; they count as in its fit."""
    row, problem = rows_of(part, prepared.least).rows(0), prepared.problem
    wi, wo = (problem.data.wi, problem.data.wo) if row.wi is None else (row.wi, row.wo)
    sigma = None if part.sigma is None else np.sqrt(row.variance)
    data = Measurements(wi, wo, row.values, sigma, np.ones(len(wi), bool), problem.data.channels)
    return replace(problem, data=data).with_model(model_of(problem.model, row))
