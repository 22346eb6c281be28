"""Stacks and fitting problems as TOML: a table for each layer and the base, and a table where a number is free.

    transport = { kind = "AddingDoubling", nodes = 16 }

    [[layers]]                                 # from top to bottom
    kind = "Medium"
    thickness = { start = 0.5, low = 0.0, high = 5.0, prior = { kind = "Normal", mean = 0.5, sd = 0.2 } }
    phase = { kind = "SGGX", shape = "surface", alpha = 0.3 }

``docs/guides/own_data.md`` says what else may stand there. Keys are the parameters of the classes of the same name; the
`kind` of an SGGX is called `shape` here. Bad input is a ValueError on one line that names place and parameter.
"""

import difflib
import inspect
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, cast, get_args

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
from layerjax._checks import abbreviate, require_kind, require_number
from layerjax._shapes import require_single
from layerjax.mixture import require_material

ANY = (-math.inf, math.inf)
_LONGEST = 60  # letters of a key that an error suggests others for

MATERIAL = ("gallery", "layers", "base", "mixture")  # keys of a stack, or of what stands in its place

_Kinds = Mapping[str, type]
_LAYERS: _Kinds = {kind.__name__: kind for kind in (lj.Interface, lj.Medium, lj.TurbidMedium)}
_BASES: _Kinds = {kind.__name__: kind for kind in (lj.Lambertian, lj.OrenNayar, lj.VMFDiffuse, lj.Conductor)}
_TRANSPORTS: _Kinds = {
    name: kind
    for name, kind in vars(lj).items()
    if inspect.isclass(kind) and issubclass(kind, lj.Transport) and not inspect.isabstract(kind)
}
_PARTS: Mapping[str, _Kinds] = {
    "phase": {kind.__name__: kind for kind in (lj.HenyeyGreenstein, lj.Rayleigh, lj.SGGX)},
    "prior": {kind.__name__: kind for kind in (Uniform, LogUniform, Normal, LogNormal)},
}
_LAWS: _Kinds = {"PowerLaw": PowerLaw}


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """What a TOML file says: the arguments of `fits.fit` other than the data, what it says of itself, and the text."""

    stack: lj.Stack | lj.Mixture
    transport: lj.Transport | Literal["auto"]
    noise: Noise
    scale: float | Free | None
    objective: Objective
    instrument: Instrument | None
    options: Mapping[str, Any]
    about: Mapping[str, Any]
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
            noise=_make("noise", Noise, tables.get("noise", {})),
            scale=_number("scale", tables["scale"], LEVELS) if "scale" in tables else None,
            objective=cast(Objective, choice("objective", tables.get("objective", "likelihood"), get_args(Objective))),
            instrument=_make("instrument", Instrument, tables["instrument"]) if "instrument" in tables else None,
            options=require_table("options", tables.get("options", {})),
            about=require_table("about", tables.get("about", {})),
            text=text,
        )
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_instrument(path: str | Path) -> Instrument:
    """The ``[instrument]`` of a TOML file, whatever else it holds. ValueError as of `read_problem`, or without one."""
    _, tables = read_tables(Path(path))
    try:
        if "instrument" not in tables:
            raise ValueError("there is no [instrument]")
        return cast(Instrument, _make("instrument", Instrument, tables["instrument"]))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_problem(
    path: str | Path,
    stack: lj.Stack | lj.Mixture,
    *,
    transport: lj.Transport | Literal["auto"] = "auto",
    noise: Noise | None = None,
    scale: float | Free | None = None,
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
    require_kind("noise", noise, Noise, None)
    if not (scale is None or isinstance(scale, Free)):
        require_number("scale", scale, 0.0, open_ends=True)
    require_kind("instrument", instrument, Instrument, None)
    choice("objective", objective, get_args(Objective))
    tables = {"transport": transport_to_dict(transport), "objective": objective}
    tables = {name: value for name, value in tables.items() if value not in ("auto", "likelihood")}
    tables |= material_to_dict(stack)
    material_from_dict(material_to_dict(stack))  # refuses what could not be read again
    transport_from_dict(transport_to_dict(transport))
    given = {"noise": noise, "instrument": instrument, "scale": scale}
    tables |= {name: _to_plain(value) for name, value in given.items() if value is not None}
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
    """The stack that `layers` and `base` of a file say, at a place (``mixture.bare.``) or at its top."""
    check_keys(where.rstrip(".") or "the stack", tables, ("layers", "base"))
    layers = tables.get("layers", [])
    if not isinstance(layers, list):
        raise ValueError(f"{where}layers is not a list of tables, must be written as [[{where}layers]]")
    if not layers and "base" not in tables:
        words = f"must be at least one: [[{where}layers]] or [{where}base]"
        raise ValueError(f"there is neither a layer nor a base, {words}")
    stack = lj.Stack(
        [_build(f"{where}layers[{index}]", layer, _LAYERS) for index, layer in enumerate(layers)],
        base=_build(f"{where}base", tables["base"], _BASES) if "base" in tables else None,
    )
    require_single(stack, "a stack file")
    return stack


def material_from_dict(tables: Mapping[str, Any], where: str = "") -> lj.Stack | lj.Mixture:
    """A material of the gallery by its name, a mixture, or what `layers` and `base` say."""
    for whole in ("gallery", "mixture"):
        if whole in tables and len(tables) > 1:
            others = " and ".join(key for key in MATERIAL if key != whole and key in tables)
            raise ValueError(f"{where}{whole} is a whole material, must stand without {others}")
    if "gallery" in tables:
        return gallery.stack(choice(f"{where}gallery", tables["gallery"], gallery.names()))
    if "mixture" not in tables:
        return stack_from_dict(tables, where)
    where, parts, weights = f"{where}mixture", {}, {}
    for name, entries in require_table(where, tables["mixture"]).items():
        place = f"{where}.{name}"
        check_keys(place, require_table(place, entries), ("weight", *MATERIAL))
        weight = entries.get("weight")
        weights[name] = None if weight is None else _number(f"{place}.weight", weight, lj.RANGES["Mixture.weights"])
        parts[name] = material_from_dict({key: entries[key] for key in MATERIAL if key in entries}, f"{place}.")
    try:
        return lj.Mixture(parts, weights)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def transport_from_dict(value: Any) -> lj.Transport | Literal["auto"]:
    """The transport that a name, or a table with a `kind`, describes; "auto" for itself."""
    if value == "auto":
        return "auto"
    if isinstance(value, str):
        value = {"kind": choice("transport", value, ("auto", *_TRANSPORTS))}
    return cast(lj.Transport, _build("transport", value, _TRANSPORTS))


def _build(where: str, table: Any, kinds: _Kinds) -> Any:
    """The object that a table with a `kind` describes."""
    if "kind" not in require_table(where, table):
        raise ValueError(f"{where} has no kind, must be one of {', '.join(kinds)}")
    kind = kinds[choice(f"{where}.kind", table["kind"], kinds)]
    numbers = {key: value for key, value in table.items() if key != "kind"}
    if kind not in (lj.Interface, lj.Conductor):
        return _make(where, kind, numbers)
    check_keys(where, numbers, (*inspect.signature(kind).parameters, "smooth"))
    return _make(where, kind, _read_roughness(where, numbers))


def _read_roughness(where: str, table: dict[str, Any]) -> dict[str, Any]:
    """A file says of every interface and metal how rough it is, or that it is smooth: none is by mistake."""
    smooth = table.pop("smooth", False)
    if not isinstance(smooth, bool):
        raise ValueError(f"{where}.smooth: {smooth!r:.60} is neither true nor false")
    if smooth and "alpha" in table:
        raise ValueError(f"{where}.smooth: true, and alpha given as well: must be one of them")
    if not smooth and "alpha" not in table:
        raise ValueError(f"{where} has no alpha, must have it or smooth = true")
    return table


def _make(where: str, kind: type, table: Any) -> Any:
    """The object of this class that a table of its parameters describes; the class itself says what may stand there."""
    known = {_key(name): parameter for name, parameter in inspect.signature(kind).parameters.items()}
    check_keys(where, require_table(where, table), tuple(known))
    for key, parameter in known.items():
        if parameter.default is inspect.Parameter.empty and key not in table:
            raise ValueError(f"{where} has no {key}, which {kind.__name__} needs")
    given = {known[key].name: _value(f"{where}.{key}", key, value) for key, value in table.items()}
    normals = f", {given['distribution']}" if given.get("distribution", "ggx") != "ggx" else ""
    for name, value in given.items():
        if isinstance(value, Free):
            ranged = f"{kind.__name__}.{name}{normals if name == 'alpha' else ''}"
            _require_bounds(f"{where}.{_key(name)}", value, lj.RANGES.get(ranged, ANY))
    try:
        return kind(**given)
    except (ValueError, TypeError, OverflowError) as error:
        words = f"{error!s:.300}".replace("SGGX.kind", "SGGX.shape").replace("Free.", "")
        words = words.replace("Noise.", "noise.").replace("Instrument.", "instrument.")
        raise ValueError(words if words.startswith(f"{where}.") else f"{where}: {words}") from None


def _value(where: str, key: str, value: Any) -> Any:
    """What stands at a key: a number, a word, a list, a part with a `kind`, or something that is free."""
    if isinstance(value, dict):
        if key == "film":
            return _make(where, lj.ThinFilm, value)
        if key in _PARTS or "kind" in value:
            return _build(where, value, _PARTS.get(key, _LAWS))
        return _make(where, Discrepancy if key == "discrepancy" else Free, value)
    return tuple(value) if isinstance(value, list) else value


def _number(where: str, value: Any, allowed: tuple[float, float]) -> Any:
    """One number, or one that is free."""
    if not isinstance(value, dict):
        require_number(where, value, *allowed)
        return value
    free = _make(where, Free, value)
    if free.shape != ():
        raise ValueError(f"{where} has {free.shape[0]} channels, must be one number for all")
    _require_bounds(where, free, allowed)
    return free


def _require_bounds(where: str, free: Free, allowed: tuple[float, float]) -> None:
    low, high = allowed
    for name, one in zip(("start", "low", "high"), free.arrays(), strict=True):
        if np.any((one < low) | (one > high)):
            raise ValueError(f"{where}.{name} is {abbreviate(one.tolist())}, must be a number in [{low:g}, {high:g}]")


def choice(where: str, value: Any, allowed: Iterable[str]) -> str:
    """The value itself, if it is one of the allowed words; ValueError, with a likely one, for anything else."""
    allowed = tuple(allowed)
    if not (isinstance(value, str) and value in allowed):
        given = f"{abbreviate(value)}{_suggestion(value, allowed)}"
        raise ValueError(f"{where} is {given}, must be one of {', '.join(allowed)}")
    return value


def check_keys(where: str, table: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    """Raise a ValueError for a key of the table that is not among the allowed ones."""
    for key in table:
        if key not in allowed:
            given = f"{abbreviate(key)}{_suggestion(key, allowed)}"
            raise ValueError(f"{where} has an unknown key {given}; allowed: {', '.join(allowed)}")


def require_table(where: str, table: Any) -> dict[str, Any]:
    """The value itself, if it is a table; ValueError for anything else."""
    if not isinstance(table, dict):
        raise ValueError(f"{where} is {abbreviate(table)}, must be a table")
    return table


def _suggestion(value: Any, allowed: Iterable[str]) -> str:
    close = difflib.get_close_matches(value, allowed, n=1) if isinstance(value, str) and len(value) < _LONGEST else []
    return f" (did you mean {close[0]!r}?)" if close else ""


# ---- to tables ----


def material_to_dict(material: lj.Stack | lj.Mixture) -> dict[str, Any]:
    """The inverse of `material_from_dict`, of plain numbers, strings, lists and dictionaries."""
    if isinstance(material, lj.Mixture):
        weights = {name: {"weight": _to_plain(one)} for name, one in material.weights.items() if one is not None}
        parts = {name: material_to_dict(part) for name, part in material.parts.items()}
        return {"mixture": {name: weights.get(name, {}) | part for name, part in parts.items()}}
    tables: dict[str, Any] = {"layers": list(map(_module_to_dict, material.layers))} if material.layers else {}
    return tables if material.base is None else tables | {"base": _module_to_dict(material.base)}


def transport_to_dict(transport: lj.Transport | Literal["auto"]) -> str | dict[str, Any]:
    """The inverse of `transport_from_dict`: a name where that says all."""
    if isinstance(transport, str):
        return transport
    table = _module_to_dict(transport)
    return table if len(table) > 1 else table["kind"]


def _module_to_dict(module: Any) -> dict[str, Any]:
    """The table of a layer, base, phase function, transport or prior; what is None is omitted."""
    names = inspect.signature(type(module)).parameters
    entries = {_key(name): _to_plain(getattr(module, name)) for name in names if getattr(module, name) is not None}
    if isinstance(module, lj.Interface | lj.Conductor) and module.is_smooth:
        entries["smooth"] = True
    return {"kind": type(module).__name__, **entries}


def _to_plain(value: Any) -> Any:
    if isinstance(value, str | bool | int):
        return value
    if isinstance(value, Free | Noise | Instrument | Discrepancy):  # what is not as it is by default
        every = {entry.name: (getattr(value, entry.name), entry.default) for entry in fields(value)}
        changed = {name: _to_plain(one) for name, (one, default) in every.items() if one != default}
        return changed or (True if isinstance(value, Discrepancy) else {})
    if isinstance(value, lj.PhaseFunction | Prior | PowerLaw):
        return _module_to_dict(value)
    if isinstance(value, lj.ThinFilm):
        return {field.name: _to_plain(getattr(value, field.name)) for field in fields(value)}
    array = np.asarray(value)
    if array.dtype.kind == "i":
        return array.tolist()
    # the shortest decimal that a float32 reads back from, not its digits in float64
    numbers = [float(str(number)) if array.dtype == np.float32 else float(number) for number in array.ravel()]
    return numbers if array.ndim else numbers[0]


def _key(name: str) -> str:
    return "shape" if name == "kind" else name  # SGGX.kind: `kind` names the class here
