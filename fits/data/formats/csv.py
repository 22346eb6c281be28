"""CSV with named columns, the format that this project writes.

Columns                      meaning
theta_i, theta_o             polar angles in degrees, [0, 90] and [0, 180] (above 90: transmission). In files that this
                             project wrote theta_i may go to 180: light from below.
phi_i, phi_o                 azimuths in degrees, [-360, 360]; phi_o = phi_i + 180 is the mirror direction.
                             Both may be missing: then theta_o is signed, in [-180, 180], positive on the mirror side.
brdf | brdf_cos | reflectance_factor
                             f in 1/sr | f |cos theta_o| | pi f. For several channels one column each: brdf_red, ...
bsdf | bsdf_cos | brf, reflectance
                             other names for the same; a note says what they were taken for
<that column>_std | _sigma   its standard deviation (optional); an empty cell or nan means unknown.
                             Beside a single value column, std or sigma alone is taken for it, and noted
used                         1 or 0 (optional): whether the sample takes part in fits

A row without a value (an empty cell, nan or NA in a value column) is skipped, and a note says how many were. Other
columns are skipped and noted. Lines that start with # are comments; `write_csv` keeps the source in some of
them. The delimiter is a comma, semicolon or tab. Capitals in names of columns are as good, but for channels, which keep
them. Comments may be of Windows (Latin-1), all else is UTF-8.
"""

import csv
import io
from pathlib import Path

import numpy as np

from fits._files import write_text
from fits.data import geometry
from fits.data.formats import totals_csv
from fits.data.formats._cells import SUFFIXES, Table, in_known_case, named, names_in
from fits.data.formats._text import Line, content, plural, read_lines
from fits.data.geometry import Floats, Geometry
from fits.data.measurements import (
    LARGEST,
    SMALLEST_SIGMA,
    TO_HAVE_THEM,
    Measurements,
    Source,
    channel_names,
    check_quantity,
    to_bsdf,
)
from fits.data.totals import Totals
from fits.names import QUANTITIES, Quantity

_ABOVE, _BELOW_TOO, _SIGNED, _PHI = (0.0, 90.0), (0.0, 180.0), (-180.0, 180.0), (-360.0, 360.0)
_NOT_NEGATIVE = (0.0, LARGEST)
_QUANTITY_OF: dict[str, Quantity] = {  # by how the name of a value column begins
    **{quantity: quantity for quantity in QUANTITIES},
    "bsdf": "brdf",
    "bsdf_cos": "brdf_cos",
    "brf": "reflectance_factor",
    "reflectance": "reflectance_factor",
}
_MEANING: dict[Quantity, str] = {
    "brdf": "the BRDF in 1/sr",
    "brdf_cos": "the BRDF times the cosine of theta_o",
    "reflectance_factor": "the reflectance factor pi times the BRDF",
}
_FIRST_LINE = "# layerjax measurements"


def recognises(first_line: str) -> bool:
    """Whether the first line that is no comment names the columns we need."""
    return {"theta_i", "theta_o"} <= set(names_in(first_line))


def read(path: Path, quantity: Quantity | None = None) -> Measurements:
    """Read a CSV; `quantity` chooses where the file holds more than one. Errors as in `fits.read`.

    Samples in the tangent plane are masked. Where only some samples have a standard deviation, the others get the
    median relative one of their channel, times the value, but at least the smallest one given; where none has, sigma is
    None.
    """
    lines = read_lines(path)
    rows = content(lines)
    if not rows:
        raise ValueError(f"{path}: the file holds only comments, must have a header line")
    header, body = rows[0], rows[1:]
    table = Table(header, body, _QUANTITY_OF)
    kind, channels = _value_columns(header, table.names, quantity)
    chosen = _QUANTITY_OF[kind]
    empty = table.skip_missing(list(channels.values()))

    written_here = lines[0].text == _FIRST_LINE
    wi, wo, notes = _directions(table, written_here)
    if empty:
        notes.append(f"skipped: {plural(empty, 'data point')} without a value (an empty cell, or nan)")
    if kind != chosen:
        notes.append(f"{named(list(channels.values()))} taken for {_MEANING[chosen]}")

    values = to_bsdf(np.stack([table.column(name) for name in channels.values()], axis=-1), wo, chosen)
    used = table.column("used", (0.0, 1.0)) == 1 if "used" in table.names else np.ones(len(table.body), bool)
    tangent = np.minimum(abs(wi[:, 2]), abs(wo[:, 2])) < geometry.TANGENT_COSINE
    if (used & tangent).any():
        notes.append(
            f"masked: {plural(int((used & tangent).sum()), 'sample')} in the tangent plane (theta of 90 degrees)"
        )
    used &= ~tangent

    spread = [_spread_column(table.names, name) for name in channels.values()]
    if len(spread) == 1 and spread[0] is None and (alone := {"std", "sigma"} & set(table.names)):
        spread[0] = max(alone)
        notes.append(f"column {spread[0]} taken for the standard deviation of {next(iter(channels.values()))}")
    sigma = _sigma(table, spread, used, notes)
    if sigma is not None:
        sigma = to_bsdf(sigma, wo, chosen)
        _fill_unknown(sigma, values, header, tuple(channels), notes)
    known = {"theta_i", "phi_i", "theta_o", "phi_o", "used", *channels.values(), *(name for name in spread if name)}
    ignored = [name for name in table.names if name not in known]
    if ignored:
        notes.append(f"columns not used: {', '.join(ignored)}")
    if (values < 0).any():
        notes.append(f"{plural(int((values < 0).any(axis=1).sum()), 'sample')} below zero, kept as measured")
    source = _source(path, lines, chosen, notes, written_here)
    return Measurements(wi, wo, values, sigma, used, tuple(channels), source)


