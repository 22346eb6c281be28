"""What is in a measurement file: tables of its content, and sentences on reciprocity, energy, symmetry, sampling and
repeated measurements (see `fits.data.checks`)."""

import math

import numpy as np

from fits.data.checks import (
    BRIGHTER,
    FAR,
    Agreement,
    Energy,
    Peak,
    Sides,
    energies,
    peaks,
    reciprocity,
    repeats,
    sides,
    symmetry,
)
from fits.data.measurements import Measurements
from fits.data.scans import in_plane, incidences
from fits.data.totals import Totals
from fits.reports.tables import Table, degrees, quantity_in_words, shortened
from fits.reports.verdicts import DEFAULT, ReportOptions

RADIANS = 1.6
"""A little more than a right angle in radians: angles that are all below this may be in radians."""

MOST_CHANNELS, MOST_TOTALS, MOST_ENERGIES, MOST_ROWS = 12, 6, 6, 40
"""Shown one by one: channels of measurements, channels of totals, incidences with an energy, and rows of a table."""


def source_table(data: Measurements) -> Table:
    """What a file is: format, convention, counts, channels, sigma, and notes of its reader."""
    source, used = data.source, int(np.count_nonzero(data.mask))
    channels = ", ".join(data.channels)
    if len(data.channels) > MOST_CHANNELS:
        channels = f"{', '.join(data.channels[:3])}, ..., {data.channels[-1]} ({len(data.channels):,} in all)"
    plane = [] if isinstance(data, Totals) else [("in plane", f"{np.count_nonzero(in_plane(data))} of {len(data)}")]
    rows = [
        ("format", source.format),
        ("quantity", quantity_in_words(data)),
        ("measurements", f"{len(data)}, {used} used, {len(data) - used} masked"),
        ("channels", channels),
        *plane,
        ("sigma", _sigma(data)),
        *(("attribution", word) for word in (source.attribution,) if word),
        *(("note", note) for note in source.notes),
    ]
    return Table(source.path, ("", ""), tuple(rows))


def _sigma(data: Measurements) -> str:
    if data.sigma is None:
        return "none"
    if not data.mask.any():
        return "no measurement is used"
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = (data.sigma / np.abs(data.values))[data.mask]
    return f"median {np.median(relative):.2%} of the value, {np.min(relative):.2%} to {np.max(relative):.2%}"


def data_table(data: Measurements) -> Table:
    """A row for each incidence: angles, counts, and the range of each channel's values; of totals for each of them."""
    if isinstance(data, Totals):
        return _totals_table(data)
    flat, rows, few = in_plane(data), [], len(data.channels) <= MOST_CHANNELS
    for incidence in incidences(data):
        own = incidence.rows
        theta, values = data.theta_o[own], data.values[own]
        ranges = [f"{column.min():.3g} to {column.max():.3g}" for column in (values.T if few else values[None])]
        counts = (len(own), np.count_nonzero(data.mask[own]), np.count_nonzero(flat[own]))
        angles = (degrees(incidence.theta), degrees(incidence.phi), f"{degrees(theta.min())} to {degrees(theta.max())}")
        rows.append((*angles, *map(str, counts), *ranges))
    heads = tuple(f"BRDF {channel}" for channel in data.channels) if few else ("BRDF",)
    names = ("theta_i", "phi_i", "theta_o", "count", "used", "in plane", *heads)
    return Table("Angles, and BRDF in 1/sr", names, tuple(shortened(rows, MOST_ROWS)), keys=2)


def _totals_table(totals: Totals) -> Table:
    few = len(totals.channels) <= MOST_TOTALS
    rows = []
    for kind, theta, values in zip(totals.kinds, totals.theta_i, totals.values, strict=True):
        shown = values if few else (values.min(), values.max())
        rows.append((kind, degrees(theta), *(f"{value:.4g}" for value in shown)))
    names = ("kind", "theta_i", *(totals.channels if few else ("from", "to")))
    return Table("Shares of the incident flux", names, tuple(shortened(rows, MOST_ROWS)), keys=1)


