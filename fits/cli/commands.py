"""What each command of `layerjax` does with its arguments; the parser defines them and reports errors.

Inputs are checked, and outputs refused, before any work begins. Numbers go to stdout, progress to stderr.
"""

import warnings
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import write_bytes, write_text
from fits.cli.input_output import DONE, DOUBTFUL, hint, read_options, require_place, show, use_jax
from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior
    from layerjax import Mixture, Stack

RESUME = "keeps what was fitted; the same command resumes it"

# ---- a fit and what follows from it ----


def fit(arguments: Namespace) -> int:
    """Fit a stack, save the result with its report, and print the table."""
    use_jax()
    from fits.batch import fit_file
    from fits.problem.stack_file import read_problem
    from fits.reports import results, tables, verdicts
    from fits.reports.data_summary import doubtful_angles

    directory, force = Path(arguments.out), arguments.force
    results.check_directory(directory, force)
    data, held_out = read_options(arguments).split(arguments.data)
    for doubt in doubtful_angles(data):
        warnings.warn(doubt, stacklevel=1)
    given, how = read_problem(arguments.stack), {"starts": arguments.starts, "seed": arguments.seed, "force": force}
    resume = f"{directory} was not written; the same command resumes with the starts that are done"
    with show_progress() as progress, hint(resume):
        whole = fit_file(directory, given, data, held_out, **how, progress=progress)
    report = f"Report: {directory / results.REPORT}"
    show(tables.parameter_table(whole.fit), *verdicts.summary(whole.fit), report)
    if held_out is not None and whole.predicted is not None:
        show(tables.scores_table(whole.predicted, held_out, "Held-out data"))
    return DONE if whole.fit.converged else DOUBTFUL


def sample(arguments: Namespace) -> int:
    """Sample the posterior of a saved fit, resuming its chain, with the sampler and walkers that it has."""
    use_jax()
    from fits.reports import results, tables, verdicts
    from fits.reports.html import FitReport
    from fits.sampling.sample import sample as run_sampler
    from fits.sampling.sample import settings_of
    from fits.store import Store

    directory = Path(arguments.directory)
    result, chain = results.load_fit(directory), directory / results.CHAIN
    if not result.is_posterior:
        raise ValueError(f"{directory}: fitted with {result.problem.objective!r}, which has no posterior to sample")
    sampler, walkers = "emcee", None
    if not arguments.force and chain.is_file() and (kept := Store.read(chain)).fingerprint:
        sampler, walkers, _ = settings_of(kept)
    settings: dict[str, Any] = {name: getattr(arguments, name) for name in ("ess", "max_steps", "allow_unconverged")}
    walkers = walkers if arguments.sampler in (None, sampler) else None
    settings |= {"sampler": arguments.sampler or sampler, "walkers": arguments.walkers or walkers}
    with show_progress() as progress, hint(f"the chain is kept, `layerjax sample {directory}` resumes it"):
        posterior = run_sampler(result, **settings, path=chain, resume=not arguments.force, progress=progress)
        if verdicts.reportable(posterior):
            results.save_posterior(posterior, directory)
            show(tables.posterior_table(posterior))
        else:
            (directory / results.SUMMARY).unlink(missing_ok=True)
        name, held_out = directory.resolve().name, results.load_held_out(directory)
        FitReport(result, posterior, name=name, held_out=held_out).write(directory)
    show(*verdicts.sampled(posterior), f"Report: {directory / results.REPORT}")
    enough = posterior.converged and np.min(posterior.effective_samples) >= posterior.options.ess
    if not enough:
        ess = "" if arguments.ess is None else f" --ess {arguments.ess}"
        print(f"To resume: layerjax sample {directory}{ess} --max-steps {2 * len(posterior.chain)}")
    return DONE if enough else DOUBTFUL


