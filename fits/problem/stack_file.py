"""Stacks and fitting problems as TOML: a table for each layer and the base, and a table where a number is free.

    transport = "SingleScattering"             # optional, "auto" by default; { kind = "AddingDoubling", nodes = 16 }
    objective = "likelihood"                   # optional
    about = { source = "..." }                 # optional: a table of texts that are kept and not looked at
    gallery = "fabric"                         # optional: a material by name, in place of layers and base

    [[layers]]                                 # from top to bottom
    kind = "Medium"
    thickness = { start = 0.5, low = 0.0, high = 5.0, prior = { kind = "Normal", mean = 0.5, sd = 0.2 } }
    phase = { kind = "SGGX", shape = "surface", alpha = 0.3 }
    f0 = { start = 0.04, low = 0.0, high = 0.2, same_for_all_texels = true }   # see `Free`

    [base]
    kind = "Lambertian"
    albedo = [0.1, 0.2, 0.3]                   # one number, or one a channel

    [mixture.bare]                             # in place of layers and base: parts, each with layers and a base, a name
    weight = 0.3                               # of the gallery, or a mixture; omitted in one, which covers the rest

    [noise]                                    # optional: relative, floor, use_sigma, tails, degrees_of_freedom,
                                               # discrepancy: true, or a table of its amplitude and lengths
    [scale]                                    # optional common calibration factor: start, low, high, prior

    [instrument]                               # optional: apertures, tilt, gain_sd, floor, rings: see `Instrument`

    [options]                                  # optional: thresholds of the fit, see `fits.FitOptions`

Keys are the parameters of the classes of the same name; the `kind` of an SGGX is called `shape` here. Bad input is a
ValueError on one line that names the place (``layers[0].thickness``), what stands there and what may.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import tomli_w

import layerjax as lj
from fits._files import write_text
from fits.names import Objective
from fits.problem.instrument import Instrument
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.toml import (
    MATERIAL,
    changed_to_dict,
    instrument_from_dict,
    material_from_dict,
    material_to_dict,
    noise_from_dict,
    require_known,
    scale_from_dict,
    to_plain,
    transport_from_dict,
    transport_to_dict,
)
from fits.problem.values import check_keys, choice, read_tables, require_table, shown


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """What a TOML file says: the arguments of `fits.fit` other than the data, what it says of itself, and the text."""

    stack: lj.Stack | lj.Mixture
    transport: lj.Transport | Literal["auto"]
    noise: Noise
    scale: Free | None
    objective: Objective
    instrument: Instrument | None
    options: Mapping[str, Any]
    about: Mapping[str, str]
    text: str


def read_problem(path: str | Path) -> ProblemFile:
    """Read a stack, and what else the TOML file says about fitting it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file, the place in it and what may stand there.
    """
    path = Path(path)
    text, tables = read_tables(path)
    try:
        known = ("about", "transport", "objective", *MATERIAL, "noise", "scale", "instrument", "options")
        check_keys("the file", tables, known)
        return ProblemFile(
            stack=material_from_dict({key: tables[key] for key in MATERIAL if key in tables}),
            transport=transport_from_dict(tables.get("transport", "auto")),
            noise=noise_from_dict(tables.get("noise", {})),
            scale=scale_from_dict(tables["scale"]) if "scale" in tables else None,
            objective=cast(Objective, choice("objective", tables.get("objective", "likelihood"), get_args(Objective))),
            instrument=instrument_from_dict(tables["instrument"]) if "instrument" in tables else None,
            options=require_table("options", tables.get("options", {})),
            about=_about(tables.get("about", {})),
            text=text,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_instrument(path: str | Path) -> Instrument:
    """The ``[instrument]`` of a TOML file, whatever else it holds.

    Raises:
        ValueError: as `read_problem`, or there is none.
    """
    _, tables = read_tables(Path(path))
    try:
        if "instrument" not in tables:
            raise ValueError("there is no [instrument]")
        return instrument_from_dict(tables["instrument"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_problem(
    path: str | Path,
    stack: lj.Stack | lj.Mixture,
    *,
    transport: lj.Transport | Literal["auto"] = "auto",
    noise: Noise | None = None,
    scale: Free | None = None,
    objective: Objective = "likelihood",
    instrument: Instrument | None = None,
    force: bool = False,
) -> None:
    """Write a TOML file that `read_problem` reads back to the same. What the call omits is omitted there.

    Args:
        path: the file.
        stack: may hold `Free`.
        transport, noise, scale, objective, instrument: see `Problem`.
        force: replace a file that is there.

    Raises:
        ValueError: the file exists and `force` is False; or a part is of a class of one's own, which no file names.
    """
    require_known(stack, transport)
    tables: dict[str, Any] = {}
    if not isinstance(transport, str):
        tables["transport"] = transport_to_dict(transport)
    if objective != "likelihood":
        tables["objective"] = objective
    tables |= material_to_dict(stack)
    if noise is not None:
        tables["noise"] = changed_to_dict(noise)
    if instrument is not None:
        tables["instrument"] = changed_to_dict(instrument)
    if scale is not None:
        tables["scale"] = to_plain(scale)
    write_text(path, tomli_w.dumps(tables), force)


def _about(table: Any) -> dict[str, str]:
    for key, text in require_table("about", table).items():
        if not isinstance(text, str):
            raise ValueError(f"about[{shown(key)}] is {shown(text)}, must be a text")
    return dict(table)
