"""Bins of a MERL table that are read without given directions: all of them, or a stratified choice.

A choice follows a low-discrepancy sequence through the table, with the probability of a bin in proportion to what it
counts for. All measurements then have equal weight in a likelihood.
"""

from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from fits.data.formats._text import plural
from fits.data.geometry import Floats
from fits.names import STRATA, Strata

MOST = 100_000
"""Bins of a choice at most: beyond, every bin is as well read."""

POINTS = 4
"""Points of the sequence for each bin wanted, at first: several may lie in one bin."""

DOUBLINGS = 6
"""Times that they are doubled, at most."""

Indices = NDArray[np.int_]
Table = NDArray[np.float64]


def all_bins(readable: NDArray[np.bool_]) -> tuple[Indices, str]:
    """The bins (N, 3) that can be read, and a note."""
    bins = np.argwhere(readable)
    return bins, f"measurements at the centres of {_count_of(len(bins), readable)}"


def choice(readable: NDArray[np.bool_], measure: Table, count: int, strata: Strata, seed: int) -> tuple[Indices, str]:
    """Choose `count` of the readable bins, (count, 3), none twice, each for an equal share of `measure`; and a note.

    Raises:
        ValueError: there are not so many.
    """
    if count > min(MOST, readable.sum() // 2):
        most = min(MOST, int(readable.sum()) // 2)
        raise ValueError(f"bins is {count}, must be at most {most} of the {readable.sum()} that can be read, or 'all'")
    weight = np.where(readable, measure, 0.0)
    sequence = qmc.Sobol(3, rng=np.random.default_rng(seed))
    exponent = int(np.ceil(np.log2(POINTS * count)))
    points = sequence.random_base2(exponent)
    for _ in range(DOUBLINGS):
        bins = _of_points(weight, points)
        _, first = np.unique(bins, axis=0, return_index=True)
        if len(first) >= count:
            break
        points = np.concatenate([points, sequence.random(len(points))])
    else:
        raise ValueError(f"bins is {count}, but only {len(first)} of them count for more than nothing; choose fewer")
    stands = {"bins": "bins of the table", "flux": "projected solid angle of light and viewer"}[strata]
    centres = f"measurements at the centres of {_count_of(count, readable)}"
    return bins[np.sort(first)[:count]], f"{centres}, each for an equal share of the {stands} (seed {seed})"


def check(bins: object, strata: object, seed: object) -> None:
    """ValueError for a choice that is none."""
    whole = isinstance(bins, int | np.integer) and not isinstance(bins, bool)
    if bins != "all" and not (whole and cast(int, bins) >= 1):
        raise ValueError(f"bins is {bins!r}, must be a whole number of at least 1, or 'all'")
    if strata not in STRATA:
        raise ValueError(f"strata is {strata!r}, must be one of {', '.join(STRATA)}")
    if not (isinstance(seed, int) and seed >= 0):
        raise ValueError(f"seed is {seed!r}, must be a whole number of at least 0")


def projected_solid_angle(cosine_i: Floats, cosine_o: Floats, theta_h: Floats, theta_d: Floats) -> Floats:
    """Of the pairs of directions in each bin, up to a factor: cos cos dwi dwo = cos cos 4 cos(theta_d) dh dd.

    A bin is as wide in theta_h as its root, by which the table is indexed.
    """
    solid = np.sin(theta_h) * np.sqrt(theta_h) * np.sin(theta_d) * np.cos(theta_d)
    return np.maximum(cosine_i, 0.0) * np.maximum(cosine_o, 0.0) * solid


def _of_points(weight: Table, points: Floats) -> Indices:
    """The bins (N, 3) that points (N, 3) of the unit cube fall in: one index after the other, given those before."""
    bins = np.zeros(points.shape, int)
    for axis in range(3):
        level = weight.sum(axis=tuple(range(axis + 1, 3)))
        cumulative = np.cumsum(level, axis=-1)[tuple(bins[:, :axis].T)]
        bins[:, axis] = np.sum(cumulative <= points[:, axis, None] * cumulative[..., -1:], axis=-1)
    return bins


def _count_of(count: int, readable: NDArray[np.bool_]) -> str:
    return f"{plural(count, 'bin')} of {readable.sum():,} that can be read"
