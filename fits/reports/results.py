"""A fit as a directory: written whole or not at all, and opened again as the same fit.

data.csv       the measurements that were fitted, with the rows that were left out marked
problem.toml   the stack with its free parameters, noise and scale, as given
fitted.toml    the same stack with the fitted values
fit.json       every number of the fit, its settings, and the versions that made it; checksums of it and of these files
chain.h5       the posterior's chain, once sampled, and summary.json with its estimates
report.html    all of it to read, and its pictures as *.png
"""

from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import read_json, require_there, text_checksum, write_json, write_text
from fits.data.formats import read, totals_csv
from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.data.spheres import Spheres
from fits.data.totals import Totals
from fits.reports.directories import FIT, replacing, reserved

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior

SCHEMA = 3
REPORT, SUMMARY = "report.html", "summary.json"
DATA, PROBLEM, FITTED, CHAIN = "data.csv", "problem.toml", "fitted.toml", "chain.h5"
_STORED = (
    "vector",
    "errors",
    "covariance",
    "cost",
    "at_bound",
    "converged",
    "status",
    "iterations",
    "condition_number",
)
_DERIVED = (
    "scale",
    "chi_square",
    "degrees_of_freedom",
    "reduced_chi_square",
    "log_likelihood",
    "correlation",
    "predicted",
    "residuals",
)
PACKAGES = ("jax", "equinox", "optimistix", "emcee", "numpy", "scipy")


def save_fit(fit: "Fit", directory: str | Path, force: bool = False) -> None:
    """Writes a result directory, without report, whole or not at all.

    Args:
        fit: what is saved.
        directory: made if it is not there.
        force: replace an earlier result.

    Raises:
        ValueError: `directory` is not empty, unless `force` is given and it holds an earlier result; the transport is a
            callable, or it or a part of the stack is of a class of one's own, which a file cannot name; or a channel
            cannot be written (see `write_csv`); or the fit is of several measurements (see `Fit.part`).
    """
    from fits.optimise.result import Fit
    from layerjax._checks import require_kind

    require_kind("fit", fit, Fit)
    fit.require_one("save_fit")
    with reserved(directory, force), replacing(directory, force) as folder:
        write_fit(fit, folder)


def write_fit(fit: "Fit", folder: Path, text: str | None = None) -> None:
    """The files of a fit, into a folder that holds none.

    text: the stack file as the user wrote it, which is kept as it is; it must describe the problem of the fit.
    """
    from fits.problem.parameters import Free
    from fits.problem.stack_file import write_problem
    from fits.problem.toml import transport_to_dict
    from layerjax import Transport

    problem, transport = fit.problem, fit.problem.transport
    if transport != "auto" and not isinstance(transport, Transport):
        raise ValueError(f"transport is {transport!r}: only 'auto' and layerjax's own can be saved")
    scale = problem.scale if isinstance(problem.scale, Free) else None
    spheres = _write_data(problem.data, folder / DATA)
    if text is not None:
        write_text(folder / PROBLEM, text)
    else:
        write_problem(
            folder / PROBLEM,
            problem.stack,
            transport=transport,
            noise=problem.noise,
            scale=scale,
            objective=problem.objective,
            instrument=problem.instrument,
        )
    write_problem(folder / FITTED, fit.stack, transport=transport)
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "settings": fit.settings,
        "start_outcomes": fit.start_outcomes,
        "transport": transport_to_dict(transport),
        "resolution": fit.resolution,
        "numerical_error": fit.numerical_error,
        "without_discrepancy": None if fit.without_discrepancy is None else asdict(fit.without_discrepancy),
        "dataset": fit.dataset,
        "source": asdict(problem.data.source),
        "spheres": None if spheres is None else asdict(spheres),
        "fixed_scale": None if scale is not None else problem.scale,
        "parameters": _parameters(fit),
        "fit": {name: getattr(fit, name) for name in _STORED},
        "insensitive": fit.insensitive,
        "unidentified": [asdict(combination) for combination in fit.unidentified],
        "minima": [{"values": one.values, "cost": one.cost, "count": one.count} for one in fit.minima],
        "alternatives": [list(map(id, fit.minima)).index(id(one)) for one in fit.alternatives],
        "derived": {name: getattr(fit, name) for name in _DERIVED},
        "checksums": {name: text_checksum(folder / name) for name in (DATA, PROBLEM)},
    }
    write_json(folder / FIT, content)


def _write_data(data: Measurements, path: Path) -> Spheres | None:
    """What was fitted; and spheres that its file does not tell of."""
    if isinstance(data, Totals):
        totals_csv.write(data.used(), path)
        return data.spheres
    write_csv(data, path)
    return None


def _parameters(fit: "Fit") -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "value": value,
            "standard_error": fit.standard_errors[name],
            "unit": fit.units[name],
            "low": float(fit.problem.low[index]),
            "high": float(fit.problem.high[index]),
            "at_bound": name in fit.at_bound,
        }
        for index, (name, value) in enumerate(fit.values.items())
    ]


