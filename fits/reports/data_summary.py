"""What is in a measurement file: tables of its content, and sentences on doubtful angles, reciprocity, energy and
repeated measurements (see `fits.data.checks`)."""

import math

import numpy as np

from fits.data.checks import Agreement, energies, reciprocity, repeats, sides
from fits.data.measurements import Measurements
from fits.data.scans import in_plane, incidences
from fits.data.totals import Totals
from fits.reports.tables import Table, degrees, shortened

MOST_CHANNELS, MOST_ENERGIES, MOST_ANGLES = 6, 6, 24
"""Shown one by one: channels, incidences with an energy, and incidences in a line."""

BRIGHTER = 1.3
"""Ratio of the brightest measurements of two sides above which one side is the brighter beyond noise."""


def source_rows(data: Measurements) -> tuple[tuple[str, str], ...]:
    """What a file is: format, convention, counts, channels, incidences, sigma, and notes of its reader."""
    source, used, channels = data.source, int(np.count_nonzero(data.mask)), ", ".join(data.channels)
    if len(data.channels) > MOST_CHANNELS:
        channels = f"{', '.join(data.channels[:3])}, ..., {data.channels[-1]} ({len(data.channels):,} in all)"
    if isinstance(data, Totals):
        quantity, plane = "shares of the incident flux", []
        if data.spheres is not None:
            spheres = "two integrating spheres" if data.spheres.together else "an integrating sphere"
            quantity = f"{quantity}, as measured with {spheres}"
    else:
        quantity = f"{source.quantity}, converted to BRDF in 1/sr"
        plane = [("in plane", f"{np.count_nonzero(in_plane(data))} of {len(data)}")]
    angles = [one.theta for one in incidences(data.used())]
    span = ", ".join(f"{angle:g}°" for angle in angles)
    if len(angles) > MOST_ANGLES:
        span = f"{len(angles)}, from {min(angles):g}° to {max(angles):g}°"
    sigma = "none"
    if data.sigma is not None and used:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = (data.sigma / np.abs(data.values))[data.mask]
        sigma = f"median {np.median(relative):.2%} of the value, {np.min(relative):.2%} to {np.max(relative):.2%}"
    return (
        ("format", source.format),
        ("quantity", quantity),
        ("measurements", f"{len(data)}, {used} used, {len(data) - used} masked"),
        ("channels", channels),
        *plane,
        ("incidence", span),
        ("sigma", sigma),
        *(("attribution", word) for word in (source.attribution,) if word),
        *(("note", note) for note in source.notes),
    )


def data_table(data: Measurements) -> Table:
    """A row for each incidence: angles, counts, and the range of each channel's values; of totals for each of them."""
    few, rows = len(data.channels) <= MOST_CHANNELS, []
    if isinstance(data, Totals):
        for kind, theta, values in zip(data.kinds, data.theta_i, data.values, strict=True):
            numbers = values if few else (values.min(), values.max())
            rows.append((kind, degrees(theta), *(f"{value:.4g}" for value in numbers)))
        names = ("kind", "theta_i", *(data.channels if few else ("from", "to")))
        return Table("Shares of the incident flux", names, shortened(rows))
    flat = in_plane(data)
    for incidence in incidences(data):
        own = incidence.rows
        theta, values = data.theta_o[own], data.values[own]
        ranges = [f"{column.min():.3g} to {column.max():.3g}" for column in (values.T if few else values[None])]
        counts = (len(own), np.count_nonzero(data.mask[own]), np.count_nonzero(flat[own]))
        angles = (degrees(incidence.theta), degrees(incidence.phi), f"{degrees(theta.min())} to {degrees(theta.max())}")
        rows.append((*angles, *map(str, counts), *ranges))
    heads = tuple(f"BRDF {channel}" for channel in data.channels) if few else ("BRDF",)
    names = ("theta_i", "phi_i", "theta_o", "count", "used", "in plane", *heads)
    return Table("Angles, and BRDF in 1/sr", names, shortened(rows))


def doubtful_angles(data: Measurements) -> list[str]:
    """Sentences on angles that were probably meant otherwise: radians, azimuths from the mirror direction."""
    words, total = [], isinstance(data, Totals)
    largest = np.max(data.theta_i if total else np.concatenate([data.theta_i, data.theta_o]), initial=0.0)
    if 0.0 < largest < 1.6:  # a little more than a right angle in radians
        words.append(f"Angles: none is above {largest:.4g}°: are they radians? They were read as degrees.")
    if total or not (scans := sides(data)):
        return words
    brighter = [one for one in scans if one.light > BRIGHTER * max(one.mirror, 0.0)]
    if all(math.isnan(one.mirror) for one in scans):
        where = "all measurements in the plane of incidence lie on the light's side"
    elif len(brighter) > sum(one.mirror > BRIGHTER * max(one.light, 0.0) for one in scans):
        worst = max(brighter, key=lambda one: one.light)
        where = f"the brightest side is the light's: at {worst.theta:g}° up to {worst.light:.3g} there"
        where = f"{where}, and {worst.mirror:.3g} on the mirror side"
    else:
        return words
    return [
        *words,
        f"Sides: {where}. Unless the sample is retro-reflective, azimuths of this file count from the mirror "
        "direction, which must lie at phi_o = phi_i + 180.",
    ]


def data_statements(data: Measurements) -> list[str]:
    """Sentences on angles that look wrong, reciprocity, energy and repeats of the used data; of totals on angles."""
    if isinstance(data, Totals):
        return doubtful_angles(data)

    def agreement(what: str, pairs: Agreement | None) -> str:
        if pairs is None:
            return f"there are no measurements {what}"
        words = f"{pairs.number:,} pairs of measurements {what} differ by {100.0 * pairs.median:.2g} %"
        return f"{words} (median; 95 % of them by up to {100.0 * pairs.p95:.2g} %)"

    energy, known = (
        "no incidence is measured over half of the hemisphere, the directional albedo is unknown",
        energies(data),
    )
    if known:
        shares = [("/".join(f"{part:.3g}" for part in one.share), one) for one in known[:MOST_ENERGIES]]
        parts = [f"{share} at {one.theta:g}° over {100.0 * one.covered:.0f} % of it" for share, one in shares]
        energy = f"directional albedo over the measured part of the projected hemisphere: {'; '.join(parts)}"
    if above := [f"{one.theta:g}°" for one in known if max(one.share) > 1.0]:
        energy = f"{energy}. It exceeds 1 at {', '.join(above)}: the scale is wrong"
    repeated = repeats(data)
    noise = "" if repeated is None else f", a noise of about {100.0 * repeated.noise:.2g} %"
    return [
        *doubtful_angles(data),
        f"Reciprocity: {agreement('with light and viewer exchanged', reciprocity(data))}.",
        f"Energy: {energy}.",
        f"Repeats: {agreement('along the same directions', repeated)}{noise}.",
    ]
