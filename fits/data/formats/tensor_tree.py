"""Tensor trees of Radiance: BSDFs in boxes as large as they vary slowly, in the XML of LBNL WINDOW.

Directions are points of a disk, their projections on the surface, and that disk is the unit square by Shirley & Chiu's
concentric map (1997). A tree of rank 4 has for coordinates the point towards which light travels and the one where it
leaves; one of rank 3, of an isotropic material, (1 - sin theta_i) / 2 and the point where it leaves, if light travels
towards azimuth 0. Each node is cut in halves along all its axes, the first axis being the lowest bit, or holds a grid,
the last axis running fastest. Numbers are BSDFs in 1/sr without the cosine. Layout and sides as in `bsdf_t.c` and
`bsdf2ttree.c` of Radiance; colours are trees of CIE 1976 u' and v' beside that of Y.

A box is read at its middle. As in `window_xml`, WINDOW's front is the top, Radiance's z is turned, and light that
is transmitted collimated lies in boxes that cannot be separated from the rest: these are masked.
"""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fits.data.formats._window import COME, blocks, text_of
from fits.data.geometry import Floats
from fits.data.measurements import Measurements, Source, channel_names

RANKS = {"tensortree3": 3, "tensortree4": 4}
_TREES = {"visible": "Y", "cie-u": "u", "cie-v": "v"}
_BASIS = "lbnl/shirley-chiu"
_DEEPEST = 20  # no box is smaller than 2^-20

Node: TypeAlias = Floats | list["Node"]
"""A grid with `rank` axes of the same length, or 2^rank nodes."""


@dataclass(frozen=True)
class Boxes:
    """M boxes of the unit cube: low corners (M, rank), edges (M,), values (M,)."""

    low: Floats
    edge: Floats
    values: Floats


def read(path: Path, layer: ElementTree.Element, rank: int) -> Measurements:
    """Read the layer of a file: all blocks of the visible, as X, Y and Z where all of them have colours."""
    trees: dict[str, dict[str, Node]] = {}
    for data in layer.iter("WavelengthData"):
        which = _TREES.get((text_of(data, "Wavelength") or "").lower())
        if which is None:
            continue
        for name, block in blocks(path, data):
            basis = text_of(block, "AngleBasis") or ""
            if basis.lower() != _BASIS:
                raise ValueError(f"{path}: {name}: AngleBasis is {basis[:40]!r}, must be LBNL/Shirley-Chiu")
            try:
                tree = parse(text_of(block, "ScatteringData") or "", rank)
            except ValueError as error:
                raise ValueError(f"{path}: {name}: {error}") from None
            trees.setdefault(which, {})[name] = tree
    if not trees.get("Y"):
        raise ValueError(f"{path}: no WavelengthData of 'Visible'")
    coloured = all(trees.get(which, {}).keys() == trees["Y"].keys() for which in ("u", "v"))
    parts = [_samples(path, name, trees, rank, coloured) for name in trees["Y"]]
    wi, wo, values, used = (np.concatenate(one) for one in zip(*parts, strict=True))
    notes = [
        ", ".join(trees["Y"]) + "; WINDOW's front is the top (Radiance calls it the back)",
        "means over boxes of a tensor tree, read at their middles",
    ]
    if not used.all():
        notes.append(f"masked: {int((~used).sum())} boxes with collimated or grazing light")
    source = Source(str(path), "tensortree", "brdf", tuple(notes))
    return Measurements(wi, wo, values, None, used, ("X", "Y", "Z") if coloured else channel_names(1), source)


def parse(words: str, rank: int) -> Node:
    """The tree in the text of a file; ValueError without its path."""
    frames: list[list[Node]] = [[]]
    numbers: Floats | None = None
    for part in re.split(r"([{}])", words.replace(",", " ")):
        if part == "{":
            frames.append([])
            numbers = None
            if len(frames) > _DEEPEST:
                raise ValueError(f"the tree is deeper than {_DEEPEST} nodes")
        elif part == "}":
            if len(frames) == 1:
                raise ValueError("the tree has a '}' too many")
            children = frames.pop()
            frames[-1].append(_node(children, rank) if numbers is None else _grid(numbers, rank))
            numbers = None
        elif part.strip():
            numbers = _numbers(part)
            if frames[-1] or len(frames) == 1:
                raise ValueError(f"the tree has numbers beside nodes: {part.strip()[:40]!r}")
    if len(frames) != 1 or len(frames[0]) != 1:
        raise ValueError("the tree has no end (truncated?)" if len(frames) > 1 else "there is no tree, or several")
    return frames[0][0]


def _numbers(part: str) -> Floats:
    try:
        numbers = np.array(part.split(), float)
    except ValueError as error:
        raise ValueError(f"the tree: {error}") from None
    if not np.isfinite(numbers).all():
        raise ValueError(f"the tree holds {numbers[~np.isfinite(numbers)][0]}, must be finite")
    return np.maximum(numbers, 0.0)  # as Radiance reads it


def _grid(numbers: Floats, rank: int) -> Floats:
    along = round(len(numbers) ** (1.0 / rank))
    if along**rank != len(numbers) or along & (along - 1):
        raise ValueError(f"the tree has a grid of {len(numbers)} numbers, must be a power of {1 << rank}")
    return numbers.reshape((along,) * rank)


