"""fits: recover the parameters of a layered material, with their uncertainty, from BRDF measurements.

Names are imported when they are first used: `import fits` loads neither arviz, matplotlib nor a solver. They are those
of the stub `__init__.pyi` beside this file, which editors and type checkers read as well.
"""

import ast
import importlib
from pathlib import Path
from typing import Any

_HOMES = {
    alias.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
}
"""The module of each public name."""

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
