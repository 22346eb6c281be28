"""How a result is shown by a higher room, which it imports when it is displayed and not before."""

import importlib
from typing import Any


def shown_by(function: str, result: Any) -> Any:
    """Call a function of a higher room, such as ``"fits.reports.html:fit_fragment"``, with a result.

    A result refers to it by name, as rooms import downward, and a result that is not displayed imports nothing.
    """
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)(result)
