"""What a notebook shows of a fitted map, as an HTML fragment."""

import html

from fits.maps.fitted_map import FittedMap
from fits.maps.report import tables, verdicts
from fits.maps.summary import summarised
from fits.reports.tables import html_table


def map_fragment(map: FittedMap) -> str:
    """How much of the map there is, how far it can be trusted, and the median of every parameter."""
    found = summarised(map)
    words, _ = verdicts.in_short(found, map)
    table = html_table(tables.quartile_table(found, map)) if found.fitted else ""
    return f"<p>{html.escape(' '.join(words))}</p>{table}"