def _node(children: list[Node], rank: int) -> Node:
    """One grid of children that are grids of the same size."""
    if len(children) != 1 << rank:
        raise ValueError(f"the tree has a node of {len(children)}, must be {1 << rank}")
    shapes = {child.shape if isinstance(child, np.ndarray) else None for child in children}
    if len(shapes) > 1 or None in shapes:
        return children
    stacked = np.array(children)
    along = stacked.shape[1]
    # axes: bits of the last axis first, then the places in a child
    halves = stacked.reshape((2,) * rank + (along,) * rank)
    order = [axis for pair in zip(range(rank - 1, -1, -1), range(rank, 2 * rank), strict=True) for axis in pair]
    return halves.transpose(order).reshape((2 * along,) * rank)


def boxes(tree: Node, rank: int) -> Boxes:
    """All boxes of a tree."""
    lows, edges, values = [], [], []
    waiting: list[tuple[Node, Floats, float]] = [(tree, np.zeros(rank), 1.0)]
    while waiting:
        node, low, edge = waiting.pop()
        if isinstance(node, np.ndarray):
            size = edge / len(node)
            lows.append(low + size * np.indices(node.shape).reshape(rank, -1).T)
            edges.append(np.full(node.size, size))
            values.append(node.ravel())
        else:
            for number, child in enumerate(node):
                waiting.append((child, low + 0.5 * edge * (number >> np.arange(rank) & 1), 0.5 * edge))
    return Boxes(np.concatenate(lows), np.concatenate(edges), np.concatenate(values))


def look_up(tree: Node, points: Floats) -> Floats:
    """Values (M,) of a tree at points (M, rank) of the unit cube."""
    if isinstance(tree, np.ndarray):
        return tree[tuple((points.T * len(tree)).astype(int).clip(0, len(tree) - 1))]
    found = np.empty(len(points))
    upper = points >= 0.5
    which = (upper << np.arange(points.shape[1])).sum(axis=1)
    for number in np.unique(which):
        here = which == number
        found[here] = look_up(tree[number], 2.0 * points[here] - upper[here])
    return found


def disk(square: Floats) -> Floats:
    """Shirley & Chiu's points of the unit disk, (..., 2), of those of the unit square."""
    a, b = np.moveaxis(2.0 * square - 1.0, -1, 0)
    wide = abs(a) > abs(b)
    radius = np.where(wide, a, b)
    ratio = np.where(wide, b, a) / np.where(radius == 0.0, 1.0, radius)
    angle = np.pi / 4.0 * np.where(wide, ratio, 2.0 - ratio)
    return radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _samples(
    path: Path, name: str, trees: dict[str, dict[str, Node]], rank: int, coloured: bool
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """wi and wo (M, 3), values (M, C), and whether they are used (M,), of one block."""
    found = boxes(trees["Y"][name], rank)
    if rank == 3:  # beyond one half of the first axis lies nothing
        alive = found.low[:, 0] < 0.5
        found = Boxes(found.low[alive], found.edge[alive], found.values[alive])
    high = found.low + found.edge[:, None]
    if rank == 3:
        high[:, 0] = np.minimum(high[:, 0], 0.5)
    middle = 0.5 * (found.low + high)
    plane = np.stack([1.0 - 2.0 * middle[:, 0], np.zeros(len(middle))], axis=-1)
    travels = disk(middle[:, :2]) if rank == 4 else plane
    kind, _, side = name.partition(" ")
    through = kind == "transmission"
    turn = np.array([-1.0, 1.0]) if rank == 4 else np.array([1.0, -1.0])  # isotropic: the light at azimuth 180
    wi = _raised(-travels * turn, COME[side])
    wo = _raised(disk(middle[:, -2:]) * turn, -COME[side] if through else COME[side])
    used = np.minimum(abs(wi[:, 2]), abs(wo[:, 2])) > 1e-6
    if through:
        used &= ~_collimated(found.low, high, rank)
    values = found.values[:, None]
    if coloured:
        u, v = (look_up(trees[which][name], middle)[:, None] for which in ("u", "v"))
        if (v <= 0.0).any():
            raise ValueError(f"{path}: {name}: CIE-v is {v.min():g}, must be above 0")
        y = 4.0 * v / (6.0 * u - 16.0 * v + 12.0)  # x = 9 u / (6 u - 16 v + 12)
        values = values * np.concatenate([2.25 * u / v, np.ones_like(v), 1.0 / y - 2.25 * u / v - 1.0], axis=1)
    return wi, wo, values, used


def _raised(flat: Floats, sign: float) -> Floats:
    """Unit vectors (M, 3) over points (M, 2) of the disk, on the side of this sign."""
    up = np.sqrt(np.clip(1.0 - np.sum(flat**2, axis=-1, keepdims=True), 0.0, None))
    return np.concatenate([flat, sign * up], axis=-1)


def _collimated(low: Floats, high: Floats, rank: int) -> NDArray[np.bool_]:
    """Whether boxes hold light that leaves towards where it travelled, (M,)."""
    if rank == 4:
        overlap = (low[:, :2] < high[:, 2:]) & (low[:, 2:] < high[:, :2])
        return overlap[:, 0] & overlap[:, 1]
    along = (low[:, 1] < 1.0 - low[:, 0]) & (1.0 - high[:, 0] < high[:, 1])
    return along & (low[:, 2] <= 0.5) & (high[:, 2] >= 0.5)
