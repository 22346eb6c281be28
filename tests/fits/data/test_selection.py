"""Readings by what a user thinks in."""

import numpy as np
import pytest

from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.data.scans import scans, signed_angle
from fits.data.selection import BLOCK, select


def data() -> Measurements:
    geometry = slices([10.0, 30.0, 50.0], np.arange(-80.0, 81.0, 2.0), [0.0, 60.0])
    count = len(geometry)
    return Measurements(geometry.wi, geometry.wo, np.ones((count, 1)), None, np.ones(count, bool), ("value",))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("incidence=30", lambda d: np.abs(d.theta_i - 30.0) < 0.1),
        ("incidence=10,50.2", lambda d: np.abs(d.theta_i - 30.0) > 0.1),
        ("angle=-20:40", lambda d: (signed_angle(d) > -20.1) & (signed_angle(d) < 40.1)),
        ("angle=-70:-60,12", lambda d: (signed_angle(d) < -59.9) & (signed_angle(d) > -70.1) | (signed_angle(d) == 12)),
    ],
)
def test_selection(words: str, expected) -> None:
    readings = data()
    np.testing.assert_array_equal(select(readings, words), expected(readings))


def test_planes_share_the_normal() -> None:
    readings = data()
    turned = np.abs(np.sin(np.radians(readings.phi_o))) > 0.1
    np.testing.assert_array_equal(select(readings, "plane=60"), turned)
    np.testing.assert_array_equal(select(readings, "plane=0"), ~turned)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.9])
def test_a_share_is_of_whole_blocks_of_every_scan(share: float) -> None:
    readings = data()
    chosen = select(readings, f"share={share}")
    np.testing.assert_array_equal(chosen, select(readings, f"share={share}"))
    angle = signed_angle(readings)
    for rows in scans(readings):
        block = np.floor((angle[rows] - angle[rows].min()) / BLOCK)
        whole = [chosen[rows][block == each] for each in np.unique(block)]
        assert all(part.all() or not part.any() for part in whole)
        assert abs(np.mean([part.all() for part in whole]) - share) <= 1.0 / len(whole)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("incidence=35", "incidence 35 is not in the data; there are 10, 30, 50 degrees"),
        ("incidence=10,ten", "incidence is 'ten'; it must be a number"),
        ("incidence=", "incidence is ''; it must be a number"),
        ("plane=90", "plane 90 is not in the data; there are 0, 60 degrees"),
        ("angle=85:89", "angle 85:89 is not in the data; they go from -80 to 80 degrees"),
        ("angle=20:-20", "angle 20:-20 is empty: its first end must not be above its second"),
        ("share=1.5", "share is 1.5; it must be above 0 and below 1"),
        ("incidences=30", "'incidences=30' is no selection; it must be one of incidence=..., plane=..., angle=..."),
        ("30", "'30' is no selection"),
    ],
)
def test_bad_words_are_refused(words: str, message: str) -> None:
    with pytest.raises(ValueError, match="^" + message.replace(".", r"\.").replace("(", r"\(")):
        select(data(), words)


def test_a_share_of_what_is_no_scan_is_refused() -> None:
    readings = data()
    few = readings.where(np.arange(len(readings)) < 2).used()
    with pytest.raises(ValueError, match=r"^share 0\.5: no scan of the data is longer than a block of 10 degrees"):
        select(few, "share=0.5")
