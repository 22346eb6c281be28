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

import difflib
import inspect
import math
import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np
import tomli_w

import layerjax as lj
from fits._files import given_path, require_file, write_text
from fits.names import Objective
from fits.problem.discrepancy import Discrepancy
from fits.problem.instrument import Instrument
from fits.problem.noise import LEVELS, Noise
from fits.problem.parameters import Free, LogNormal, LogUniform, Normal, PowerLaw, Prior, Uniform
from layerjax import gallery
from layerjax._checks import in_short, require_kind
from layerjax._shapes import require_single
from layerjax.mixture import require_material

Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)
MOST = 2**31 - 1  # of a whole number: counts are kept in 32 bits
_LONGEST = 60  # letters of a key that an error suggests others for

MATERIAL = ("gallery", "layers", "base", "mixture")
"""Keys of a material: of a stack, or what stands in its place."""

_Kinds = Mapping[str, type]
_LAYERS: _Kinds = {kind.__name__: kind for kind in (lj.Interface, lj.Medium, lj.TurbidMedium)}
_BASES: _Kinds = {kind.__name__: kind for kind in (lj.Lambertian, lj.OrenNayar, lj.VMFDiffuse, lj.Conductor)}
_PHASES: _Kinds = {kind.__name__: kind for kind in (lj.HenyeyGreenstein, lj.Rayleigh, lj.SGGX)}
_TRANSPORTS: _Kinds = {
    name: kind
    for name, kind in vars(lj).items()
    if inspect.isclass(kind) and issubclass(kind, lj.Transport) and not inspect.isabstract(kind)
}
_LAWS: _Kinds = {"PowerLaw": PowerLaw}
_PRIORS: _Kinds = {kind.__name__: kind for kind in (Uniform, LogUniform, Normal, LogNormal)}
_FREE_KEYS = tuple(one.name for one in fields(Free))


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
    path = given_path("path", path)
    text, tables = read_tables(path)
    try:
        known = ("about", "transport", "objective", *MATERIAL, "noise", "scale", "instrument", "options")
        check_keys("the file", tables, known)
        return ProblemFile(
            stack=material_from_dict({key: tables[key] for key in MATERIAL if key in tables}),
            transport=transport_from_dict(tables.get("transport", "auto")),
            noise=_settings("noise", Noise, tables.get("noise", {})),
            scale=_one_free("scale", tables["scale"], LEVELS) if "scale" in tables else None,
            objective=cast(Objective, choice("objective", tables.get("objective", "likelihood"), get_args(Objective))),
            instrument=_settings("instrument", Instrument, tables["instrument"]) if "instrument" in tables else None,
            options=require_table("options", tables.get("options", {})),
            about=_about(tables.get("about", {})),
            text=text,
        )
    except (ValueError, RecursionError) as error:
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
        return _settings("instrument", Instrument, tables["instrument"])
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
    require_material(stack)
    require_kind("transport", transport, lj.Transport, str)
    for name, value, kind in (("noise", noise, Noise), ("scale", scale, Free), ("instrument", instrument, Instrument)):
        require_kind(name, value, kind, None)
    choice("objective", objective, get_args(Objective))
    tables: dict[str, Any] = {}
    if not isinstance(transport, str):
        tables["transport"] = transport_to_dict(transport)
    if objective != "likelihood":
        tables["objective"] = objective
    tables |= material_to_dict(stack)
    material_from_dict(material_to_dict(stack))  # refuses what could not be read again
    transport_from_dict(transport_to_dict(transport))
    if noise is not None:
        tables["noise"] = changed_to_dict(noise)
    if instrument is not None:
        tables["instrument"] = changed_to_dict(instrument)
    if scale is not None:
        tables["scale"] = to_plain(scale)
    write_text(path, tomli_w.dumps(tables), force)


# ---- from tables ----