def load_fit(directory: str | Path) -> "Fit":
    """The fit that was saved in a directory.

    Raises:
        ValueError, FileNotFoundError: on one line, for a directory that holds none, a damaged one, or none at all.
    """
    from fits.optimise.identifiability import Direction
    from fits.optimise.result import Fit, Minimum
    from fits.problem.stack_file import read_problem
    from fits.reports.stored import (
        stored_array,
        stored_number,
        stored_problem,
        stored_spheres,
        stored_without_discrepancy,
    )

    directory = Path(directory)
    content = _content(directory)
    given, data = read_problem(directory / PROBLEM), read(directory / DATA)
    try:
        if isinstance(data, Totals):
            data = replace(data, spheres=stored_spheres(content["spheres"]))
        problem = stored_problem(content, given, data)
        stored, count, error = content["fit"], len(problem.names), content["numerical_error"]
        minima = tuple(
            Minimum(
                values, stored_number(one["cost"]), one["count"], problem.build(np.array(list(values.values()))).stack
            )
            for one in content["minima"]
            for values in ({name: stored_number(value) for name, value in one["values"].items()},)
        )
        return Fit(
            problem=problem,
            vector=stored_array(stored["vector"], count),
            errors=stored_array(stored["errors"], count),
            covariance=stored_array(stored["covariance"], count, count),
            cost=stored_number(stored["cost"]),
            at_bound=tuple(stored["at_bound"]),
            converged=stored["converged"],
            status=stored["status"],
            iterations=stored["iterations"],
            condition_number=stored_number(stored["condition_number"]),
            unidentified=tuple(
                Direction(
                    stored_number(one["error"]),
                    one["weights"],
                    {name: stored_number(e) for name, e in one["conditional_errors"].items()},
                )
                for one in content["unidentified"]
            ),
            minima=minima,
            alternatives=tuple(minima[index] for index in content["alternatives"]),
            insensitive=tuple(content["insensitive"]),
            dataset=content["dataset"],
            settings=content["settings"],
            start_outcomes=content["start_outcomes"],
            numerical_error=None if error is None else stored_number(error),
            resolution=content["resolution"],
            without_discrepancy=stored_without_discrepancy(content["without_discrepancy"]),
        )
    except (LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{directory / FIT}: damaged, {type(error).__name__} {error}") from None
    except ValueError as error:
        raise ValueError(f"{directory / FIT}: {error}") from None


def load_posterior(directory: str | Path) -> "Posterior | None":
    """The posterior that was sampled in a result directory, as far as it got; None before its first step.

    Its estimates are refused where the chain is too short, unless it was saved as one to be reported all the same.

    Raises:
        FileNotFoundError: there is no such directory.
        ValueError: on one line, for a damaged file.
    """
    from fits.sampling.sample import NoSteps, load

    directory = Path(directory)
    require_there(directory, "no such directory")
    if not (directory / CHAIN).is_file():
        return None
    summary = read_json(directory / SUMMARY) if (directory / SUMMARY).is_file() else {}
    try:
        posterior = load(load_fit(directory), directory / CHAIN)
    except NoSteps:
        return None
    allowed = summary.get("allow_unconverged") is True and summary.get("steps", 0) <= len(posterior.chain)
    return replace(posterior, allow_unconverged=allowed)  # not by a summary of a longer chain, which has been replaced


def save_posterior(posterior: "Posterior", directory: str | Path) -> None:
    """Writes the estimates beside the chain that `fits.sample` keeps in the directory.

    Raises:
        ValueError: the chain is too short to report from.
    """
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "converged": posterior.converged,
        "allow_unconverged": posterior.allow_unconverged,
        "steps": len(posterior.chain),
        "walkers": posterior.chain.shape[1],
        "burn_in": posterior.burn_in,
        "acceptance": posterior.acceptance,
        "status": posterior.status,
        "divergences": posterior.divergences,
        "modes": [asdict(mode) for mode in posterior.modes],
        "parameters": [
            {
                "name": name,
                **dict(zip(("median", "low_68", "high_68", "mean", "sd"), estimates, strict=True)),
                "autocorrelation_time": posterior.autocorrelation_time[index],
                "effective_samples": posterior.effective_samples[index],
                "r_hat": posterior.r_hat[index],
            }
            for index, (name, estimates) in enumerate(posterior.summary().items())
        ],
    }
    write_json(Path(directory) / SUMMARY, content, force=True)


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    import layerjax

    return {"layerjax": layerjax.__version__} | {package: metadata.version(package) for package in PACKAGES}


def _content(directory: Path) -> dict[str, Any]:
    """What fit.json holds, if it and the files that it has checksums of are as they were written."""
    require_there(directory, "no such directory")
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: is not a result directory, it holds no {FIT}")
    content = read_json(directory / FIT)
    version = content.get("layerjax_result")
    if version != SCHEMA:
        raise ValueError(f"{directory / FIT}: is version {version} of the format, must be {SCHEMA}")
    for name, checksum in content.get("checksums", {}).items():  # layerjax 0.1.0 wrote none
        path = directory / name
        if path.is_file() and text_checksum(path) != checksum:
            raise ValueError(f"{path}: damaged or changed since the fit, its checksum is not that in {FIT}")
    return content
