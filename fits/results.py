"""A fit as a directory: written whole or not at all, and opened again as the same fit.

data.csv       the measurements that were fitted, with the rows that were left out marked
problem.toml   the stack with its free parameters, noise and scale, as given
fitted.toml    the same stack with the fitted values
fit.json       every number of the fit, its settings, and the versions that made it
chain.h5       the posterior's chain, once sampled, and summary.json with its estimates
report.html    all of it to read, and its pictures as *.png
"""

import json
import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import permissions, write_text
from fits.formats import read
from fits.formats.csv import write_csv
from fits.measurements import Source

if TYPE_CHECKING:
    from fits.fit_result import Fit
    from fits.posterior import Posterior

SCHEMA = 2
REPORT, SUMMARY = "report.html", "summary.json"
FIT, DATA, PROBLEM, FITTED, CHAIN = "fit.json", "data.csv", "problem.toml", "fitted.toml", "chain.h5"
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

    Raises ValueError where `directory` is not empty, unless `force` is given and it holds an earlier result; and for a
    transport that a file cannot name (a function).
    """
    with replacing(directory, force) as folder:
        write_fit(fit, folder)


def write_fit(
    fit: "Fit", folder: Path, text: str | None = None, settings: Mapping[str, float | str] | None = None
) -> None:
    """The files of a fit, into a folder that holds none.

    text: the stack file as the user wrote it, which is kept as it is; it must describe the problem of the fit.
    settings: how the fit was run, kept for the record.
    """
    from fits.parameters import Free
    from fits.stack_file import write_problem
    from layerjax import Transport

    problem, transport = fit.problem, fit.problem.transport
    if transport != "auto" and not isinstance(transport, Transport):
        raise ValueError(f"transport is {transport!r}: only 'auto' and layerjax's own can be saved")
    scale = problem.scale if isinstance(problem.scale, Free) else None
    write_csv(problem.data, folder / DATA)
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
        )
    write_problem(folder / FITTED, fit.stack, transport=transport)
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "settings": dict(settings or {}),
        "source": asdict(problem.data.source),
        "fixed_scale": None if scale is not None else problem.scale,
        "parameters": [
            {
                "name": name,
                "value": value,
                "standard_error": fit.standard_errors[name],
                "unit": fit.units[name],
                "low": float(problem.low[index]),
                "high": float(problem.high[index]),
                "at_bound": name in fit.at_bound,
            }
            for index, (name, value) in enumerate(fit.values.items())
        ],
        "fit": {name: getattr(fit, name) for name in _STORED},
        "unresolved": [asdict(combination) for combination in fit.unresolved],
        "minima": [{"values": one.values, "cost": one.cost, "count": one.count} for one in fit.minima],
        "alternatives": [list(map(id, fit.minima)).index(id(one)) for one in fit.alternatives],
        "derived": {name: getattr(fit, name) for name in _DERIVED},
    }
    write_text(folder / FIT, json.dumps(_plain(content), indent=1) + "\n")


def load_fit(directory: str | Path) -> "Fit":
    """The fit that was saved in a directory. ValueError, on one line, for one that holds none or a damaged one."""
    from fits.fit_result import Fit, Minimum
    from fits.identifiability import Combination
    from fits.problem import Problem
    from fits.stack_file import read_problem

    directory = Path(directory)
    content = _read_json(directory / FIT)
    given = read_problem(directory / PROBLEM)
    try:
        if content["layerjax_result"] != SCHEMA:
            raise ValueError(f"is version {content['layerjax_result']} of the format, must be {SCHEMA}")
        source = content["source"] | {"notes": tuple(content["source"]["notes"])}
        data = replace(read(directory / DATA, format="csv"), source=Source(**source))
        scale = given.scale if given.scale is not None else content["fixed_scale"]
        problem = Problem(given.stack, data, given.transport, given.noise, scale, given.objective)
        stored = content["fit"]
        minima = tuple(
            Minimum(values, _number(one["cost"]), one["count"], problem.build(np.array(list(values.values()))).stack)
            for one in content["minima"]
            for values in ({name: _number(value) for name, value in one["values"].items()},)
        )
        return Fit(
            problem=problem,
            vector=_array(stored["vector"]),
            errors=_array(stored["errors"]),
            covariance=_array(stored["covariance"]),
            cost=_number(stored["cost"]),
            at_bound=tuple(stored["at_bound"]),
            converged=stored["converged"],
            status=stored["status"],
            iterations=stored["iterations"],
            condition_number=_number(stored["condition_number"]),
            unresolved=tuple(
                Combination(
                    _number(one["error"]), one["weights"], {name: _number(e) for name, e in one["alone"].items()}
                )
                for one in content["unresolved"]
            ),
            minima=minima,
            alternatives=tuple(minima[index] for index in content["alternatives"]),
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{directory / FIT}: damaged, {type(error).__name__} {error}") from None
    except ValueError as error:
        raise ValueError(f"{directory}: {error}") from None


def load_posterior(directory: str | Path) -> "Posterior | None":
    """The posterior that was sampled in a result directory, as far as it got; None before sampling.

    Its estimates are refused where the chain is too short, unless it was saved as one to be reported all the same.
    Raises ValueError, on one line, for a damaged file.
    """
    from fits.posterior import load

    directory = Path(directory)
    if not (directory / CHAIN).is_file():
        return None
    summary = _read_json(directory / SUMMARY) if (directory / SUMMARY).is_file() else {}
    return load(load_fit(directory), directory / CHAIN, allow_short=bool(summary.get("allow_short", False)))


def save_posterior(posterior: "Posterior", directory: str | Path) -> None:
    """Writes the estimates beside the chain that `fits.sample` keeps in the directory.

    Raises ValueError for a chain that is too short to report from.
    """
    content = {
        "layerjax_result": SCHEMA,
        "versions": versions(),
        "converged": posterior.converged,
        "allow_short": posterior.allow_short,
        "steps": len(posterior.chain),
        "walkers": posterior.chain.shape[1],
        "burn_in": posterior.burn_in,
        "acceptance": posterior.acceptance,
        "parameters": [
            {
                "name": name,
                **dict(zip(("median", "low_68", "high_68", "mean", "sd"), estimates, strict=True)),
                "autocorrelation_time": posterior.autocorrelation_time[index],
                "effective_samples": posterior.effective_samples[index],
            }
            for index, (name, estimates) in enumerate(posterior.summary().items())
        ],
    }
    write_text(Path(directory) / SUMMARY, json.dumps(_plain(content), indent=1) + "\n", force=True)


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    import layerjax

    return {"layerjax": layerjax.__version__} | {package: metadata.version(package) for package in PACKAGES}


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"{path.parent}: is not a result directory, it holds no {path.name}")
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, must be an object")
    return content


def _plain(value: Any) -> Any:
    """Only what JSON knows: arrays become lists, and numbers that are not finite the strings "nan", "inf", "-inf"."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return _plain(np.asarray(value).tolist())
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: float | str) -> float:
    return float(value)