def read_tables(path: Path) -> tuple[str, dict[str, Any]]:
    """The text of a TOML file, without a byte order mark, and its tables. ValueError that names the file."""
    require_file(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return text, tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from None
    except ValueError as error:
        raise ValueError(f"{path}: not valid TOML: {error!s:.300}") from None
    except RecursionError:
        raise ValueError(f"{path}: arrays or tables are nested too deeply to be read") from None


def stack_from_dict(tables: Mapping[str, Any], where: str = "") -> lj.Stack:
    """A stack, with `Free` parameters where a number is given as a table, from the `layers` and `base` of a file.

    where: of the file they stand, such as ``mixture.bare.``.
    """
    check_keys(f"{where.rstrip('.') or 'the stack'}", tables, ("layers", "base"))
    layers = tables.get("layers", [])
    if not isinstance(layers, list):
        raise ValueError(f"{where}layers is not a list of tables, must be written as [[{where}layers]]")
    if not layers and "base" not in tables:
        raise ValueError(
            f"there is neither a layer nor a base, must be at least one: [[{where}layers]] or [{where}base]"
        )
    stack = lj.Stack(
        [_build(f"{where}layers[{index}]", layer, _LAYERS) for index, layer in enumerate(layers)],
        base=_build(f"{where}base", tables["base"], _BASES) if "base" in tables else None,
    )
    require_single(stack, "a stack file")
    return stack


def material_from_dict(tables: Mapping[str, Any], where: str = "") -> lj.Stack | lj.Mixture:
    """A material of the gallery by its name, a mixture, or what `layers` and `base` say; where: see above."""
    for whole in ("gallery", "mixture"):
        if whole in tables and len(tables) > 1:
            others = " and ".join(key for key in MATERIAL if key != whole and key in tables)
            raise ValueError(f"{where}{whole} is a whole material, must stand without {others}")
    if "gallery" in tables:
        return gallery.stack(choice(f"{where}gallery", tables["gallery"], gallery.names()))
    return _mixture(f"{where}mixture", tables["mixture"]) if "mixture" in tables else stack_from_dict(tables, where)


def _mixture(where: str, table: Any) -> lj.Mixture:
    parts, weights = {}, {}
    for name, entries in require_table(where, table).items():
        place = f"{where}.{name}"
        check_keys(place, require_table(place, entries), ("weight", *MATERIAL))
        weight = entries.get("weight")
        read = _one_free if isinstance(weight, dict) else one_number
        weights[name] = None if weight is None else read(f"{place}.weight", weight, lj.RANGES["Mixture.weights"])
        parts[name] = material_from_dict({key: entries[key] for key in MATERIAL if key in entries}, f"{place}.")
    try:
        return lj.Mixture(parts, weights)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _settings(where: str, kind: type, table: Any) -> Any:
    """The `Noise`, `Instrument` or `Discrepancy` that a table describes."""
    hints = get_type_hints(kind)
    check_keys(where, require_table(where, table), tuple(hints))
    given = {}
    for key, value in table.items():
        place = f"{where}.{key}"
        if key != "discrepancy":
            given[key] = _value(place, value, hints[key], "")
        else:
            given[key] = value if isinstance(value, bool) else _settings(place, Discrepancy, value)
    try:
        return kind(**given)
    except ValueError as error:
        raise ValueError(str(error).replace("Noise.", "noise.").replace("Instrument.", "instrument.")) from None


def _one_free(where: str, table: Any, allowed: Range) -> Free:
    free = _free(where, table, allowed)
    if free.shape != ():
        raise ValueError(f"{where} has {free.shape[0]} channels, must be one number for all")
    return free


def transport_from_dict(value: Any) -> lj.Transport | Literal["auto"]:
    """The transport that a name, or a table with a `kind`, describes; "auto" for itself."""
    if value == "auto":
        return "auto"
    if isinstance(value, str):
        value = {"kind": choice("transport", value, ("auto", *_TRANSPORTS))}
    return cast(lj.Transport, _build("transport", value, _TRANSPORTS))


def _about(table: Any) -> dict[str, str]:
    for key, text in require_table("about", table).items():
        if not isinstance(text, str):
            raise ValueError(f"about[{in_short(key)}] is {in_short(text)}, must be a text")
    return dict(table)


# ---- values of tables ----


def _build(where: str, table: Any, kinds: _Kinds) -> Any:
    """The object that a table with a `kind` describes."""
    table = require_table(where, table)
    if "kind" not in table:
        raise ValueError(f"{where} has no kind, must be one of {', '.join(kinds)}")
    kind = kinds[choice(f"{where}.kind", table["kind"], kinds)]
    known = {_key(name): (name, parameter) for name, parameter in inspect.signature(kind).parameters.items()}
    check_keys(where, table, ("kind", *known))
    hints = get_type_hints(kind)
    given = {}
    distribution = table.get("distribution", "ggx")
    normals = f", {distribution}" if isinstance(distribution, str) and distribution != "ggx" else ""
    for key, (name, parameter) in known.items():
        if key in table:
            ranged = f"{kind.__name__}.{name}{normals if name == 'alpha' else ''}"
            given[name] = _value(f"{where}.{key}", table[key], hints[name], ranged)
        elif parameter.default is inspect.Parameter.empty:
            raise ValueError(f"{where} ({kind.__name__}) has no {key}")
    try:
        return kind(**given)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _value(where: str, value: Any, hint: Any, name: str) -> Any:
    """One parameter, read as what its type hint says."""
    if get_origin(hint) is Literal:
        return choice(where, value, get_args(hint))
    alternatives = [kind for kind in get_args(hint) if kind is not NoneType]
    if isinstance(hint, UnionType) and len(alternatives) == 1:  # an optional value
        (hint,) = alternatives
    if hint is bool:
        return truth(where, value)
    if hint is int:
        return whole_number(where, value)
    if hint is float:
        return one_number(where, value)
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        return numbers(where, value) if float in kinds else whole_numbers(where, value, len(kinds))
    if name.endswith(".phase"):
        return _build(where, value, _PHASES)
    if isinstance(value, dict) and "kind" in value:
        return _build(where, value, _LAWS)
    read = _free if isinstance(value, dict) else numbers
    return read(where, value, lj.RANGES.get(name, ANY))


def _free(where: str, table: Any, allowed: Range = ANY) -> Free:
    table = require_table(where, table)
    check_keys(where, table, _FREE_KEYS)
    for key in ("start", "low", "high"):
        if key not in table:
            raise ValueError(f"{where} has no {key}, a free parameter must have start, low and high")
    settings: dict[str, Any] = {}
    for key, value in table.items():
        place = f"{where}.{key}"
        if key == "prior":
            settings[key] = _build(place, value, _PRIORS)
        elif key == "same_for_all_texels":
            settings[key] = truth(place, value)
        else:
            settings[key] = numbers(place, value, ANY if key == "random_walk_sd" else allowed)
    try:
        return Free(**settings)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).replace('Free.', '')}") from None


