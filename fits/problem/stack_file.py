"""Stacks and fitting problems as TOML: a table for each layer and the base, and a table where a number is free.

    transport = "SingleScattering"             # optional, "auto" if left out; { kind = "AddingDoubling", nodes = 16 }
    objective = "likelihood"                   # optional
    about = { source = "..." }                 # optional: a table of texts that are kept and not looked at
    gallery = "fabric"                         # optional: a material by name, in place of layers and base

    [[layers]]                                 # from top to bottom
    kind = "Medium"
    thickness = { start = 0.5, low = 0.0, high = 5.0, prior = { kind = "Normal", mean = 0.5, sd = 0.2 } }
    phase = { kind = "SGGX", shape = "surface", alpha = 0.3 }

    [base]
    kind = "Lambertian"
    albedo = [0.1, 0.2, 0.3]                   # one number, or one a channel

    [noise]                                    # optional: relative, floor, use_sigma, tails, degrees_of_freedom,
                                               # correlated: true, or a table of its amplitude and lengths
    [scale]                                    # optional common calibration factor: start, low, high, prior

Keys are the parameters of the classes of the same name; the `kind` of an SGGX is called `shape` here. Bad input is a
ValueError on one line that names the place (``layers[0].thickness``), what stands there and what may.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np
import tomli_w

import layerjax as lj
from fits._files import write_text
from fits.problem.correlated import Correlated
from fits.problem.likelihood import LEVELS, Noise, Objective
from fits.problem.parameters import Free, LogNormal, LogUniform, Normal, Prior, Uniform
from fits.problem.values import (
    ANY,
    Range,
    check_keys,
    choice,
    numbers,
    one_number,
    read_tables,
    require_table,
    shown,
    truth,
    whole_number,
    whole_numbers,
)
from layerjax import gallery
from layerjax._shapes import require_single

_Kinds = Mapping[str, type]
_LAYERS: _Kinds = {kind.__name__: kind for kind in (lj.Interface, lj.Medium)}
_BASES: _Kinds = {kind.__name__: kind for kind in (lj.Lambertian, lj.OrenNayar, lj.VMFDiffuse, lj.Conductor)}
_PHASES: _Kinds = {kind.__name__: kind for kind in (lj.HenyeyGreenstein, lj.Rayleigh, lj.SGGX)}
_TRANSPORTS: _Kinds = {
    name: kind
    for name, kind in vars(lj).items()
    if inspect.isclass(kind) and issubclass(kind, lj.Transport) and not inspect.isabstract(kind)
}
_PRIORS: _Kinds = {kind.__name__: kind for kind in (Uniform, LogUniform, Normal, LogNormal)}
SHARED = "correlated"
_FREE_KEYS = ("start", "low", "high", "prior")


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """What a TOML file says: the arguments of `fits.fit` other than the data, what it says of itself, and the text."""

    stack: lj.Stack
    transport: lj.Transport | Literal["auto"]
    noise: Noise
    scale: Free | None
    objective: Objective
    about: Mapping[str, str]
    text: str


def read_problem(path: str | Path) -> ProblemFile:
    """Read a stack, and what else the TOML file says about fitting it.

    Raises:
        ValueError: on one line, which names the file, the place in it and what may stand there.
    """
    path = Path(path)
    text, tables = read_tables(path)
    try:
        known = ("about", "transport", "objective", "gallery", "layers", "base", "noise", "scale")
        check_keys("the file", tables, known)
        return ProblemFile(
            stack=_stack({key: tables[key] for key in ("gallery", "layers", "base") if key in tables}),
            transport=transport_from_dict(tables.get("transport", "auto")),
            noise=_noise(tables.get("noise", {})),
            scale=_scale(tables["scale"]) if "scale" in tables else None,
            objective=cast(Objective, choice("objective", tables.get("objective", "likelihood"), get_args(Objective))),
            about=_about(tables.get("about", {})),
            text=text,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def write_problem(
    path: str | Path,
    stack: lj.Stack,
    *,
    transport: lj.Transport | Literal["auto"] = "auto",
    noise: Noise | None = None,
    scale: Free | None = None,
    objective: Objective = "likelihood",
    force: bool = False,
) -> None:
    """Write a TOML file that `read_problem` reads back to the same.

    Args:
        path: the file.
        stack: may hold `Free`.
        transport, noise, scale, objective: see `Problem`; what is left out of the call is left out of the file.
        force: replace a file that is there.

    Raises:
        ValueError: the file exists and `force` is False; or a part is of a class of one's own, which no file names.
    """
    _require_known(stack, transport)
    tables: dict[str, Any] = {}
    if not isinstance(transport, str):
        tables["transport"] = transport_to_dict(transport)
    if objective != "likelihood":
        tables["objective"] = objective
    tables |= stack_to_dict(stack)
    if noise is not None:
        tables["noise"] = {
            entry.name: _to_plain(getattr(noise, entry.name))
            for entry in fields(noise)
            if getattr(noise, entry.name) != entry.default
        }
    if scale is not None:
        tables["scale"] = _to_plain(scale)
    write_text(path, tomli_w.dumps(tables), force)


def _require_known(stack: lj.Stack, transport: lj.Transport | str) -> None:
    """Refuse what `read_problem` could not make again."""
    parts: list[tuple[str, Any, _Kinds]] = []
    for index, layer in enumerate(stack.layers):
        parts.append((f"layers[{index}]", layer, _LAYERS))
        if isinstance(layer, lj.Medium):
            parts.append((f"layers[{index}].phase", layer.phase, _PHASES))
    if stack.base is not None:
        parts.append(("base", stack.base, _BASES))
    if not isinstance(transport, str):
        parts.append(("transport", transport, _TRANSPORTS))
    for where, part, kinds in parts:
        if type(part) not in kinds.values():
            raise ValueError(f"{where}.kind is {shown(type(part).__name__)}, must be one of {', '.join(kinds)}")


def stack_from_dict(tables: Mapping[str, Any]) -> lj.Stack:
    """A stack, with `Free` parameters where a number is given as a table, from the `layers` and `base` of a file."""
    check_keys("the stack", tables, ("layers", "base"))
    layers = tables.get("layers", [])
    if not isinstance(layers, list):
        raise ValueError("layers is not a list of tables, must be written as [[layers]]")
    if not layers and "base" not in tables:
        raise ValueError("there is neither a layer nor a base, must be at least one: [[layers]] or [base]")
    stack = lj.Stack(
        [_build(f"layers[{index}]", layer, _LAYERS) for index, layer in enumerate(layers)],
        base=_build("base", tables["base"], _BASES) if "base" in tables else None,
    )
    require_single(stack, "a stack file")
    return stack


def _stack(tables: Mapping[str, Any]) -> lj.Stack:
    """A material of the gallery by its name, or what `layers` and `base` say."""
    if "gallery" not in tables:
        return stack_from_dict(tables)
    if len(tables) > 1:
        raise ValueError("gallery names a whole stack, must stand without layers and base")
    return gallery.stack(choice("gallery", tables["gallery"], gallery.names()))


def stack_to_dict(stack: lj.Stack) -> dict[str, Any]:
    """The inverse of `stack_from_dict`, of plain numbers, strings, lists and dictionaries."""
    tables: dict[str, Any] = {}
    if stack.layers:
        tables["layers"] = [_module_to_dict(layer) for layer in stack.layers]
    if stack.base is not None:
        tables["base"] = _module_to_dict(stack.base)
    return tables


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
    if isinstance(hint, UnionType) and len(alternatives) == 1:  # an option that may be left out
        (hint,) = alternatives
    if hint is bool:
        return truth(where, value)
    if hint is int:
        return whole_number(where, value)
    if hint is float:
        return one_number(where, value)
    if get_origin(hint) is tuple:
        return whole_numbers(where, value, len(get_args(hint)))
    if name.endswith(".phase"):
        return _build(where, value, _PHASES)
    return _number_or_free(where, value, lj.RANGES.get(name, ANY))


def _number_or_free(where: str, value: Any, allowed: Range) -> float | tuple[float, ...] | Free:
    return _free(where, value, allowed) if isinstance(value, dict) else numbers(where, value, allowed)


def _free(where: str, table: Any, allowed: Range = ANY) -> Free:
    table = require_table(where, table)
    check_keys(where, table, _FREE_KEYS)
    for key in ("start", "low", "high"):
        if key not in table:
            raise ValueError(f"{where} has no {key}, a free parameter must have start, low and high")
    bounds = {key: numbers(f"{where}.{key}", table[key], allowed) for key in ("start", "low", "high")}
    prior = cast(Prior, _build(f"{where}.prior", table["prior"], _PRIORS)) if "prior" in table else None
    try:
        return Free(**bounds, prior=prior)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).replace('Free.', '')}") from None


def _noise(table: Any) -> Noise:
    table = require_table("noise", table)
    hints = get_type_hints(Noise)
    check_keys("noise", table, tuple(entry.name for entry in fields(Noise)))
    try:
        given: dict[str, Any] = {
            key: _correlated(value) if key == SHARED else _value(f"noise.{key}", value, hints[key], f"Noise.{key}")
            for key, value in table.items()
        }
        return Noise(**given)
    except ValueError as error:
        raise ValueError(str(error).replace("Noise.", "noise.")) from None


def _correlated(value: Any) -> Correlated | bool:
    where = f"noise.{SHARED}"
    if isinstance(value, bool):
        return value
    names = tuple(entry.name for entry in fields(Correlated))
    check_keys(where, require_table(where, value), names)
    given: dict[str, Any] = {key: _number_or_free(f"{where}.{key}", entry, ANY) for key, entry in value.items()}
    return Correlated(**given)


def _about(table: Any) -> dict[str, str]:
    for key, text in require_table("about", table).items():
        if not isinstance(text, str):
            raise ValueError(f"about[{shown(key)}] is {shown(text)}, must be a text")
    return dict(table)


def _scale(table: Any) -> Free:
    scale = _free("scale", table, LEVELS)
    if scale.shape != ():
        raise ValueError(f"scale has {scale.shape[0]} channels, must be one number for all")
    return scale


def transport_from_dict(value: Any) -> lj.Transport | Literal["auto"]:
    """The transport that a name, or a table with a `kind`, describes; "auto" for itself."""
    if value == "auto":
        return "auto"
    if isinstance(value, str):
        value = {"kind": choice("transport", value, ("auto", *_TRANSPORTS))}
    return cast(lj.Transport, _build("transport", value, _TRANSPORTS))


def transport_to_dict(transport: lj.Transport | Literal["auto"]) -> str | dict[str, Any]:
    """The inverse of `transport_from_dict`: a name where that says all."""
    if isinstance(transport, str):
        return transport
    table = _module_to_dict(transport)
    return table if len(table) > 1 else table["kind"]


def _module_to_dict(module: Any) -> dict[str, Any]:
    """The table of a layer, base, phase function, transport or prior; what is None is left out."""
    names = inspect.signature(type(module)).parameters
    entries = {_key(name): _to_plain(getattr(module, name)) for name in names if getattr(module, name) is not None}
    return {"kind": type(module).__name__, **entries}


def _to_plain(value: Any) -> Any:
    if isinstance(value, Free):
        table = {key: _to_plain(getattr(value, key)) for key in _FREE_KEYS}
        return {key: entry for key, entry in table.items() if value.prior != Uniform() or key != "prior"}
    if isinstance(value, str | bool | int):
        return value
    if isinstance(value, lj.PhaseFunction | Prior):
        return _module_to_dict(value)
    if isinstance(value, Correlated):
        table = {entry.name: getattr(value, entry.name) for entry in fields(value)}
        return {name: _to_plain(entry) for name, entry in table.items() if entry is not None} or True
    array = np.asarray(value)
    if array.dtype.kind == "i":
        return array.tolist()
    # the shortest decimal that a float32 reads back from, not its digits in float64
    numbers = [float(str(number)) if array.dtype == np.float32 else float(number) for number in array.ravel()]
    return numbers if array.ndim else numbers[0]


def _key(name: str) -> str:
    return "shape" if name == "kind" else name  # SGGX.kind: `kind` names the class here
