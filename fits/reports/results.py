"""A fit as a result directory: written whole or not at all, and opened again as the same fit.

data.csv       the measurements, with a mask of those that were fitted
held_out.csv   the held-out data, if any
problem.toml   the stack with its free parameters, noise and scale, as given
fitted.toml    the same stack with the fitted values
fit.json       every number of the fit, its settings, and the versions that made it; checksums of it and of these files
chain.db       the posterior's chain, once sampled, and summary.json with its estimates
report.html    the report, pictures inside
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from fits import _files as files
from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements, Source
from fits.data.reading import read
from fits.data.spheres import Sphere, Spheres
from fits.data.totals import Totals
from fits.optimise.result import Fit, Minimum, WithoutDiscrepancy
from fits.optimise.uncertainty import Direction
from fits.problem.problem import Problem
from fits.problem.stack_file import read_problem, transport_from_dict, transport_to_dict, write_problem
from fits.reports.pages import versions
from fits.sampling.posterior import Posterior
from fits.sampling.sample import NoSteps, load
from layerjax import Transport
from layerjax._checks import require_kind

SCHEMA = 7
FIT, HELD_OUT, REPORT, SUMMARY, LOCK = "fit.json", "held_out.csv", "report.html", "summary.json", "chain.db.lock"
DATA, PROBLEM, FITTED, CHAIN = "data.csv", "problem.toml", "fitted.toml", "chain.db"
_FIELDS = [one.name for one in fields(Fit) if one.name not in ("problem", "without_discrepancy_parts")]


# ---- fits ----


def save_fit(fit: Fit, directory: str | Path, force: bool = False) -> None:
    """Write a result directory, without report. A directory that cannot be completed is not written.

    Args:
        fit: the fit.
        directory: is created if it does not exist.
        force: replace an earlier result.

    Raises:
        ValueError: `directory` is not empty, unless `force` is given and it holds an earlier result; the transport or a
            part of the stack is a function or class of one's own, which a file cannot name; the fit is of several
            measurements (see `Fit.part`).
    """
    require_kind("fit", fit, Fit)
    fit.require_one("save_fit")
    with writing(directory, force) as folder:
        write_fit(fit, folder)


def write_fit(fit: Fit, folder: Path, text: str | None = None) -> None:
    """The files of a fit, into a folder that holds none.

    text: the stack file as the user wrote it, which is kept as it is; it must describe the problem of the fit.
    """
    problem, transport, data = fit.problem, fit.problem.transport, fit.problem.data
    if transport != "auto" and not isinstance(transport, Transport):
        raise ValueError(f"transport is {transport!r}: only 'auto' and layerjax's own can be saved")
    spheres = data.spheres if isinstance(data, Totals) else None  # which the file cannot hold
    write_csv(data, folder / DATA)
    if text is not None:
        files.write_text(folder / PROBLEM, text)
    else:
        settings = {name: getattr(problem, name) for name in ("noise", "scale", "objective", "instrument")}
        write_problem(folder / PROBLEM, problem.stack, transport=transport, **settings)
    write_problem(folder / FITTED, fit.stack, transport=transport)
    numbers = ("values", "standard_errors", "units", "chi_square", "degrees_of_freedom")
    plain = asdict(replace(fit, problem=cast(Any, None)))
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "transport": transport_to_dict(transport),  # with the resolution that the fit chose
        "source": asdict(data.source),
        "spheres": None if spheres is None else asdict(spheres),
        **{name: getattr(fit, name) for name in numbers},
        "fit": {name: plain[name] for name in _FIELDS},
        "checksums": {name: files.text_checksum(folder / name) for name in (DATA, PROBLEM)},
    }
    files.write_json(folder / FIT, content)


def load_fit(directory: str | Path) -> Fit:
    """Load a fit from its directory.

    Raises:
        ValueError, FileNotFoundError: on one line, for a directory that holds none, a damaged one, or none at all.
    """
    directory = files.given_path("directory", directory)
    files.require_there(directory, "no such directory")
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: is not a result directory, it holds no {FIT}")
    content = files.read_json(directory / FIT)
    if (version := content.get("layerjax_result")) != SCHEMA:
        raise ValueError(f"{directory / FIT}: is version {version} of the format, must be {SCHEMA}")
    for name in (DATA, PROBLEM):
        files.require_there(directory / name)
        if files.text_checksum(directory / name) != content.get("checksums", {}).get(name):
            raise ValueError(f"{directory / name}: damaged or changed since the fit, its checksum is not that in {FIT}")
    try:
        # the problem: stack file and data, with what the fit chose beside them
        given, data, spheres = read_problem(directory / PROBLEM), read(directory / DATA), content["spheres"]
        data = replace(data, source=Source(**content["source"] | {"notes": tuple(content["source"]["notes"])}))
        if isinstance(data, Totals) and spheres is not None:
            both = ("reflection", "transmission")
            spheres |= {name: None if spheres[name] is None else Sphere(**spheres[name]) for name in both}
            data = replace(data, spheres=Spheres(**spheres))
        added = content["fit"]["without_discrepancy"] is not None
        noise = replace(given.noise, discrepancy=True) if added else given.noise
        transport = transport_from_dict(content["transport"])
        problem = Problem(given.stack, data, transport, noise, given.scale, given.objective, given.instrument)
        # its numbers
        stored = {name: _restored(content["fit"][name]) for name in _FIELDS}
        stored |= {name: np.array(stored[name], float) for name in ("vector", "errors", "covariance")}
        stored["unidentified"] = tuple(Direction(**one) for one in stored["unidentified"])
        if stored["without_discrepancy"] is not None:
            stored["without_discrepancy"] = WithoutDiscrepancy(**stored["without_discrepancy"])
        stored["minima"] = tuple(Minimum(**one) for one in stored["minima"])
        return Fit(problem=problem, **stored)
    except (LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{directory / FIT}: damaged, it is not what `save_fit` writes") from error


def _restored(value: Any) -> Any:
    """The value as it was: numbers that are not finite are words in JSON, and tuples are lists."""
    if isinstance(value, dict):
        return {name: _restored(one) for name, one in value.items()}
    if isinstance(value, list):
        return tuple(_restored(one) for one in value)
    return float(value) if value in ("nan", "inf", "-inf") else value


def load_held_out(directory: str | Path) -> Measurements | None:
    """The held-out data of a result directory; None if there are none."""
    path = Path(directory) / HELD_OUT
    return read(path, format="csv") if path.is_file() else None


# ---- posteriors ----


def load_posterior(directory: str | Path) -> Posterior | None:
    """Load the posterior from a result directory, also while it is sampled; None before the first step.

    Estimates from a chain that has not converged are refused, unless it was sampled with `allow_unconverged`.

    Raises:
        FileNotFoundError: there is no such directory.
        ValueError: on one line, for a damaged file.
    """
    directory = files.given_path("directory", directory)
    files.require_there(directory, "no such directory")
    if not (directory / CHAIN).is_file():
        return None
    summary = files.read_json(directory / SUMMARY) if (directory / SUMMARY).is_file() else {}
    try:
        posterior = load(load_fit(directory), directory / CHAIN)
    except NoSteps:
        return None
    allowed = summary.get("allow_unconverged") is True and summary.get("steps", 0) <= len(posterior.chain)
    return replace(posterior, allow_unconverged=allowed)  # not by a summary of a longer chain, which has been replaced


def save_posterior(posterior: Posterior, directory: str | Path) -> None:
    """Writes the estimates beside the chain that `fits.sample` keeps in the directory.

    Raises:
        ValueError: the chain is too short to report from.
    """
    names = ["converged", "allow_unconverged", "burn_in", "acceptance", "status", "divergences", "autocorrelation_time"]
    names += ["effective_samples", "r_hat"]
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "steps": len(posterior.chain),
        "walkers": posterior.chain.shape[1],
        **{name: getattr(posterior, name) for name in names},
        "modes": [asdict(mode) for mode in posterior.modes],
        "parameters": {
            name: dict(zip(("median", "low_68", "high_68", "mean", "sd"), estimates, strict=True))
            for name, estimates in posterior.summary().items()
        },
    }
    files.write_json(Path(directory) / SUMMARY, content, force=True)


# ---- directories ----


def check_directory(directory: Path, force: bool) -> None:
    """Refuses a place where a result cannot be written, or is being sampled: ValueError that says why."""
    if not directory.resolve().parent.is_dir():
        raise ValueError(f"{directory}: there is no directory {directory.resolve().parent}")
    if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
        return
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: exists and is not a result directory (it holds no {FIT}), will not be replaced")
    if not force:
        raise ValueError(f"{directory}: holds a result already (--force, or force=True, replaces it)")
    if (directory / LOCK).exists():
        with files.locked(directory / LOCK, str(directory)):
            pass


@contextmanager
def writing(directory: str | Path, force: bool = False) -> Iterator[Path]:
    """A new folder beside `directory` that takes its place when the block ends well, and is removed when it does not.

    While the block lasts, no other process writes this result.

    Raises:
        ValueError: another process writes it; or it is not empty, unless `force` is given and it is an earlier result.
    """
    directory = files.given_path("directory", directory)
    files.require_switch("force", force)
    check_directory(directory, force)
    target = directory.resolve()
    with files.locked(target.with_name(f".{target.name}.lock"), str(directory)), files.replacing(target) as folder:
        try:
            yield folder
        except OSError as error:
            if str(error.filename).startswith(f"{folder}"):  # of which the user knows nothing
                error.filename = f"{directory}{str(error.filename).removeprefix(str(folder))}"
            raise
        check_directory(directory, force)  # someone else may have written there in the meantime
