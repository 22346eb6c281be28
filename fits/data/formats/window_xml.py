"""Matrices over patches of directions, in the XML of LBNL WINDOW and Radiance: Klems' bases, or one that it says.

Patches are rings of polar angle, cut by azimuth, the first around azimuth 0; that of a direction is the azimuth along
which light travels, seen from the front. A number is the mean of the BSDF over a patch of light that comes and one of
light that leaves, and is read at the middles of both. WINDOW's front, which faces outside, is read as the top, the
other way round than in Radiance, whose z points to the room: its x is turned as well. Light that passes unscattered is
in the patch that it stays in and cannot be separated from the rest: such patches are masked.
"""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fits.data.formats import tensor_tree
from fits.data.formats._window import COME, ELEMENT, blocks, layer_of, number_of, text_of
from fits.data.geometry import Floats, direction
from fits.data.measurements import Measurements, Source, channel_names

CHANNELS = {"visible": "Y", "cie-x": "X", "cie-z": "Z"}
_MOST_PATCHES = 2000


@dataclass(frozen=True)
class Basis:
    """Middles of the patches, along which light travels upward, (M, 3)."""

    name: str
    directions: Floats


def recognises(head: bytes) -> bool:
    """Whether a file starts as XML, or holds the element of WINDOW further down."""
    return head.lstrip().startswith(b"<?xml") or ELEMENT.search(head) is not None


def read(path: Path) -> Measurements:
    """Read such a file: all blocks of the visible, or X, Y and Z where it has these; and one of tensor trees."""
    layer = layer_of(path)
    incident = (text_of(layer, "DataDefinition/IncidentDataStructure") or "").lower()
    if incident in tensor_tree.RANKS:
        return tensor_tree.read(path, layer, tensor_tree.RANKS[incident])
    if incident not in ("columns", "rows"):
        raise ValueError(
            f"{path}: IncidentDataStructure is {incident!r}, must be Columns, Rows, TensorTree3 or TensorTree4"
        )
    bases = {basis.name.lower(): basis for basis in _bases(path, layer)}
    matrices: dict[str, dict[str, Floats]] = {}
    used: dict[str, tuple[Basis, Basis]] = {}
    for data in layer.iter("WavelengthData"):
        channel = CHANNELS.get((text_of(data, "Wavelength") or "").lower())
        if channel is None:
            continue
        for name, block in blocks(path, data):
            pair = _basis_of(path, bases, block, "ColumnAngleBasis"), _basis_of(path, bases, block, "RowAngleBasis")
            come, leave = pair if incident == "columns" else pair[::-1]
            matrix = _matrix(path, block, name, len(pair[1].directions), len(pair[0].directions))
            if used.setdefault(name, (come, leave)) != (come, leave):
                raise ValueError(f"{path}: {name} has different angle bases in different wavelengths")
            matrices.setdefault(channel, {})[name] = matrix if incident == "columns" else matrix.T
    if "Y" not in matrices:
        raise ValueError(f"{path}: no WavelengthData of 'Visible'")
    colours = tuple(one for one in ("X", "Y", "Z") if matrices.get(one, {}).keys() == matrices["Y"].keys())
    chosen = colours if len(colours) == len(CHANNELS) else ("Y",)
    skipped = sorted(matrices.keys() - set(chosen))
    notes = [f"skipped: {' and '.join(skipped)}, the blocks are not those of the visible"] if skipped else []
    channels = chosen if len(chosen) > 1 else channel_names(1)
    return _samples(path, [matrices[one] for one in chosen], used, channels, notes)


def _samples(
    path: Path,
    matrices: list[dict[str, Floats]],
    used: dict[str, tuple[Basis, Basis]],
    channels: tuple[str, ...],
    more_notes: list[str],
) -> Measurements:
    wi, wo, values, mask = [], [], [], []
    for name in matrices[0]:
        come, leave = used[name]
        kind, _, side = name.partition(" ")
        sign = COME[side]
        through = kind == "transmission"
        # light travels away from where it comes from
        one = come.directions * np.array([1.0, -1.0, sign])
        other = leave.directions * np.array([-1.0, 1.0, -sign if through else sign])
        pairs = np.broadcast_arrays(one[None], other[:, None])
        wi.append(pairs[0].reshape(-1, 3))
        wo.append(pairs[1].reshape(-1, 3))
        values.append(np.stack([block[name].ravel() for block in matrices], axis=-1))
        collimated = through & (np.abs(pairs[0] + pairs[1]).max(axis=-1) < 1e-9)
        mask.append(~collimated.ravel())
    notes = (
        ", ".join(matrices[0]) + "; WINDOW's front is the top (Radiance calls it the back)",
        "means over patches, read at their middles",
        *(["masked: patches with collimated light"] if not all(part.all() for part in mask) else []),
        *more_notes,
    )
    source = Source(str(path), "klems", "brdf", notes)
    parts = [np.concatenate(one) for one in (wi, wo, values, mask)]
    return Measurements(parts[0], parts[1], parts[2], None, parts[3], channels, source)


def _bases(path: Path, layer: ElementTree.Element) -> list[Basis]:
    found = []
    for basis in layer.iterfind("DataDefinition/AngleBasis"):
        name = text_of(basis, "AngleBasisName")
        if not name:
            raise ValueError(f"{path}: an AngleBasis without AngleBasisName")
        directions: list[Floats] = []
        total = 0
        for ring in basis.iter("AngleBasisBlock"):
            low, high = (number_of(path, ring, f"ThetaBounds/{bound}Theta") for bound in ("Lower", "Upper"))
            count = number_of(path, ring, "nPhis")
            if not (0.0 <= low < high <= 90.0 and 1 <= count <= _MOST_PATCHES and count == int(count)):
                raise ValueError(f"{path}: {name}: a ring from {low:g} to {high:g} degrees in {count:g} patches")
            total += int(count)
            if total > _MOST_PATCHES:
                raise ValueError(f"{path}: {name}: {total} patches or more, must be {_MOST_PATCHES} at most")
            theta = 0.0 if count == 1 and low == 0.0 else 0.5 * (low + high)
            directions.append(direction(theta, 360.0 * np.arange(int(count)) / count))
        if not directions:
            raise ValueError(f"{path}: {name}: no AngleBasisBlock")
        found.append(Basis(name, np.concatenate(directions)))
    return found


def _basis_of(path: Path, bases: dict[str, Basis], block: ElementTree.Element, tag: str) -> Basis:
    name = (text_of(block, tag) or "").lower()
    if name not in bases:
        raise ValueError(
            f"{path}: {tag} is {name!r}, must be one of {', '.join(bases) or 'none that the file defines'}"
        )
    return bases[name]


def _matrix(path: Path, block: ElementTree.Element, name: str, rows: int, columns: int) -> NDArray[np.float64]:
    words = (text_of(block, "ScatteringData") or "").replace(",", " ").split()
    if len(words) != rows * columns:
        raise ValueError(f"{path}: {name}: {len(words)} numbers, must be {rows} x {columns}")
    try:
        matrix = np.array(words, float).reshape(rows, columns)
    except ValueError as error:
        raise ValueError(f"{path}: {name}: {error}") from None
    if not np.isfinite(matrix).all():
        raise ValueError(f"{path}: {name}: holds {matrix[~np.isfinite(matrix)][0]}, must be finite")
    return matrix
