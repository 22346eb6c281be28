"""The report of a result directory, and its pictures as files beside it."""

from pathlib import Path
from typing import TYPE_CHECKING

from fits._files import write_together

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.reports.html import Foretold
    from fits.sampling.posterior import Posterior


def write_report(
    folder: Path,
    name: str,
    result: "Fit",
    posterior: "Posterior | None" = None,
    others: "dict[str, Fit | Posterior] | None" = None,
) -> "Foretold | None":
    """Write them into the folder of a result; what the report says of readings held out."""
    from fits.reports import results
    from fits.reports.html import draw, foretell, page
    from fits.reports.stored import held_out_of

    unseen = held_out_of(folder)
    foretold = None if unseen is None else foretell(result, posterior, unseen)
    images = draw(result, posterior, others, name, foretold)
    text = page(result, posterior, images, others, name, foretold)
    pictures = {f"{picture}.png": content for picture, content in images.items()}
    write_together(folder, {**pictures, results.REPORT: text.encode()})
    return foretold