def predict(arguments: Namespace) -> int:
    """Write the prediction at other directions, or print how well measurements are predicted."""
    scored, out = arguments.score is not None, arguments.out
    if bool(arguments.incidence) == scored:
        raise ValueError("predict needs one of --incidence and --score")
    if not scored and out is None:
        raise ValueError("predict --incidence needs --out FILE")
    others, needed = (("azimuth",), "incidence") if scored else (("select", "read"), "score")
    for name in others:
        if getattr(arguments, name):
            raise ValueError(f"--{name} is given without --{needed}")
    require_place(out, arguments.force, ".csv", "predictions")
    use_jax()
    from fits.prediction.predict import predict as run_prediction
    from fits.reports import tables

    source = _result(Path(arguments.directory))
    if scored:
        data = read_options(arguments).read(arguments.score)
        found = run_prediction(source, data)
        show(tables.scores_table(found, data, f"Prediction of {arguments.score}"))
    else:
        found = run_prediction(source, slices(arguments.incidence, azimuth=arguments.azimuth or (0,)))
    if out is not None:
        write_text(out, tables.prediction_csv(found), force=arguments.force)
        show(
            f"{out}: predicted BSDF in 1/sr (bsdf_*), of a new measurement (predictive_*), of the stack without model "
            "discrepancy (latent_*)",
            *([] if found.reliable else [tables.UNRELIABLE]),
        )
    return DONE


def report(arguments: Namespace) -> int:
    """Write the report of a saved fit again, beside that of others if given; or that of a fitted map."""
    directory = Path(arguments.directory)
    if (directory / "zarr.json").is_file() or directory.suffix == ".zarr":
        return _report_map(directory, arguments)
    use_jax()
    from fits.reports import results
    from fits.reports.html import FitReport

    require_place(arguments.out, arguments.force)
    result, posterior = results.load_fit(directory), results.load_posterior(directory)
    others, held_out = _candidates(arguments.compare), results.load_held_out(directory)
    out = arguments.out or directory / results.REPORT
    page = FitReport(result, posterior, others, arguments.directory, held_out).page()
    write_text(out, page, force=arguments.force or arguments.out is None)
    print(f"Report: {out}")
    return DONE


def compare(arguments: Namespace) -> int:
    """Print which of several saved fits predicts the data best."""
    use_jax()
    from fits.prediction.compare import compare as run_compare
    from fits.reports import tables

    candidates = _candidates(arguments.directories)
    with show_progress() as progress:
        compared = run_compare(candidates, refit=not arguments.no_refit, progress=progress)
    show(tables.comparison_table(compared), compared.verdict)
    return DONE


def _candidates(directories: list[str]) -> "dict[str, Fit | Posterior]":
    """The fits of these directories, or their posteriors, under these words."""
    return {directory: _result(Path(directory)) for directory in directories}


def _result(directory: Path) -> "Fit | Posterior":
    """The posterior of a directory, if there are estimates of it, or else the fit."""
    from fits.reports import results, verdicts

    posterior = results.load_posterior(directory)
    return posterior if posterior is not None and verdicts.reportable(posterior) else results.load_fit(directory)


# ---- maps, many stacks, many files ----


def fit_map(arguments: Namespace) -> int:
    """Fit a stack to every texel of a map, or resume it, and print what was found."""
    if Path(arguments.out).suffix != ".zarr":
        raise ValueError(f"{arguments.out}: a fitted map can be written as .zarr only")
    kind, scale = arguments.spatial_prior, arguments.spatial_scale
    if (kind is None) != (scale is None):
        raise ValueError("--spatial-prior needs --spatial-scale, such as 0.05, and the scale the prior")
    use_jax()
    from fits.maps import report
    from fits.maps.fit_map import fit_map as run_fit
    from fits.maps.options import MapOptions, SpatialPrior
    from fits.problem.stack_file import read_problem

    given = read_problem(arguments.stack)
    noise = given.noise if arguments.noise is None else replace(given.noise, relative=arguments.noise)
    settings: dict[str, Any] = {name: getattr(given, name) for name in ("scale", "objective", "instrument")}
    for name in ("starts", "seed", "pilot_texels", "chunk_size", "processes", "force"):
        settings[name] = getattr(arguments, name)
    settings["emulator"] = {"auto": None, "always": True, "never": False}[arguments.emulator]
    settings["spatial_prior"] = None if kind is None else SpatialPrior(kind, scale)
    with show_progress() as progress, hint(f"{arguments.out} {RESUME}"):
        map = run_fit(
            given.stack,
            arguments.geometry,
            arguments.data,
            arguments.out,
            noise=noise,
            client=arguments.scheduler,
            transport=given.transport,
            sigma=arguments.sigma,
            mask=arguments.mask,
            options=MapOptions(**settings, progress=progress),
        )
    found = report.summarise(map)
    where = f"Store: {arguments.out}. For the report: layerjax report {arguments.out}"
    show(report.quartile_table(found, map), report.common_table(map), *report.verdict(found, map)[0], where)
    whole = found.done == found.texels and found.fitted > 0
    return DONE if whole and found.converged >= map.option("converged_share") else DOUBTFUL