def numbers(where: str, value: Any, allowed: Range = ANY) -> float | tuple[float, ...]:
    """One finite number, or a list of them, within the closed range `allowed`."""
    low, high = allowed
    wanted = "a finite number" if allowed == ANY else f"a number in [{low:g}, {high:g}]"
    given = value if isinstance(value, list) else [value]
    for number in given:
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ValueError(f"{where} is {in_short(number)}, must be {wanted}")
        # whole numbers may be beyond what float can hold
        if not (abs(number) <= sys.float_info.max and low <= number <= high):
            word = f"{number:g}" if isinstance(number, float) else in_short(number)
            raise ValueError(f"{where} is {word}, must be {wanted}")
    if not given:
        raise ValueError(f"{where} is an empty list, must be {wanted} or one a channel")
    return tuple(float(number) for number in given) if isinstance(value, list) else float(value)


def one_number(where: str, value: Any, allowed: Range = ANY) -> float:
    """One finite number within the closed range `allowed`."""
    number = numbers(where, value, allowed)
    if isinstance(number, tuple):
        raise ValueError(f"{where} is {in_short(value)}, must be one number")
    return number


def whole_number(where: str, value: Any) -> int:
    """A whole number of at most 32 bits; what it may be beyond that is for its owner to say."""
    if type(value) is not int or abs(value) > MOST:
        raise ValueError(f"{where} is {in_short(value)}, must be a whole number up to {MOST}")
    return value


def whole_numbers(where: str, value: Any, count: int) -> tuple[int, ...]:
    """A list of `count` whole numbers of at most 32 bits each, as a tuple; ValueError for anything else."""
    if not isinstance(value, list) or len(value) != count or any(type(number) is not int for number in value):
        raise ValueError(f"{where} is {in_short(value)}, must be a list of {count} whole numbers")
    return tuple(whole_number(f"{where}[{index}]", number) for index, number in enumerate(value))


