"""Stacks, mixtures of them, transports and noise as tables of TOML, and back: see `fits.problem.stack_file`."""

import inspect
from collections.abc import Mapping
from dataclasses import fields
from types import NoneType, UnionType
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np

import layerjax as lj
from fits.problem.discrepancy.parameters import Discrepancy
from fits.problem.instrument import Instrument
from fits.problem.noise import LEVELS, Noise
from fits.problem.parameters import Free, LogNormal, LogUniform, Normal, Prior, Uniform
from fits.problem.spectra import PowerLaw
from fits.problem.values import (
    ANY,
    Range,
    check_keys,
    choice,
    numbers,
    one_number,
    require_table,
    shown,
    truth,
    whole_number,
    whole_numbers,
)
from layerjax import gallery
from layerjax._shapes import require_single

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
SHARED = "discrepancy"
_FREE_KEYS = ("start", "low", "high", "prior", "random_walk_sd", "same_for_all_texels")


MATERIAL = ("gallery", "layers", "base", "mixture")
"""Keys of a material: of a stack, or what stands in its place."""


def require_known(stack: lj.Stack | lj.Mixture, transport: lj.Transport | str) -> None:
    """Refuse what `read_problem` could not make again."""
    parts = _parts("", stack)
    if not isinstance(transport, str):
        parts.append(("transport", transport, _TRANSPORTS))
    for where, part, kinds in parts:
        if type(part) not in kinds.values():
            raise ValueError(f"{where}.kind is {shown(type(part).__name__)}, must be one of {', '.join(kinds)}")


def _parts(where: str, stack: lj.Stack | lj.Mixture) -> list[tuple[str, Any, _Kinds]]:
    """Layers, phase functions and bases, where they stand and what they may be."""
    if isinstance(stack, lj.Mixture):
        return [one for name, part in stack.parts.items() for one in _parts(f"{where}mixture.{name}.", part)]
    parts: list[tuple[str, Any, _Kinds]] = []
    for index, layer in enumerate(stack.layers):
        parts.append((f"{where}layers[{index}]", layer, _LAYERS))
        if isinstance(layer, lj.Medium | lj.TurbidMedium):
            parts.append((f"{where}layers[{index}].phase", layer.phase, _PHASES))
    if stack.base is not None:
        parts.append((f"{where}base", stack.base, _BASES))
    return parts


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
        weights[name] = _weight(f"{place}.weight", entries["weight"]) if "weight" in entries else None
        parts[name] = material_from_dict({key: entries[key] for key in MATERIAL if key in entries}, f"{place}.")
    try:
        return lj.Mixture(parts, weights)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _weight(where: str, value: Any) -> float | Free:
    allowed = lj.RANGES["Mixture.weights"]
    if not isinstance(value, dict):
        return one_number(where, value, allowed)
    free = _free(where, value, allowed)
    if free.shape != ():
        raise ValueError(f"{where} has {free.shape[0]} channels, must be one number for all")
    return free


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
    return _number_or_free(where, value, lj.RANGES.get(name, ANY))


def _number_or_free(where: str, value: Any, allowed: Range) -> float | tuple[float, ...] | Free | PowerLaw:
    if isinstance(value, dict) and "kind" in value:
        return cast(PowerLaw, _build(where, value, _LAWS))
    return _free(where, value, allowed) if isinstance(value, dict) else numbers(where, value, allowed)


def _free(where: str, table: Any, allowed: Range = ANY) -> Free:
    table = require_table(where, table)
    check_keys(where, table, _FREE_KEYS)
    for key in ("start", "low", "high"):
        if key not in table:
            raise ValueError(f"{where} has no {key}, a free parameter must have start, low and high")
    bounds = {key: numbers(f"{where}.{key}", table[key], allowed) for key in ("start", "low", "high")}
    prior = cast(Prior, _build(f"{where}.prior", table["prior"], _PRIORS)) if "prior" in table else None
    steps = numbers(f"{where}.random_walk_sd", table["random_walk_sd"], ANY) if "random_walk_sd" in table else None
    same = truth(f"{where}.same_for_all_texels", table.get("same_for_all_texels", False))
    try:
        return Free(**bounds, prior=prior, random_walk_sd=steps, same_for_all_texels=same)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).replace('Free.', '')}") from None


def noise_from_dict(table: Any) -> Noise:
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


def _correlated(value: Any) -> Discrepancy | bool:
    where = f"noise.{SHARED}"
    if isinstance(value, bool):
        return value
    names = tuple(entry.name for entry in fields(Discrepancy))
    check_keys(where, require_table(where, value), names)
    given: dict[str, Any] = {key: _number_or_free(f"{where}.{key}", entry, ANY) for key, entry in value.items()}
    return Discrepancy(**given)


def instrument_from_dict(table: Any) -> Instrument:
    """An instrument, from the table of that name."""
    table = require_table("instrument", table)
    check_keys("instrument", table, tuple(entry.name for entry in fields(Instrument)))
    given: dict[str, Any] = {
        key: _free(f"instrument.{key}", value) if isinstance(value, dict) else one_number(f"instrument.{key}", value)
        for key, value in table.items()
        if key != "rings"
    }
    if "rings" in table:
        given["rings"] = whole_number("instrument.rings", table["rings"])
    try:
        return Instrument(**given)
    except ValueError as error:
        raise ValueError(str(error).replace("Instrument.", "instrument.")) from None


def changed_to_dict(thing: Noise | Instrument) -> dict[str, Any]:
    """What is not as it is by default, of plain numbers, strings, lists and dictionaries."""
    every = {entry.name: (getattr(thing, entry.name), entry.default) for entry in fields(thing)}
    return {name: to_plain(value) for name, (value, default) in every.items() if value != default}


def scale_from_dict(table: Any) -> Free:
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
    """The table of a layer, base, phase function, transport or prior; what is None is omitted."""
    names = inspect.signature(type(module)).parameters
    entries = {_key(name): to_plain(getattr(module, name)) for name in names if getattr(module, name) is not None}
    return {"kind": type(module).__name__, **entries}


def to_plain(value: Any) -> Any:
    if isinstance(value, Free):
        table = {key: getattr(value, key) for key in _FREE_KEYS}
        left_out = {"prior": Uniform(), "random_walk_sd": None, "same_for_all_texels": False}
        return {key: to_plain(entry) for key, entry in table.items() if key not in left_out or entry != left_out[key]}
    if isinstance(value, str | bool | int):
        return value
    if isinstance(value, lj.PhaseFunction | Prior | PowerLaw):
        return _module_to_dict(value)
    if isinstance(value, Discrepancy):
        table = {entry.name: getattr(value, entry.name) for entry in fields(value)}
        return {name: to_plain(entry) for name, entry in table.items() if entry is not None} or True
    array = np.asarray(value)
    if array.dtype.kind == "i":
        return array.tolist()
    # the shortest decimal that a float32 reads back from, not its digits in float64
    numbers = [float(str(number)) if array.dtype == np.float32 else float(number) for number in array.ravel()]
    return numbers if array.ndim else numbers[0]


def _key(name: str) -> str:
    return "shape" if name == "kind" else name  # SGGX.kind: `kind` names the class here
