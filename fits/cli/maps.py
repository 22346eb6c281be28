"""Whole maps on the command line: fitted texel by texel into a store, and reported."""

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

from fits.cli.input_output import DONE, DOUBTFUL, hint, require_free_place, show, use_jax
from fits.progress import show_progress

EMULATOR = {"auto": None, "always": True, "never": False}


def fit_map(arguments: Namespace) -> int:
    """Fit a stack to every texel of a map, or resume it, and print what was found."""
    if Path(arguments.out).suffix != ".zarr":
        raise ValueError(f"{arguments.out}: a fitted map can be written as .zarr only")
    if (arguments.spatial_prior is None) != (arguments.spatial_scale is None):
        raise ValueError("--spatial-prior needs --spatial-scale, such as 0.05, and the scale the prior")
    use_jax()
    from fits.maps import report
    from fits.maps.fit_map import fit_map as run
    from fits.maps.options import MapOptions, SpatialPrior
    from fits.problem.stack_file import read_problem

    prior = None
    if arguments.spatial_prior is not None:
        prior = SpatialPrior(arguments.spatial_prior, arguments.spatial_scale)
    given = read_problem(arguments.stack)
    noise = given.noise if arguments.noise is None else replace(given.noise, relative=arguments.noise)
    kept = f"what was fitted is in {arguments.out}; the same command resumes it"
    with show_progress() as progress, hint(kept):
        map = run(
            given.stack,
            arguments.geometry,
            arguments.data,
            arguments.out,
            noise=noise,
            client=arguments.scheduler,
            transport=given.transport,
            sigma=arguments.sigma,
            mask=arguments.mask,
            options=MapOptions(
                **{name: getattr(given, name) for name in ("scale", "objective", "instrument")},
                **{
                    name: getattr(arguments, name) for name in ("starts", "seed", "pilot_texels", "chunk_size", "force")
                },
                emulator=EMULATOR[arguments.emulator],
                spatial_prior=prior,
                processes=arguments.processes,
                progress=progress,
            ),
        )
    found, common = report.summarise(map), report.common_table(map)
    show(report.count_table(found), report.quartile_table(found, map), *([common] if common.rows else []))
    show(*report.verdict(found, map)[0], f"Store: {arguments.out}. For the report: layerjax report {arguments.out}")
    whole = found.done == found.texels and found.fitted > 0
    return DONE if whole and found.converged >= map.option("converged_share") else DOUBTFUL


def report_map(arguments: Namespace) -> int:
    """Write the report of a map, beside its store if no other place is given, and print its verdict."""
    if arguments.compare:
        raise ValueError(f"--compare: {arguments.directory} is a map, which is not compared with others")
    path = Path(arguments.directory)
    out = arguments.out or (path if path.name else path.resolve()).with_suffix(".html")
    require_free_place(out, arguments.force)
    from fits.maps import report
    from fits.maps.store import open_map

    map = open_map(arguments.directory)
    with show_progress() as progress:
        found = report.report(map, out, arguments.force, progress)
    show(*report.verdict(found, map)[0], f"Report: {out}")
    return DONE


def is_map(place: str) -> bool:
    """Whether this is a directory of zarr, of whatever content."""
    return (Path(place) / "zarr.json").is_file()