def read_directions(path: Path) -> Geometry:
    """The directions of a CSV, one pair a line, whether it holds values or not. Errors as in `fits.read`."""
    lines = read_lines(path)
    rows = content(lines)
    if not rows:
        raise ValueError(f"{path}: the file holds only comments, must have a header line")
    wi, wo, _ = _directions(Table(rows[0], rows[1:], _QUANTITY_OF), lines[0].text == _FIRST_LINE)
    return Geometry(wi, wo)


def write_csv(measurements: Measurements, path: str | Path, force: bool = False) -> None:
    """Write samples as CSV in this project's convention (BSDF in 1/sr), with their source in comments.

    Values, sigma and mask come back exactly as they are, directions to 1e-10 degrees; of `Totals` the used ones, as
    shares. The file appears whole or not at all.

    Args:
        measurements: what is written.
        path: the file.
        force: replace a file that is there.

    Raises:
        ValueError: the file exists and `force` is False, or the name of a channel would not come back: "cos" (the
            column brdf_cos holds products with the cosine), one that ends in "_std" or "_sigma", an empty one.
    """
    if not isinstance(measurements, Measurements):
        raise ValueError(f"measurements: {measurements!r:.60} is not a Measurements; {TO_HAVE_THEM}")
    if isinstance(measurements, Totals):
        totals_csv.write(measurements, path, force)
        return
    write_text(path, csv_text(measurements), force)


def csv_text(measurements: Measurements) -> str:
    """The text of `write_csv`."""
    value_names = _names_to_write(measurements.channels)
    names = ["theta_i", "phi_i", "theta_o", "phi_o", *value_names]
    columns = [
        measurements.theta_i,
        measurements.phi_i,
        measurements.theta_o,
        measurements.phi_o,
        *measurements.values.T,
    ]
    if measurements.sigma is not None:
        names += [f"{name}_sigma" for name in value_names]
        columns += [*measurements.sigma.T]
    source = measurements.source
    comments = {"source": source.path, "format": source.format, "quantity": source.quantity}
    if source.attribution:
        comments["attribution"] = source.attribution
    text = io.StringIO()
    text.write(f"{_FIRST_LINE}\n")
    text.writelines(f"# {key}: {_one_line(comment)}\n" for key, comment in comments.items())
    text.writelines(f"# note: {_one_line(note)}\n" for note in source.notes)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*names, "used"])
    for *numbers, used in zip(*columns, measurements.mask, strict=True):
        writer.writerow([*(repr(float(number)) for number in numbers), int(used)])
    return text.getvalue()


def _directions(table: Table, written_here: bool) -> tuple[Floats, Floats, list[str]]:
    """Unit vectors towards light and viewer, (N, 3) each, and what is to be noted of them."""
    theta_i = table.column("theta_i", _BELOW_TOO if written_here else _ABOVE)
    notes = []
    if "phi_i" in table.names or "phi_o" in table.names:
        phi_i, phi_o = table.column("phi_i", _PHI), table.column("phi_o", _PHI)
        theta_o = table.column("theta_o", _BELOW_TOO)
    else:
        phi_i, phi_o = np.full(len(theta_i), geometry.LIGHT_AZIMUTH), np.zeros(len(theta_i))
        theta_o = table.column("theta_o", _SIGNED)
        notes = ["no azimuth columns: theta_o is signed, in the plane of incidence, positive on the mirror side"]
    return geometry.direction(theta_i, phi_i), geometry.direction(theta_o, phi_o), notes


