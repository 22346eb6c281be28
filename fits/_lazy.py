"""Names of a package that are imported when they are first used, so that importing the package costs nothing."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def names_from(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package; homes: the module of the package that each name stands in."""

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)

    return found


def directory_of(package: str, homes: Mapping[str, str]) -> Callable[[], list[str]]:
    """The `__dir__` of a package: those names as well, so that they complete before they are imported."""
    return lambda: sorted({*vars(sys.modules[package]), *homes})


def shown_by(function: str, of: Any) -> Any:
    """`function` of what is above, such as ``"fits.reports.html:fit_fragment"``, of this result.

    Results know only by name what shows them: packages import downward, and a result that is not shown costs nothing.
    """
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)(of)
