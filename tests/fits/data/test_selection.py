"""Measurements and their geometry: conventions, validation, masks; how they lie in angle, and are selected by it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fits.data.geometry import Geometry, azimuth, direction, polar, slices
from fits.data.measurements import Measurements, channel_names
from fits.data.reading import ReadOptions
from fits.data.scans import correlation, in_plane, incidences, neighbours, relative_azimuth, select, signed_angle
from tests.helpers.models import along
from tests.helpers.refusals import refuses


def lying(theta_i, phi_i, theta_o, phi_o) -> Measurements:
    angles = np.broadcast_arrays(theta_i, phi_i, theta_o, phi_o)
    return along(Geometry(direction(*angles[:2]), direction(*angles[2:])))


def test_the_viewing_angle_is_positive_on_the_mirror_side() -> None:
    data = lying(30.0, [180, 180, 37, 300, 180, 180], 20.0, [0, 180, 217, 120, 60, 120])
    np.testing.assert_allclose(signed_angle(data), [20, -20, 20, 20, 20, -20], atol=1e-9)
    np.testing.assert_allclose(relative_azimuth(data), [0, 180, 0, 0, 60, 120], atol=1e-9)
    np.testing.assert_array_equal(in_plane(data), [True, True, True, True, False, False])
    normal = slices(incidence=0.0, outgoing=(-40.0, 0.0, 40.0))  # its planes are those of the slices
    np.testing.assert_allclose(signed_angle(normal), [-40, 0, 40], atol=1e-9)
    assert in_plane(normal).all()


def test_rows_of_one_incidence() -> None:
    """Incidences differ by either angle, and are the same within the jitter of an instrument."""
    theta, phi = [30.24, 30.26, 30.3, 30.74, 0.1, 0.2, 50.0, 50.0], [359.9, 0.1, 0.0, 0.0, 10.0, 200.0, 90.0, 90.6]
    groups = [(0.15, [4, 5]), (30.27, [0, 1, 2]), (30.74, [3]), (50.0, [6]), (50.0, [7])]
    found = [(round(float(group.theta), 2), group.rows.tolist()) for group in incidences(lying(theta, phi, 5.0, 0.0))]
    assert found == groups


@pytest.mark.parametrize("given", [0.0, 0.8])
def test_the_correlation_of_neighbours_is_recovered(given: float) -> None:
    count = 4000
    draws = np.random.default_rng(5).standard_normal(count) * np.sqrt(1 - given**2)
    draws[0] /= np.sqrt(1 - given**2)
    series = lfilter([1.0], [1.0, -given], draws)
    shuffled, angle = np.random.default_rng(0).permutation(count), np.linspace(-80, 80, count)
    data = lying(30.0, 180.0, np.abs(angle), np.where(angle < 0, 180.0, 0.0))
    pairs = neighbours(replace(data, wo=data.wo[shuffled]), series[shuffled, None])
    # the standard error of a lag-one correlation r is sqrt((1 - r^2) / n)
    assert abs(correlation(*pairs) - given) < 4 * np.sqrt((1 - given**2) / count)
    assert pairs[0].size == count - 1


PLANES = slices([10.0, 30.0, 50.0], np.arange(-80.0, 81.0, 2.0), [0.0, 60.0])
DATA = along(PLANES)
TURNED = np.abs(np.sin(np.radians(DATA.phi_o))) > 0.1
"""Data in the plane of azimuth 60; the normal belongs to the other."""


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("incidence=10,50.2", np.abs(DATA.theta_i - 30.0) > 0.1),
        ("theta_o=20:40", (DATA.theta_o > 19.9) & (DATA.theta_o < 40.1)),
        ("azimuth=60", TURNED),
        ({"azimuth": -120}, TURNED),
        ({"in_plane": False}, TURNED),
        ({"theta_o": slice(None, 60)}, DATA.theta_o < 60.5),
        ({"incidence": [10, 50], "in_plane": True}, (np.abs(DATA.theta_i - 30.0) > 0.1) & ~TURNED),
    ],
)
def test_words_and_arguments_select_and_drop_omits_the_same(given, expected):
    if isinstance(given, str):
        np.testing.assert_array_equal(select(DATA, given), expected)
        return
    data = DATA.where(DATA.theta_o < 79.0)
    for part, which in ((data.select(**given), expected), (data.drop(**given), ~expected)):
        np.testing.assert_array_equal(part.wo, data.wo[which & data.mask])
        assert part.mask.all()


def test_channels_are_selected():
    geometry = slices([10.0], [0.0, 20.0, 40.0])
    values, mask = np.arange(9.0).reshape(3, 3), np.array([True, True, False])
    colours = Measurements(geometry.wi, geometry.wo, values, 0.1 + values, mask, ("red", "green", "blue"))
    both = colours.select(channels=["red", "blue"], theta_o=20)
    assert (both.channels, both.values.tolist(), both.sigma.tolist()) == (("red", "blue"), [[3.0, 5.0]], [[3.1, 5.1]])
    assert colours.select(channels="green").channels == ("green",)
    np.testing.assert_array_equal(colours.drop(channels="green").values, [[0.0, 2.0], [3.0, 5.0]])
    refuses("channel grey is not in the data; there are red, green, blue", colours.drop, channels="grey")
    refuses("drop: channels are given together with angles", colours.drop, channels="red", incidence=10)
    refuses("drop: no sample of the data remains", colours.drop, incidence=10)


def test_refused():
    for asked, message in (
        ("incidence=35", "incidence 35 is not in the data; there are 10, 30, 50 degrees"),
        ("incidence=10,ten", "incidence is '10,ten'; it must be angles in degrees, as in 10,50 or 20:60"),
        ("theta_o=40:20", "theta_o is 40.0:20.0; it must be two angles, the first not above the second"),
        ("incidences=30", "'incidences=30' is no selection; it must be one of incidence=..., azimuth=..., theta_o="),
        ({}, "select: no argument is given; it takes incidence, azimuth, theta_o, in_plane and channels"),
        ({"azimuth": 90}, "azimuth 90 is not in the data; there are 0, 60 degrees"),
        ({"theta_o": [20, 85]}, "theta_o 85 is not in the data; they go from 0 to 80 degrees"),
        ({"theta_o": slice(81, 85)}, "select: no sample of the data fulfils all of this"),
    ):
        with pytest.raises(ValueError) as refused:  # noqa: PT011 (parentheses in what is looked for)
            select(DATA, asked) if isinstance(asked, str) else DATA.select(**asked)
        assert str(refused.value).startswith(message)


def measurements(theta_i=(30.0, 30.0, 60.0), theta_o=(30.0, 0.0, 45.0), **changes):
    count = len(theta_i)
    arrays = {"wi": direction(theta_i, 180.0), "wo": direction(theta_o, 0.0), "mask": np.ones(count, bool)}
    arrays |= {"values": np.arange(1.0, count + 1)[:, None], "sigma": np.full((count, 1), 0.1)}
    return Measurements(channels=("value",), **arrays | changes)


def test_directions_angles_and_names_of_channels_follow_the_conventions():
    r = np.sqrt(0.5)
    np.testing.assert_allclose(direction([90, -45, 180], [90, 0, 0]), [[0, 1, 0], [-r, 0, r], [0, 0, -1]], atol=1e-15)
    theta, phi = np.array([0.0, 1e-7, 33.3, 89.9999999, 120.0, 180.0]), np.array([0.0, 350.0, 12.5, 180.0, 270.0, 0.0])
    np.testing.assert_allclose(polar(direction(theta, phi)), theta, atol=1e-10)
    np.testing.assert_allclose(azimuth(direction(theta, phi)), phi, atol=1e-6)
    assert [channel_names(count)[-1] for count in (1, 2, 3)] == ["value", "channel2", "blue"]


def test_bad_arrays_are_refused():
    for change, message in (
        ({"values": np.ones((3, 2))}, r"values has shape \(3, 2\), must be \(3, 1\)"),
        ({"wi": np.ones((2, 3))}, r"wi has shape"),
        ({"wo": 2 * direction([1, 2, 3], 0)}, "wo has length 2, must be 1"),
        ({"values": np.array([[1.0], [np.nan], [1.0]])}, "values holds nan, must be finite"),
        ({"sigma": np.array([[1.0], [-0.5], [1.0]])}, "sigma is -0.5, must be >= 0"),
        ({"sigma": np.zeros((3, 1))}, "sigma is 0 in a sample that is used"),
        ({"values": np.array([[1.0], [-1e300], [1.0]])}, r"values holds 1e\+300, must be at most 1e\+30 in size"),
        ({"sigma": np.full((3, 1), 1e-200)}, "sigma is 1e-200 in a sample that is used, must be > 0, at least 1e-100"),
    ):
        refuses(message, measurements, **change)


def test_masks_narrow_and_are_noted():
    data = measurements(theta_i=(30.0, 30.0, 80.0), theta_o=(30.0, -33.0, 45.0))
    for degrees, near in ((2.9, True), (3.1, False), (8, False)):
        np.testing.assert_array_equal(ReadOptions(min_retro_angle=degrees).masked(data).mask, [True, near, True])
    both = ReadOptions(min_retro_angle=8, max_polar_angle=75).masked(data)
    np.testing.assert_array_equal(both.mask, [True, False, False])
    assert both.used().values.ravel().tolist() == [1]
    words = ("within 8 degrees of retro-reflection", "more than 75 degrees from the normal")
    assert both.source.notes == tuple(f"masked: {one}" for one in words)
    zero = measurements(sigma=np.array([[0.0], [0.1], [0.1]]), mask=np.array([False, True, True]))
    assert len(zero.used()) == 2  # a sigma of zero stands where nothing is used
    with pytest.raises(ValueError, match="read-only"):
        zero.values[0] = 2
    through = measurements(theta_i=(30.0, 30.0), theta_o=(100.0, 170.0))  # counted from the side where it leaves
    np.testing.assert_array_equal(ReadOptions(max_polar_angle=75).masked(through).mask, [False, True])
    refuses("keep has shape", data.where, np.ones(2, bool))


def test_slices_are_where_they_say():
    geometry = slices(incidence=[10, 40], outgoing=[-20, 0, 20], azimuth=[0, 90])
    np.testing.assert_allclose(geometry.theta_i, [10] * 5 + [40] * 5)  # the normal once for each incidence
    sine = np.sin(np.radians(20))
    expected = [[-sine, 0], [0, 0], [sine, 0], [0, -sine], [0, sine]]
    np.testing.assert_allclose(geometry.wo[:5, :2], expected, atol=1e-15)
    assert len(slices()) == 4 * 35
    assert len(slices(10.0, [0, 180], azimuth=[0, 90])) == 2  # straight down once as well
    for arguments, message in (
        ({"incidence": [200]}, r"incidence is 200, must be in \[0, 180\] degrees"),
        ({"outgoing": []}, "outgoing is empty"),
        ({"outgoing": [np.nan]}, "outgoing is nan"),
        ({"azimuth": 400}, "azimuth is 400"),
    ):
        refuses(message, slices, **arguments)