def _value_columns(header: Line, names: list[str], wanted: Quantity | None) -> tuple[str, dict[str, str]]:
    """Prefix of the value columns, one of `_QUANTITY_OF`, and their names, as channel name -> column."""
    columns_of: dict[str, dict[str, str]] = {}
    for name in names:
        kind, channel = _kind_and_channel(name)
        if kind is not None and not name.endswith(SUFFIXES):
            columns_of.setdefault(kind, {})[channel] = name
    if not columns_of:
        allowed = ", ".join(_QUANTITY_OF)
        raise header.error(f"no value column: must be one of {allowed}; the file has {', '.join(names)}")
    quantities = dict.fromkeys(_QUANTITY_OF[kind] for kind in columns_of)
    if wanted is not None and wanted not in quantities:
        raise header.error(f"no column {wanted!r}, the file has {', '.join(names)}")
    if wanted is None and len(quantities) > 1:
        raise header.error(f"{len(quantities)} quantities ({', '.join(quantities)}): choose one with quantity")
    chosen = next(iter(quantities)) if wanted is None else wanted
    kinds = [kind for kind in columns_of if _QUANTITY_OF[kind] == chosen]
    if len(kinds) > 1:
        raise header.error(f"columns {', '.join(kinds)}: names of one quantity, must be only one of them")
    columns = columns_of[kinds[0]]
    if kinds[0] in columns.values() and len(columns) > 1:
        raise header.error(
            f"columns {', '.join(columns.values())}: one without a channel name cannot stand beside others"
        )
    for channel, column in columns.items():
        if _kind_and_channel(f"brdf_{channel}")[1] != channel:  # nothing that is saved later would be read back
            raise header.error(f"no channel may be called {channel!r}; products with the cosine are brdf_cos", column)
    return kinds[0], columns


def _kind_and_channel(column: str) -> tuple[str | None, str]:
    """Prefix of a column's name, one of `_QUANTITY_OF` or None for another column, and the channel that it names."""
    column = in_known_case(column, _QUANTITY_OF)
    longest_first = sorted(_QUANTITY_OF, key=len, reverse=True)  # in brdf_cos, "cos" is no channel of brdf
    kind = next((known for known in longest_first if column == known or column.startswith(f"{known}_")), None)
    return kind, column.removeprefix(kind or "").removeprefix("_") or channel_names(1)[0]


def _names_to_write(channels: tuple[str, ...]) -> list[str]:
    """The columns of these channels; ValueError for a channel that the reader would not find in its column."""
    if channels == channel_names(1):
        return ["brdf"]
    columns = [f"brdf_{channel}" for channel in channels]
    for channel, column in zip(channels, columns, strict=True):
        one_line = len(column.splitlines()) == 1 and column == column.strip()
        if not one_line or column.endswith(SUFFIXES) or _kind_and_channel(column) != ("brdf", channel):
            raise ValueError(
                f"channel {channel!r} cannot be written: its column would be read as another; give it another name"
            )
    return columns


def _spread_column(names: list[str], column: str) -> str | None:
    return next((column + suffix for suffix in SUFFIXES if column + suffix in names), None)


def _sigma(table: Table, columns: list[str | None], used: np.ndarray, notes: list[str]) -> Floats | None:
    """Standard deviations (N, C) in the file's quantity, NaN where unknown; None where nothing is known at all."""
    if not any(columns):
        return None
    unknown = np.full(len(table.body), np.nan)
    sigma = np.stack(
        [table.column(name, _NOT_NEGATIVE, empty=np.nan) if name else unknown for name in columns], axis=-1
    )
    zero = used & (sigma < SMALLEST_SIGMA).any(axis=1)
    if zero.any():
        row = int(np.argmax(zero))
        column = int(np.argmax(sigma[row] < SMALLEST_SIGMA))
        raise table.body[row].error(
            f"{sigma[row, column]:g} is not allowed, must be > 0, at least {SMALLEST_SIGMA:g} (leave the cell empty "
            "where it is unknown)",
            columns[column],
        )
    if np.isnan(sigma).all():
        notes.append("the standard deviation columns are empty: sigma is unknown")
        return None
    return sigma


def _fill_unknown(sigma: Floats, values: Floats, header: Line, channels: tuple[str, ...], notes: list[str]) -> None:
    """Replace NaN in sigma (N, C), in place, by the median relative spread of the samples that have one."""
    for channel, name in enumerate(channels):
        known, given = np.isfinite(sigma[:, channel]), sigma[:, channel]
        if known.all():
            continue
        usable = known & (given > 0) & (values[:, channel] != 0)
        if not usable.any():
            raise header.error(f"channel {name!r} has no standard deviation to estimate the missing ones from")
        relative = float(np.median(given[usable] / abs(values[usable, channel])))
        estimate = np.maximum(relative * abs(values[:, channel]), given[usable].min())
        sigma[:, channel] = np.where(known, given, estimate)
        notes.append(
            f"{plural(int((~known).sum()), 'sample')} of channel {name!r} without a standard deviation: "
            f"taken as {relative:.3g} of the value, the median of the {int(usable.sum())} that have one"
        )


def _source(path: Path, lines: list[Line], quantity: Quantity, notes: list[str], written_here: bool) -> Source:
    """The source of a file: what its comments say, of an earlier source too where `write_csv` made it."""
    comments = [line.text.lstrip("# ").partition(": ") for line in lines if line.text.startswith("#")]
    said = {key: text for key, _, text in comments}
    if written_here:
        quantity = check_quantity(said.get("quantity")) or quantity
        origin = f"written by layerjax from {said.get('source') or 'memory'} ({said.get('format', 'unknown')})"
        notes = [*notes, *(text for key, _, text in comments if key == "note"), origin]
    return Source(str(path), "csv", quantity, tuple(notes), said.get("attribution", ""))


def _one_line(text: str) -> str:
    return " ".join(text.split())