def _report_map(store: Path, arguments: Namespace) -> int:
    """Write the report of a map, beside its store if no other place is given, and print its verdict."""
    if arguments.compare:
        raise ValueError(f"--compare: {store} is a map, which is not compared with others")
    out = arguments.out or (store if store.name else store.resolve()).with_suffix(".html")
    require_place(out, arguments.force)
    from fits.maps import report
    from fits.maps.store import open_map

    map = open_map(store)
    with show_progress() as progress:
        found = report.report(map, out, arguments.force, progress)
    show(*report.verdict(found, map)[0], f"Report: {out}")
    return DONE


def search(arguments: Namespace) -> int:
    """Search for the stack behind the data among those of a library, and write the report."""
    data = read_options(arguments).read(arguments.data)
    if isinstance(data, Totals):  # stacks are compared by cross-validation over incidences
        raise ValueError(f"{arguments.data}: holds totals; a search needs measurements along directions")
    use_jax()
    from fits import structure_search

    directory = Path(arguments.out)
    from fits.problem.noise import Noise
    from fits.problem.parameters import Free, LogNormal
    from fits.problem.stack_file import read_instrument

    sd = arguments.scale_sd or 0.0
    bound = float(np.exp(4.0 * sd))
    settings: dict[str, Any] = {
        "library": None if arguments.library is None else structure_search.read_library(arguments.library),
        "noise": Noise() if arguments.noise is None else Noise(relative=arguments.noise),
        "scale": Free(1.0, 1.0 / bound, bound, LogNormal(1.0, sd)) if sd > 0.0 else None,
        "instrument": None if arguments.instrument is None else read_instrument(arguments.instrument),
        "options": structure_search.SearchOptions(layers=arguments.layers),
    }
    with show_progress() as progress, hint(f"{directory} {RESUME}"):
        found = structure_search.search(data, **settings, directory=directory, progress=progress)
    show(structure_search.search_table(found), *structure_search.search_sentences(found), f"Fits: {directory}")
    return DONE


def fit_many(arguments: Namespace) -> int:
    """Fit every file by every stack, print the outcomes, and write the table."""
    use_jax()
    from fits import batch

    out = Path(arguments.out)
    with show_progress() as progress, hint(f"{out} {RESUME}"):
        found = batch.fit_files(
            arguments.data,
            arguments.stacks,
            out,
            processes=arguments.processes,
            client=arguments.scheduler,
            read_options=read_options(arguments),
            starts=arguments.starts,
            force=arguments.force,
            progress=progress,
        )
    show(batch.overview(found.rows, 40), *batch.statements(found), f"Table: {out / batch.TABLE}")
    return DONE if found.complete else DOUBTFUL


# ---- measurement files ----


def info(arguments: Namespace) -> int:
    """Print what is in a measurement file, and draw it."""
    from fits.reports.data_summary import data_statements, data_table, source_rows
    from fits.reports.plots.data import as_png, data_picture, totals_picture
    from fits.reports.tables import Table

    out, force = arguments.out or f"{Path(arguments.data).stem}.png", arguments.force
    require_place(arguments.out, force, ".png", "pictures")
    data = read_options(arguments).read(arguments.data)
    show(Table(data.source.path, ("", ""), source_rows(data)), data_table(data), *data_statements(data))
    if Path(out).exists() and not force:
        print(f"Picture: {out} exists already (--force draws it again)")
        return DONE
    picture = totals_picture(data) if isinstance(data, Totals) else data_picture(data)
    write_bytes(out, as_png(picture), force)
    print(f"Picture: {out}")
    return DONE


