"""How measurements lie in angle: signed angles, incidences within the jitter of an instrument, neighbours."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fits.data.geometry import Geometry, direction, slices
from fits.data.measurements import Measurements
from fits.data.scans import correlation, in_plane, incidences, neighbours, relative_azimuth, signed_angle
from tests.helpers.models import along


def measurements(theta_i, phi_i, theta_o, phi_o) -> Measurements:
    angles = np.broadcast_arrays(theta_i, phi_i, theta_o, phi_o)
    return along(Geometry(direction(*angles[:2]), direction(*angles[2:])))


def test_the_viewing_angle_is_positive_on_the_mirror_side() -> None:
    data = measurements(30.0, [180, 180, 37, 300, 180, 180], 20.0, [0, 180, 217, 120, 60, 120])
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
    for group, (polar, rows) in zip(incidences(measurements(theta, phi, 5.0, 0.0)), groups, strict=True):
        assert group.rows.tolist() == rows
        assert group.theta == pytest.approx(polar, abs=0.005)


@pytest.mark.parametrize("given", [0.0, 0.8])
def test_the_correlation_of_neighbours_is_recovered(given: float) -> None:
    """Of a stationary autoregressive series, in any order of the rows."""
    count = 4000
    draws = np.random.default_rng(5).standard_normal(count) * np.sqrt(1 - given**2)
    draws[0] /= np.sqrt(1 - given**2)
    series = lfilter([1.0], [1.0, -given], draws)
    shuffled, angle = np.random.default_rng(0).permutation(count), np.linspace(-80, 80, count)
    data = measurements(30.0, 180.0, np.abs(angle), np.where(angle < 0, 180.0, 0.0))
    pairs = neighbours(replace(data, wo=data.wo[shuffled]), series[shuffled, None])
    # the standard error of a lag-one correlation r is sqrt((1 - r^2) / n)
    assert abs(correlation(*pairs) - given) < 4 * np.sqrt((1 - given**2) / count)
    assert pairs[0].size == count - 1
