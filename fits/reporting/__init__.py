"""What people look at: result directories, tables, verdicts in words, pictures, reports. Nothing is inferred here.

A `fits.Fit`, and its `fits.Posterior` where there is one, go in; files, figures and sentences come out.
"""

from typing import TYPE_CHECKING

from fits._lazy import directory_of, names_from

if TYPE_CHECKING:
    from fits.reporting.html import report as report
    from fits.reporting.results import load_fit as load_fit
    from fits.reporting.results import load_posterior as load_posterior
    from fits.reporting.results import save_fit as save_fit

_HOMES = {
    "report": "html",
    "save_fit": "results",
    "load_fit": "results",
    "load_posterior": "results",
}

__all__ = list(_HOMES)

__getattr__ = names_from(__name__, _HOMES)
__dir__ = directory_of(__name__, _HOMES)
