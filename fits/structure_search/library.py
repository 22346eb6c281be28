"""Layers and bases that stacks are put together from, each with the ranges of its free parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import layerjax as lj
from fits.problem.parameters import Free, LogUniform
from fits.problem.stack_file import check_keys, read_tables, require_table, stack_from_dict

Structure = tuple[str, ...]
"""Names of layers from top to bottom, and of the base."""


@dataclass(frozen=True)
class Library:
    """Layers and bases by name; a base is a surface, or a stack of its own that lets no light pass.

    Raises:
        ValueError: no base, a name that is used twice, or one that would be no name of a file, or that of another part:
            with a slash, a + or a dot in front, or the same but for case, blanks and hyphens.
    """

    layers: Mapping[str, lj.Interface | lj.Medium]
    bases: Mapping[str, lj.Stack]

    def __post_init__(self) -> None:
        for kind, parts in (("base", self.bases), ("layer", self.layers)):
            if not parts:
                raise ValueError(f"library: it has no {kind}; it must have at least one")
        files: dict[str, str] = {}
        for name in (*self.layers, *self.bases):
            if not name or any(sign in name for sign in "/\\+") or name.startswith("."):
                raise ValueError(f"library: {name!r} is no name; it must have no slash, no + and no dot in front")
            other = files.setdefault(name.replace(" ", "-").casefold(), name)
            if other != name:
                raise ValueError(f"library: {other!r} and {name!r} are one name as files; they must differ by letters")
        if twice := sorted(set(self.layers) & set(self.bases)):
            raise ValueError(f"library: {twice[0]!r} names a layer and a base")

    def stack(self, structure: Structure) -> lj.Stack:
        """The stack with these layers over this base."""
        base = self.bases[structure[-1]]
        return lj.Stack([*(self.layers[name] for name in structure[:-1]), *base.layers], base.base)


def default_library(channels: int = 1) -> Library:
    """Interfaces, haze, particles and flakes over diffuse, rough diffuse and metallic bases and deep pigment.

    channels: of the data; what has a colour has a value for each.
    """

    def coloured(start: float, low: float, high: float) -> Free:
        if channels == 1:
            return Free(start, low, high)
        return Free((start,) * channels, (low,) * channels, (high,) * channels)

    def thickness(start: float, low: float, high: float) -> Free:
        return Free(start, low, high, LogUniform())

    alpha = Free(0.3, 0.02, 1.0)
    pigment = lj.Medium(50.0, coloured(0.5, 0.0, 1.0), lj.HenyeyGreenstein(Free(0.0, -0.9, 0.9)))
    index = Free(1.5, 0.05, 9.0, LogUniform())
    return Library(
        layers={
            "interface": lj.Interface(Free(1.5, 1.01, 3.0), alpha),
            "haze": lj.Medium(thickness(0.1, 1e-3, 5.0), 1.0, lj.HenyeyGreenstein(Free(0.3, -0.6, 0.9))),
            "particles": lj.Medium(
                thickness(0.5, 0.01, 20.0), coloured(0.9, 0.0, 1.0), lj.HenyeyGreenstein(Free(0.5, -0.9, 0.9))
            ),
            "flakes": lj.Medium(
                thickness(0.5, 0.01, 20.0),
                f0=Free(0.03, 1e-3, 0.3, LogUniform()),
                phase=lj.SGGX("surface", alpha),
            ),
        },
        bases={
            "diffuse": lj.Stack([], lj.Lambertian(coloured(0.2, 0.0, 1.0))),
            "rough diffuse": lj.Stack([], lj.OrenNayar(coloured(0.2, 0.0, 1.0), Free(0.5, 0.0, 1.0))),
            "metal": lj.Stack([], lj.Conductor(index, Free(0.5, 0.01, 9.0, LogUniform()), alpha)),
            "pigment": lj.Stack([pigment]),
        },
    )


def read_library(path: str | Path) -> Library:
    """A library from a TOML file: tables ``[layers.NAME]`` and ``[bases.NAME]``, as layers and bases stand in a stack
    file; of a base of several layers ``[[bases.NAME.layers]]`` and ``[bases.NAME.base]``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file and the place in it.
    """
    path = Path(path)
    _, tables = read_tables(path)
    try:
        check_keys("the file", tables, ("layers", "bases"))
        layers = require_table("layers", tables.get("layers", {}))
        bases = require_table("bases", tables.get("bases", {}))
        return Library(
            layers={name: _part(f"layers.{name}", {"layers": [table]}).layers[0] for name, table in layers.items()},
            bases={name: _part(f"bases.{name}", _whole(table)) for name, table in bases.items()},
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _whole(table: Any) -> Any:
    """The table of a base as that of a stack."""
    return table if isinstance(table, dict) and {"layers", "base"} & set(table) else {"base": table}


def _part(where: str, table: Any) -> lj.Stack:
    try:
        return stack_from_dict(table)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
