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


def test_parts_are_selected_and_the_rest_is_what_they_leave() -> None:
    readings = data().where(data().theta_o < 79.0)
    part, rest = readings.select(incidence=[10, 50.2]), readings.drop(incidence=[10, 50.2])
    np.testing.assert_array_equal(np.unique(part.theta_i.round(6)), [10.0, 50.0])
    np.testing.assert_array_equal(np.unique(rest.theta_i.round(6)), [30.0])
    assert len(part) + len(rest) == readings.mask.sum()
    assert part.mask.all()
    assert rest.mask.all()
    assert len(readings.select(incidence=30)) == len(rest)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"azimuth": 60}, lambda d: np.abs(np.sin(np.radians(d.phi_o))) > 0.1),
        ({"azimuth": [180.0]}, lambda d: np.abs(np.sin(np.radians(d.phi_o))) < 0.1),
        ({"azimuth": -120}, lambda d: np.abs(np.sin(np.radians(d.phi_o))) > 0.1),
        ({"in_plane": False}, lambda d: np.abs(np.sin(np.radians(d.phi_o))) > 0.1),
        ({"theta_o": [20, 40]}, lambda d: np.isin(d.theta_o.round(6), [20.0, 40.0])),
        ({"theta_o": slice(None, 60)}, lambda d: d.theta_o < 60.5),
        (
            {"theta_o": slice(20, 60), "incidence": 10, "in_plane": True},
            lambda d: (d.theta_o > 19.5) & (d.theta_o < 60.5) & (d.theta_i < 11.0) & (abs(d.wo[:, 1]) < 1e-6),
        ),
    ],
)
def test_what_is_selected(given, expected) -> None:
    readings = data()
    np.testing.assert_array_equal(readings.select(**given).wo, readings.wo[expected(readings)])
    np.testing.assert_array_equal(readings.drop(**given).wo, readings.wo[~expected(readings)])


def test_channels_are_selected() -> None:
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
def test_refused(asked: str | dict, message: str) -> None:
    with pytest.raises(ValueError) as refused:  # noqa: PT011 (parentheses in what is looked for)
        select(data(), asked) if isinstance(asked, str) else data().select(**asked)
    assert str(refused.value).startswith(message)
    few = data().where(np.arange(len(data())) < 2).used()
    with pytest.raises(ValueError, match=r"^share 0\.5: no scan of the data is longer than a block of 10 degrees"):
        select(few, "share=0.5")