def truth(where: str, value: Any) -> bool:
    """The value itself, if it is true or false; ValueError for anything else."""
    if not isinstance(value, bool):
        raise ValueError(f"{where} is {in_short(value)}, must be true or false")
    return value


def choice(where: str, value: Any, allowed: Iterable[str]) -> str:
    """The value itself, if it is one of the allowed words; ValueError, with a likely one, for anything else."""
    allowed = tuple(allowed)
    if not (isinstance(value, str) and value in allowed):
        raise ValueError(
            f"{where} is {in_short(value)}{_suggestion(value, allowed)}, must be one of {', '.join(allowed)}"
        )
    return value


def check_keys(where: str, table: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    """Raise a ValueError for a key of the table that is not among the allowed ones."""
    for key in table:
        if key not in allowed:
            raise ValueError(
                f"{where} has an unknown key {in_short(key)}{_suggestion(key, allowed)}; allowed: {', '.join(allowed)}"
            )


def require_table(where: str, table: Any) -> dict[str, Any]:
    """The value itself, if it is a table; ValueError for anything else."""
    if not isinstance(table, dict):
        raise ValueError(f"{where} is {in_short(table)}, must be a table")
    return table


def _suggestion(value: Any, allowed: Iterable[str]) -> str:
    close = difflib.get_close_matches(value, allowed, n=1) if isinstance(value, str) and len(value) < _LONGEST else []
    return f" (did you mean {close[0]!r}?)" if close else ""


# ---- to tables ----


def material_to_dict(stack: lj.Stack | lj.Mixture) -> dict[str, Any]:
    """The inverse of `material_from_dict`, of plain numbers, strings, lists and dictionaries."""
    if not isinstance(stack, lj.Mixture):
        return stack_to_dict(stack)
    weights = {name: {} if value is None else {"weight": to_plain(value)} for name, value in stack.weights.items()}
    return {"mixture": {name: weights[name] | material_to_dict(part) for name, part in stack.parts.items()}}


def stack_to_dict(stack: lj.Stack) -> dict[str, Any]:
    """The inverse of `stack_from_dict`."""
    tables: dict[str, Any] = {}
    if stack.layers:
        tables["layers"] = [_module_to_dict(layer) for layer in stack.layers]
    if stack.base is not None:
        tables["base"] = _module_to_dict(stack.base)
    return tables


def changed_to_dict(thing: Noise | Instrument | Discrepancy | Free) -> dict[str, Any]:
    """What is not as it is by default, of plain numbers, strings, lists and dictionaries."""
    every = {entry.name: (getattr(thing, entry.name), entry.default) for entry in fields(thing)}
    return {name: to_plain(value) for name, (value, default) in every.items() if value != default}


def transport_to_dict(transport: lj.Transport | Literal["auto"]) -> str | dict[str, Any]:
    """The inverse of `transport_from_dict`: a name where that says all."""
    if isinstance(transport, str):
        return transport
    table = _module_to_dict(transport)
    return table if len(table) > 1 else table["kind"]


def _module_to_dict(module: Any) -> dict[str, Any]:
    """The table of a layer, base, phase function, transport or prior; what is None is omitted."""
    names = inspect.signature(type(module)).parameters
    entries = {_key(name): to_plain(getattr(module, name)) for name in names if getattr(module, name) is not None}
    return {"kind": type(module).__name__, **entries}


def to_plain(value: Any) -> Any:
    if isinstance(value, Free):
        return changed_to_dict(value)
    if isinstance(value, str | bool | int):
        return value
    if isinstance(value, lj.PhaseFunction | Prior | PowerLaw):
        return _module_to_dict(value)
    if isinstance(value, Discrepancy):
        return changed_to_dict(value) or True
    array = np.asarray(value)
    if array.dtype.kind == "i":
        return array.tolist()
    # the shortest decimal that a float32 reads back from, not its digits in float64
    numbers = [float(str(number)) if array.dtype == np.float32 else float(number) for number in array.ravel()]
    return numbers if array.ndim else numbers[0]


def _key(name: str) -> str:
    return "shape" if name == "kind" else name  # SGGX.kind: `kind` names the class here