def data_statements(data: Measurements, options: ReportOptions = DEFAULT) -> list[str]:
    """Sentences on angles that look wrong, reciprocity, energy, symmetry, sampling and repeats of the used data; of
    totals on angles only."""
    angles = data.theta_i if isinstance(data, Totals) else np.concatenate([data.theta_i, data.theta_o])
    largest = np.max(angles, initial=0.0)
    found = []
    if 0.0 < largest < RADIANS:
        found = [f"Angles: none is above {largest:.4g}°: are they radians? They were read as degrees."]
    if isinstance(data, Totals):
        return found
    return [
        *found,
        *_brighter_side(sides(data)),
        _agreement(
            "Reciprocity",
            reciprocity(data),
            "light and viewer are exchanged in {count:,} pairs of measurements; {difference}. A reciprocal model can "
            "be no closer to them than half of that",
            "no two measurements have light and viewer exchanged, it cannot be tested",
        ),
        _energy(energies(data)),
        _agreement(
            "Symmetry",
            symmetry(data),
            "{count:,} pairs lie on either side of the plane of incidence; {difference}",
            "no measurements lie on both sides of the plane of incidence, it cannot be tested",
        ),
        _sampling(peaks(data), options),
        _agreement(
            "Repeats",
            repeats(data),
            "{count:,} measurements were repeated; {difference}: a noise of about {noise:.2g} %",
            "no measurement was repeated; the noise has to come from the file's sigma or from the fit",
        ),
    ]


def _agreement(what: str, pairs: Agreement | None, words: str, without: str) -> str:
    """How well measurements agree that should; without: what is said where there are none."""
    if pairs is None:
        return f"{what}: {without}."
    difference = (
        f"they differ by {100.0 * pairs.median:.2g} % (median; 95 % of them by up to {100.0 * pairs.p95:.2g} %)"
    )
    if not math.isnan(pairs.z):
        difference += f", {pairs.z:.2g} of their standard errors"
    return f"{what}: {words.format(count=pairs.count, difference=difference, noise=100.0 * pairs.noise)}."


def _brighter_side(by_incidence: list[Sides]) -> list[str]:
    """That the brightest side is the light's, where it is: azimuths may be counted from the mirror direction."""
    doubt = (
        "Unless the sample is retro-reflective, azimuths of this file count from the mirror direction, which must lie "
        "at phi_o = phi_i + 180."
    )
    if by_incidence and all(math.isnan(one.mirror) for one in by_incidence):
        return [f"Sides: all measurements in the plane of incidence lie on the light's side. {doubt}"]
    of_light = [one for one in by_incidence if one.light > BRIGHTER * max(one.mirror, 0.0)]
    if len(of_light) <= sum(one.mirror > BRIGHTER * max(one.light, 0.0) for one in by_incidence):
        return []
    worst = max(of_light, key=lambda one: one.light)
    where = f"at {worst.theta:g}° up to {worst.light:.3g} there, and {worst.mirror:.3g} on the mirror side"
    return [f"Sides: the brightest side is the light's: {where}. {doubt}"]


def _energy(by_incidence: list[Energy]) -> str:
    if not by_incidence:
        return "Energy: no incidence is measured over half of the hemisphere, the directional albedo is unknown."
    parts = []
    for one in by_incidence[:MOST_ENERGIES]:
        share = "/".join(f"{part:.3g}" for part in one.share)
        parts.append(f"{share} at {one.theta:g}° over {100.0 * one.covered:.0f} % of it")
    more = f", and {len(by_incidence) - MOST_ENERGIES} more incidences" if len(by_incidence) > MOST_ENERGIES else ""
    words = f"Energy: directional albedo over the measured part of the projected hemisphere: {'; '.join(parts)}{more}."
    above = [one for one in by_incidence if max(one.share) > 1.0]
    if above:
        words += f" It exceeds 1 at {', '.join(f'{one.theta:g}°' for one in above)}: the scale is wrong."
    return words


def _sampling(by_incidence: list[Peak], options: ReportOptions) -> str:
    if not by_incidence:
        return "Sampling: no scan crosses the mirror direction of its light, the peak was not measured."
    if not any(one.stands_out for one in by_incidence):
        return (
            f"Sampling: no peak stands out about the mirror direction: measurements within {FAR:g}° of it nowhere fall "
            "to half of the brightest one."
        )
    worst = min((one for one in by_incidence if one.stands_out), key=lambda one: one.count)
    words = (
        f"Sampling: measurements above half the height of the peak about the mirror direction: {worst.count} or "
        f"more (at {worst.theta:g}°, in steps of {worst.step:.2g}°)"
    )
    if worst.count < options.peak_points:
        return f"{words}: the peak may be narrower than the steps, which then limit a fitted roughness."
    return f"{words}: its width is sampled."
