"""CSV with totals: what a sphere, or a detector behind the sample, read at each angle of incidence.

Columns                      meaning
theta_i                      polar angle of the light in degrees, [0, 90)
total_reflectance            all that leaves on the side of the light, as a share of it
total_transmittance          hemispherical transmittance, with its collimated part
unscattered_transmittance    of this, what no medium has scattered
<that column>_std | _sigma   its standard deviation (all of a kind, or none)

One to three of the kinds; for several channels one column each: total_reflectance_red, ... An empty cell was not read;
of several channels all are empty then. A note says how many rows hold no value at all.
"""

import csv
import io
import itertools
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fits._files import write_text
from fits.data.formats._cells import SUFFIXES, Table, names_in
from fits.data.formats._text import content, plural, read_lines
from fits.data.geometry import LIGHT_AZIMUTH, Floats, direction
from fits.data.measurements import Source, channel_names
from fits.data.totals import KINDS, Kind, Totals

COLUMNS: dict[Kind, str] = {
    "reflectance": "total_reflectance",
    "transmittance": "total_transmittance",
    "unscattered": "unscattered_transmittance",
}
_SHARE, _ANGLE, _POSITIVE = (0.0, np.inf), (0.0, np.nextafter(90.0, 0.0)), (np.nextafter(0.0, 1.0), np.inf)


def recognises(first_line: str) -> bool:
    """Whether the first line that is no comment names a column of totals, and no viewer."""
    names = names_in(first_line)
    return "theta_o" not in names and any(name.startswith(tuple(COLUMNS.values())) for name in names)


def read(path: Path) -> Totals:
    """Read a CSV of totals. Without any column of standard deviations sigma is None.

    Raises:
        ValueError: on one line, which names file, line, column, value and allowed range.
    """
    lines = content(read_lines(path))
    if not lines:
        raise ValueError(f"{path}: the file holds only comments, must have a header line")
    header, body = lines[0], lines[1:]
    table = Table(header, body, COLUMNS.values())
    angles = table.column("theta_i", _ANGLE)
    light = direction(angles, np.full(len(angles), LIGHT_AZIMUTH))
    named = {kind: columns for kind in KINDS if (columns := _channels(table.names, COLUMNS[kind]))}
    if not named:
        raise header.error(f"no column of {', '.join(COLUMNS.values())}")
    channels = tuple(next(iter(named.values())))
    wi, wo, values, sigma, kinds = [], [], [], [], []
    known, rows = {"theta_i"}, np.zeros(len(angles), bool)
    for kind, columns in named.items():
        if tuple(columns) != channels:
            raise header.error(f"channels {', '.join(columns)}: every kind must have the same, {', '.join(channels)}")
        spreads = [name + suffix for name in columns.values() for suffix in SUFFIXES if name + suffix in table.names]
        part = _numbers(table, columns.values(), _SHARE)
        measured = _is_measured(table, list(columns.values()), part)
        if spreads:
            if len(spreads) != len(columns):
                raise header.error(f"{', '.join(spreads)}: every channel must have one standard deviation, or none")
            sigma.append(_numbers(table, spreads, _POSITIVE)[measured])
        wi.append(light[measured])
        wo.append(light[measured] * (-1, -1, 1 if kind == "reflectance" else -1))
        values.append(part[measured])
        kinds += [kind] * int(measured.sum())
        known |= {*columns.values(), *spreads}
        rows |= measured
    if sigma and len(sigma) != len(named):
        raise header.error("only some kinds have standard deviations: all must, or none")
    if not kinds:
        raise header.error("all cells of values are empty, must be one measurement at least")
    ignored = [name for name in table.names if name not in known]
    totals = Totals(
        wi=np.concatenate(wi),
        wo=np.concatenate(wo),
        values=np.concatenate(values),
        sigma=np.concatenate(sigma) if sigma else None,
        mask=np.ones(len(kinds), bool),
        channels=channels,
        kinds=tuple(kinds),
    )
    notes = [f"columns not used: {', '.join(ignored)}"] if ignored else []
    if empty := int(np.count_nonzero(~rows)):
        notes.append(f"skipped: {plural(empty, 'row')} without a value (an empty cell, or nan)")
    return replace(totals, source=Source(str(path), "csv", notes=tuple(notes)))


def write(totals: Totals, path: str | Path, force: bool = False) -> None:
    """Write the totals that are used so that they come back as they are, but for spheres, of which no column tells.

    What was read several times at an angle has as many rows of it.

    Raises:
        ValueError: the file exists and `force` is False, light comes along several directions of one
            angle, or the name of a channel would not come back.
    """
    for name in totals.channels:
        if not name or name != name.strip() or name.lower().endswith(SUFFIXES) or "," in name:
            raise ValueError(f"{path}: the name {name!r} of a channel would not come back")
    totals = totals.used()
    kinds = [kind for kind in KINDS if kind in totals.kinds]
    spreads = [""] if totals.sigma is None else ["", SUFFIXES[0]]
    names = [f"{COLUMNS[kind]}{_end(name)}{suffix}" for kind in kinds for suffix in spreads for name in totals.channels]
    arrays = [totals.values] if totals.sigma is None else [totals.values, totals.sigma]
    rows = []
    for angle in np.unique(np.round(totals.theta_i, 9)):
        here = np.flatnonzero(abs(totals.theta_i - angle) < 1e-8).tolist()
        if np.ptp(totals.wi[here], axis=0).max() > 1e-6:
            raise ValueError(f"{path}: light comes from several azimuths at {angle:g} degrees, no column tells of them")
        own = [[k for k in here if totals.kinds[k] == kind] for kind in kinds]
        for at in itertools.zip_longest(*own):
            cells = [_cells(array, k) for k in at for array in arrays]
            rows.append([repr(float(angle)), *itertools.chain.from_iterable(cells)])
    text = io.StringIO()
    text.writelines(f"# note: {' '.join(note.split())}\n" for note in totals.source.notes)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([["theta_i", *names], *rows])
    write_text(path, text.getvalue(), force)


def _end(channel: str) -> str:
    return "" if channel == channel_names(1)[0] else f"_{channel}"


def _cells(array: Floats, row: int | None) -> list[str]:
    return [""] * array.shape[1] if row is None else [repr(float(number)) for number in array[row]]


def _channels(names: list[str], column: str) -> dict[str, str]:
    """Channel -> column, of those columns that begin with one."""
    own = [name for name in names if name == column or name.startswith(f"{column}_")]
    own = [name for name in own if not name.endswith(SUFFIXES)]
    return {name.removeprefix(column).removeprefix("_") or channel_names(1)[0]: name for name in own}


def _numbers(table: Table, names: Iterable[str], allowed: tuple[float, float]) -> Floats:
    """The columns (N, C), NaN where a cell is empty."""
    return np.stack([table.column(name, allowed, empty=np.nan) for name in names], axis=-1)


def _is_measured(table: Table, names: list[str], values: Floats) -> NDArray[np.bool_]:
    """Rows (N,) of values (N, C) that were read; ValueError for one that only some channels were read in."""
    empty = np.isnan(values)
    for row in np.flatnonzero(empty.any(axis=1) & ~empty.all(axis=1)):
        name = names[int(np.argmax(empty[row]))]
        raise table.body[row].error("the cell is empty, must hold a number where other channels do", name)
    return np.asarray(~empty.any(axis=1))
