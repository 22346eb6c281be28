"""Files of materials for renderers and for optical design: one format a file, all of the values of a stack.

A stack with its transport goes in, or a fit; what comes out is a file, and sentences on what it holds and loses.
"""

from typing import TYPE_CHECKING

from fits._lazy import directory_of, names_from

if TYPE_CHECKING:
    from fits.exporting.export import Exported as Exported
    from fits.exporting.export import export as export

_HOMES = {"export": "export", "Exported": "export"}

__all__ = list(_HOMES)

__getattr__ = names_from(__name__, _HOMES)
__dir__ = directory_of(__name__, _HOMES)
