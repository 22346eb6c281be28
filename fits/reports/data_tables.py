"""Tables of measurements: what a file is, and what it holds."""

from typing import TYPE_CHECKING

import numpy as np

from fits.data.scans import in_plane, incidences
from fits.data.totals import Totals
from fits.reports.tables import Table, degrees, shortened

if TYPE_CHECKING:
    from fits.data.measurements import Measurements

MOST_CHANNELS = 6
"""Of totals, that have a column each; of more, the range."""

NAMED = 12
"""Channels that are named one by one, and have a column each; of more, the range over all of them."""


def source_table(data: "Measurements") -> Table:
    """What a file is: format, convention, counts, channels, sigma, and what its reader noted."""
    source = data.source
    used = int(np.count_nonzero(data.mask))
    flat = [] if isinstance(data, Totals) else [("in plane", f"{np.count_nonzero(in_plane(data))} of {len(data)}")]
    rows = [
        ("format", source.format),
        ("values came as", came_as(data)),
        ("readings", f"{len(data)}, {used} used, {len(data) - used} masked"),
        ("channels", _channel_words(data.channels)),
        *flat,
        ("sigma", _sigma_words(data)),
        *(("attribution", word) for word in (source.attribution,) if word),
        *(("note", note) for note in source.notes),
    ]
    return Table(source.path, ("", ""), tuple(rows))


def _channel_words(names: tuple[str, ...]) -> str:
    if len(names) <= NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:3])}, ..., {names[-1]} ({len(names):,} of them)"


def came_as(data: "Measurements") -> str:
    """What the values of a file are."""
    if not isinstance(data, Totals):
        return f"{data.source.quantity}, converted to BRDF in 1/sr"
    if data.spheres is None:
        return "totals, shares of the light"
    count = "two integrating spheres" if data.spheres.together else "an integrating sphere"
    return f"totals, shares of the light, as {count} read them"


def _sigma_words(data: "Measurements") -> str:
    if data.sigma is None:
        return "none"
    if not data.mask.any():
        return "no reading is used"
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = (data.sigma / np.abs(data.values))[data.mask]
    return f"median {np.median(relative):.2%} of the value, {np.min(relative):.2%} to {np.max(relative):.2%}"


def data_table(data: "Measurements") -> Table:
    """One row per incidence of a measurement: angles, readings, and the range of each channel's values; of totals one
    per reading."""
    if isinstance(data, Totals):
        return _totals_table(data)
    flat = in_plane(data)
    rows = []
    for incidence in incidences(data):
        theta, values = data.theta_o[incidence.rows], data.values[incidence.rows]
        columns = values.T if values.shape[1] <= NAMED else values[None]
        ranges = [f"{own.min():.3g} to {own.max():.3g}" for own in columns]
        counts = (
            len(incidence.rows),
            np.count_nonzero(data.mask[incidence.rows]),
            np.count_nonzero(flat[incidence.rows]),
        )
        angles = (degrees(incidence.theta), degrees(incidence.phi), f"{degrees(theta.min())} to {degrees(theta.max())}")
        rows.append((*angles, *map(str, counts), *ranges))
    few = len(data.channels) <= NAMED
    heads = tuple(f"BRDF {channel}" for channel in data.channels) if few else ("BRDF",)
    names = ("theta_i", "phi_i", "theta_o", "readings", "used", "in plane", *heads)
    return Table("Angles, and BRDF in 1/sr", names, tuple(shortened(rows, 40)), keys=2)


def _totals_table(totals: Totals) -> Table:
    names = totals.channels if len(totals.channels) <= MOST_CHANNELS else ("from", "to")
    rows = []
    for kind, theta, values in zip(totals.kinds, totals.theta_i, totals.values, strict=True):
        shown = values if len(names) == len(values) else (values.min(), values.max())
        rows.append((kind, degrees(theta), *(f"{value:.4g}" for value in shown)))
    return Table("Shares of the light", ("kind", "theta_i", *names), tuple(shortened(rows, 40)), keys=1)