def _array(values: list[Any]) -> np.ndarray:
    return np.array(values, dtype=float)


def check_directory(directory: Path, force: bool) -> None:
    """Refuses a place where a result cannot be written: ValueError that says why."""
    if not directory.resolve().parent.is_dir():
        raise ValueError(f"{directory}: there is no directory {directory.resolve().parent}")
    if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
        return
    if not (directory / FIT).is_file():
        raise ValueError(f"{directory}: exists and is not a result directory (it holds no {FIT}), will not be replaced")
    if not force:
        raise ValueError(f"{directory}: holds a result already (--force, or force=True, replaces it)")


@contextmanager
def replacing(directory: str | Path, force: bool = False) -> Iterator[Path]:
    """A new folder beside `directory` that takes its place when the block ends well, and is removed when it does not.

    Raises ValueError for a directory that is not empty, unless `force` is given and it is an earlier result.
    """
    directory = Path(directory)
    check_directory(directory, force)
    target = directory.resolve()
    folder = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".new", dir=target.parent))
    try:
        folder.chmod(permissions(0o777))
        yield folder
        check_directory(directory, force)  # someone else may have written there in the meantime
        if not target.exists():
            folder.rename(target)
            return
        old = folder.with_suffix(".old")
        target.rename(old)
        try:
            folder.rename(target)
        except OSError:
            old.rename(target)
            raise
        shutil.rmtree(old)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
