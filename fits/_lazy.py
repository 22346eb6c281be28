"""Lazy imports: names of a package are imported on first use, so that importing the package costs nothing."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def names_from(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package; homes: the module of the package that defines each name."""

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)

    return attribute


def directory_of(package: str, homes: Mapping[str, str]) -> Callable[[], list[str]]:
    """The `__dir__` of a package: those names as well, so that they complete before they are imported."""
    return lambda: sorted({*vars(sys.modules[package]), *homes})


def shown_by(function: str, result: Any) -> Any:
    """Call a function of a higher room, such as ``"fits.reports.html:fit_fragment"``, with a result.

    A result refers to it by name, as rooms import downward, and a result that is not displayed imports nothing.
    """
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)(result)
