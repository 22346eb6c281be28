"""Whole maps on the command line: fitted texel by texel into a store."""

import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fits.cli.interrupts import hint
from fits.cli.setting import use_jax
from fits.maps.inputs import readings
from fits.maps.smoothing import Smoothness
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.maps.summary import Summary

DONE, DOUBTFUL = 0, 1
ENOUGH = 0.99
"""Share of the fitted texels that have converged where a map is to be relied on."""

TABULATE = {"auto": None, "always": True, "never": False}


def fit_map(arguments: Namespace) -> int:
    """Fit a stack to every texel of a map, or go on with it, and print what was found."""
    _require_store(arguments.out)
    # before anything slow is imported: what is wrong with the files is told
    readings(arguments.data, arguments.geometry, sigma=arguments.sigma, mask=arguments.mask)
    smooth = _smoothness(arguments)
    use_jax()
    from fits.problem.stack_file import read_problem

    given = read_problem(arguments.stack)
    from fits.maps.fit_map import fit_map as run_map
    from fits.maps.report import tables
    from fits.maps.summary import summarised
    from fits.problem.compilation import cores
    from fits.reports.tables import print_table

    noise = given.noise if arguments.noise is None else replace(given.noise, relative=arguments.noise)
    local = arguments.scheduler is None
    more: dict[str, Any] = {"posterior": arguments.posterior} if arguments.posterior else {}
    more |= {} if smooth is None else {"smooth": smooth}
    kept = f"what was fitted is in {arguments.out}; the same command again goes on with it"
    with show_progress() as progress, hint(kept):
        found = run_map(
            given.stack,
            arguments.geometry,
            arguments.data,
            arguments.out,
            noise=noise,
            client=arguments.scheduler,
            transport=given.transport,
            scale=given.scale,
            objective=given.objective,
            instrument=given.instrument,
            sigma=arguments.sigma,
            mask=arguments.mask,
            starts=arguments.starts,
            seed=arguments.seed,
            sample=arguments.sample,
            chunk=arguments.chunk,
            processes=(arguments.processes or cores()) if local else 1,
            tabulate=TABULATE[arguments.tabulate],
            **more,
            force=arguments.force,
            progress=progress,
        )
    told = summarised(found)
    shared = replace(tables.shared_table(found), title="The same for all texels")
    for table in (tables.count_table(told), tables.quartile_table(told, found), *([shared] if shared.rows else [])):
        print_table(table, sys.stdout)
    if smooth is not None:
        print(tables.smoothing_words(found))
    print(f"Store: {arguments.out}. For the report: layerjax report {arguments.out}")
    return DONE if _reliable(told) else DOUBTFUL


def _smoothness(arguments: Namespace) -> Smoothness | None:
    """What is asked for of neighbouring texels."""
    if arguments.smooth is None:
        for name in ("smooth_scale", "smooth_rounds"):
            if getattr(arguments, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} is given without --smooth")
        return None
    if not arguments.smooth_scale:
        raise ValueError(f"--smooth {arguments.smooth} needs --smooth-scale, such as 0.05 of the bounds")
    scales = dict(arguments.smooth_scale)
    if len(scales) < len(arguments.smooth_scale) or ("" in scales and len(scales) > 1):
        raise ValueError("--smooth-scale: must be one number for all parameters, or one for each name")
    rounds = {} if arguments.smooth_rounds is None else {"rounds": arguments.smooth_rounds}
    return Smoothness(arguments.smooth, scales.get("", scales), **rounds)


def _reliable(found: "Summary") -> bool:
    """Whether every texel is there, some are fitted, and nearly all of those have converged."""
    return found.there == found.texels and found.fitted > 0 and found.converged >= ENOUGH


def _require_store(out: str) -> None:
    """Before any work: the store may stand there. What it holds is for `fits.fit_map` to judge."""
    place = Path(out)
    if (place if place.name else place.resolve()).suffix != ".zarr":
        raise ValueError(f"{out}: a fitted map can be written as .zarr only")
    if place.exists() and not place.is_dir():
        raise ValueError(f"{out}: is a file, must be a store or nothing")
    if not place.resolve().parent.is_dir():
        raise ValueError(f"{out}: there is no directory {place.parent}")
