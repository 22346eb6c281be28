"""Measurements: validation, conversion at the door, masks; and the geometry they are taken in."""

import numpy as np
import pytest

from fits.data.geometry import azimuth, direction, polar, slices
from fits.data.measurements import Measurements, channel_names
from fits.data.reading import ReadOptions


def measurements(theta_i=(30.0, 30.0, 60.0), theta_o=(30.0, 0.0, 45.0), **changes):
    count = len(theta_i)
    arrays = {"wi": direction(theta_i, 180.0), "wo": direction(theta_o, 0.0), "mask": np.ones(count, bool)}
    arrays |= {"values": np.arange(1.0, count + 1)[:, None], "sigma": np.full((count, 1), 0.1)}
    return Measurements(channels=("value",), **arrays | changes)


def test_directions_and_angles_follow_the_conventions():
    r = np.sqrt(0.5)
    np.testing.assert_allclose(direction([90, -45, 180], [90, 0, 0]), [[0, 1, 0], [-r, 0, r], [0, 0, -1]], atol=1e-15)
    theta, phi = np.array([0.0, 1e-7, 33.3, 89.9999999, 120.0, 180.0]), np.array([0.0, 350.0, 12.5, 180.0, 270.0, 0.0])
    np.testing.assert_allclose(polar(direction(theta, phi)), theta, atol=1e-10)
    np.testing.assert_allclose(azimuth(direction(theta, phi)), phi, atol=1e-6)


def test_channels_have_names():
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
        with pytest.raises(ValueError, match=message):
            measurements(**change)


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
    with pytest.raises(ValueError, match="keep has shape"):
        data.where(np.ones(2, bool))


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
        with pytest.raises(ValueError, match=message):
            slices(**arguments)