def convert(arguments: Namespace) -> int:
    """Read any supported format and write csv."""
    require_place(arguments.out, arguments.force, ".csv", "measurements")
    return _write_measurements(read_options(arguments).read(arguments.data), arguments)


def _write_measurements(data: Measurements, arguments: Namespace) -> int:
    """Write them as csv, and print their number."""
    from fits.data.formats.csv import write_csv

    what, quantity = "measurements", "BRDF in 1/sr"
    if isinstance(data, Totals):
        what, quantity = "totals", "shares of the incident flux"
        if data.spheres is not None:
            raise ValueError(f"{data.source.path}: integrating spheres measured these, which a CSV cannot describe")
    write_csv(data, arguments.out, force=arguments.force)
    print(f"{arguments.out}: {len(data)} {what}, {len(data.channels)} channels, {quantity}")
    return DONE


# ---- materials ----


def simulate(arguments: Namespace) -> int:
    """Write simulated measurements of a stack; noise, scale and instrument of its file are not simulated."""
    require_place(arguments.out, arguments.force, ".csv", "measurements")
    use_jax()
    from fits.problem.parameters import at_start
    from fits.problem.simulate import simulate as run_simulation
    from fits.problem.stack_file import read_problem

    given = read_problem(arguments.stack)
    geometry = slices(arguments.incidence, azimuth=arguments.azimuth)
    how = {"transport": given.transport, "noise": arguments.noise, "seed": arguments.seed}
    data = run_simulation(at_start(given.stack), geometry, **how)
    return _write_measurements(data, arguments)


def render(arguments: Namespace) -> int:
    """Draw a material of the gallery, or of a file, or the best of a saved fit."""
    require_place(arguments.out, arguments.force, ".png", "pictures")
    use_jax()
    from fits.optimise.result import Fit
    from fits.reports.plots.data import as_png
    from fits.reports.render import render as run_render
    from layerjax import Transport

    name = arguments.material
    material, transport = _material(name)
    if isinstance(material, Fit):
        material.require_one("render")
        used = material.problem.transport
        material, transport = material.stack, used if isinstance(used, Transport) else None
    title = Path(name).resolve().stem.replace("_", " ")
    figure = run_render(material, transport, title=title, size=arguments.size)
    write_bytes(arguments.out, as_png(figure), force=arguments.force)
    print(f"{arguments.out}: {name}")
    return DONE


def export(arguments: Namespace) -> int:
    """Write a material, or the best of a saved fit, for renderers or for optical design."""
    require_place(arguments.out, arguments.force)
    use_jax()
    from fits.exports.export import export as run_export

    name = arguments.material
    material, transport = _material(name)
    with show_progress() as progress:
        written = run_export(
            material,
            arguments.out,
            arguments.to,
            transport=transport,
            wavelengths=arguments.wavelengths,
            name=Path(name).resolve().stem,
            force=arguments.force,
            progress=progress,
        )
    print(f"{written.path}: {Path(name).name}")
    for note in written.notes:
        print(f"{note[0].upper()}{note[1:]}.")
    return DONE


def _material(name: str) -> "tuple[Fit | Stack | Mixture, Any]":
    """A saved fit, or a stack of the gallery or of a file, at its start; and its transport, None if not given."""
    from fits.problem.parameters import at_start
    from fits.problem.stack_file import read_problem
    from fits.reports.results import load_fit
    from layerjax import gallery

    if Path(name).is_dir():
        return load_fit(name), None
    if name in gallery.names():
        return gallery.stack(name), None
    if Path(name).suffix == ".toml":
        given = read_problem(name)
        return at_start(given.stack), None if given.transport == "auto" else given.transport
    raise ValueError(f"{name}: neither a .toml file nor a material of the gallery: {', '.join(gallery.names())}")


COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "fit": fit,
    "fit-map": fit_map,
    "sample": sample,
    "predict": predict,
    "report": report,
    "compare": compare,
    "search": search,
    "fit-many": fit_many,
    "info": info,
    "convert": convert,
    "simulate": simulate,
    "render": render,
    "export": export,
}
