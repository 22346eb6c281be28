"""Readings by what a user thinks in."""

import numpy as np
import pytest

from fits.data.geometry import slices
from fits.data.measurements import Measurements
from fits.data.scans import scans, signed_angle
from fits.data.selection import BLOCK, select

PLANES = slices([10.0, 30.0, 50.0], np.arange(-80.0, 81.0, 2.0), [0.0, 60.0])
EVERY = np.ones(len(PLANES), bool)
DATA = Measurements(PLANES.wi, PLANES.wo, np.ones((len(PLANES), 1)), None, EVERY, ("value",))
ANGLE = signed_angle(DATA)
TURNED = np.abs(np.sin(np.radians(DATA.phi_o))) > 0.1
"""Data in the plane of azimuth 60; the normal belongs to the other."""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("incidence=30", np.abs(DATA.theta_i - 30.0) < 0.1),
        ("incidence=10,50.2", np.abs(DATA.theta_i - 30.0) > 0.1),
        ("angle=-20:40", (ANGLE > -20.1) & (ANGLE < 40.1)),
        ("angle=-70:-60,12", (ANGLE < -59.9) & (ANGLE > -70.1) | (ANGLE == 12)),
        ("plane=60", TURNED),
        ("plane=0", ~TURNED),
    ],
)
def test_words_select(words, expected):
    np.testing.assert_array_equal(select(DATA, words), expected)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.9])
def test_a_share_is_of_whole_blocks_of_every_scan(share):
    chosen = select(DATA, f"share={share}")
    np.testing.assert_array_equal(chosen, select(DATA, f"share={share}"))
    for rows in scans(DATA):
        block = np.floor((ANGLE[rows] - ANGLE[rows].min()) / BLOCK)
        whole = [chosen[rows][block == each] for each in np.unique(block)]
        assert all(part.all() or not part.any() for part in whole)
        assert abs(np.mean([part.all() for part in whole]) - share) <= 1.0 / len(whole)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"incidence": [10, 50.2]}, np.abs(DATA.theta_i - 30.0) > 0.1),
        ({"azimuth": 60}, TURNED),
        ({"azimuth": [180.0]}, ~TURNED),
        ({"azimuth": -120}, TURNED),
        ({"in_plane": False}, TURNED),
        ({"theta_o": [20, 40]}, np.isin(DATA.theta_o.round(6), [20.0, 40.0])),
        ({"theta_o": slice(None, 60)}, DATA.theta_o < 60.5),
        (
            {"theta_o": slice(20, 60), "incidence": 10, "in_plane": True},
            (DATA.theta_o > 19.5) & (DATA.theta_o < 60.5) & (DATA.theta_i < 11.0) & ~TURNED,
        ),
    ],
)
def test_arguments_select_and_drop_omits_the_same(given, expected):
    data = DATA.where(DATA.theta_o < 79.0)
    for part, which in ((data.select(**given), expected), (data.drop(**given), ~expected)):
        np.testing.assert_array_equal(part.wo, data.wo[which & data.mask])
        assert part.mask.all()


def test_channels_are_selected():
    geometry = slices([10.0], [0.0, 20.0, 40.0])
    values, mask = np.arange(9.0).reshape(3, 3), np.array([True, True, False])
    colours = Measurements(geometry.wi, geometry.wo, values, 0.1 + values, mask, ("red", "green", "blue"))
    both = colours.select(channels=["red", "blue"], theta_o=20)
    assert both.channels == ("red", "blue")
    np.testing.assert_array_equal(both.values, [[3.0, 5.0]])
    np.testing.assert_array_equal(both.sigma, [[3.1, 5.1]])
    assert colours.select(channels="green").channels == ("green",)
    np.testing.assert_array_equal(colours.drop(channels="green").values, [[0.0, 2.0], [3.0, 5.0]])
    for given, message in (
        ({"channels": "grey"}, "channel grey is not in the data; there are red, green, blue"),
        ({"channels": "red", "incidence": 10}, "drop: channels are given together with angles"),
        ({"channels": ["red", "green", "blue"]}, "drop: no sample of the data remains"),
        ({"incidence": 10}, "drop: no sample of the data remains"),
    ):
        with pytest.raises(ValueError, match=message):
            colours.drop(**given)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("incidence=35", "incidence 35 is not in the data; there are 10, 30, 50 degrees"),
        ("incidence=10,ten", "incidence is 'ten'; it must be a number"),
        ("incidence=", "incidence is ''; it must be a number"),
        ("plane=90", "plane 90 is not in the data; there are 0, 60 degrees"),
        ("angle=85:89", "angle 85:89 is not in the data; they go from -80 to 80 degrees"),
        ("angle=20:-20", "angle 20:-20 is empty: its first angle must not be above its second"),
        ("share=1.5", "share is 1.5; it must be above 0 and below 1"),
        ("incidences=30", "'incidences=30' is no selection; it must be one of incidence=..., plane=..., angle=..."),
        ("30", "'30' is no selection"),
        ({}, "select: no argument is given; it takes incidence, azimuth, theta_o, in_plane and channels"),
        ({"incidence": 35}, "incidence 35 is not in the data; there are 10, 30, 50 degrees"),
        ({"azimuth": 90}, "azimuth 90 is not in the data; there are 0, 60 degrees"),
        ({"theta_o": [20, 85]}, "theta_o 85 is not in the data; they go from 0 to 80 degrees"),
        ({"theta_o": slice(60, 20)}, "theta_o is slice(60, 20, None); it must be slice(low, high)"),
        ({"theta_o": slice(81, 85)}, "select: no sample of the data fulfils all of this"),
    ],
)
def test_refused(asked, message):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 (parentheses in what is looked for)
        select(DATA, asked) if isinstance(asked, str) else DATA.select(**asked)
    assert str(refused.value).startswith(message)


def test_a_share_needs_a_scan_longer_than_a_block():
    with pytest.raises(ValueError, match=r"^share 0\.5: no scan of the data is longer than a block of 10 degrees"):
        select(DATA.where(np.arange(len(DATA)) < 2).used(), "share=0.5")
