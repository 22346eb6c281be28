"""Zemax BSDF: the angles mean what the documentation says, shown on the real file; layout by hand."""

import numpy as np
import pytest

from fits.data.geometry import direction
from fits.data.reading import read
from tests.helpers.data_files import ZEMAX
from tests.helpers.places import COATINGS

BLOCK = ZEMAX[ZEMAX.index("TIS") : ZEMAX.index("DataEnd")]


@pytest.fixture
def zemax(reading):
    """The small file, with other words in the place of some."""

    def of(*changes, **options):
        text = ZEMAX
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        return reading(text, **options)

    return of


@pytest.fixture(scope="module")
def steel():
    return read(COATINGS / "AnoBlackNiTEonSteel.bsdf")


def test_a_real_file_is_measured_up_to_80_degrees_from_the_normal(steel):
    """The instrument stopped at theta_o = 80: the file's zeros must lie beyond it, and all its values within.

    Radial angles about the normal, or azimuths counted from the other side, would scatter both over all theta_o.
    """
    assert (steel.theta_o[steel.mask] <= 80 + 1e-9).all()
    assert (steel.theta_o[~steel.mask] > 80).all()
    assert (steel.mask.sum(), (~steel.mask).sum()) == (647, 59)
    assert sorted(set(steel.theta_i)) == [10, 30, 50, 70]
    np.testing.assert_allclose(steel.phi_i, 180)
    mirror = np.linalg.norm(steel.wi * [-1, -1, 1] - steel.wo, axis=1) < 1e-9  # once
    np.testing.assert_allclose(steel.values[mirror, 0], [6.039e-2, 7.562e-2, 1.601e-1, 1.522], rtol=1e-3)


def test_layout_by_hand(zemax):
    data = zemax()
    # incidence 20: specular once, then 25 degrees away towards the normal, sideways, and away from it
    sideways = np.cos(np.radians(25)) * direction(20, 0) - np.sin(np.radians(25)) * np.array([0, 1, 0])
    expected = [direction(20, 0), direction(-5, 0), sideways, direction(45, 0)]
    np.testing.assert_allclose(data.wo[:4], expected, atol=1e-15)
    np.testing.assert_allclose(data.wo[7], direction(85, 0), atol=1e-15)
    np.testing.assert_array_equal(data.values[:, 0], [1, 2, 3, 4, 5, 6, 0, 8])
    np.testing.assert_array_equal(data.mask, [True] * 6 + [False, True])
    assert data.source.notes[1:] == (
        "skipped: 0 grid points at or beyond the horizon",
        "masked: 1 zero above the horizon, not measured",
    )
    data = zemax(("0 25", "0 35"))
    assert len(data) == 7  # 60 + 35 degrees away from the normal is below
    assert (data.wo[:, 2] > 0).all()
    assert "skipped: 1 grid point at or beyond the horizon" in data.source.notes


def test_transmission_goes_on_below(zemax):
    data = zemax(("BRDF", "BTDF"))
    np.testing.assert_allclose(data.wo[0], -data.wi[0], atol=1e-15)  # straight on
    np.testing.assert_allclose(data.wo[1], direction(180 + 5, 0), atol=1e-15)  # towards the lower normal, and past it
    assert (data.wo[:, 2] < 0).all()


def test_channels_rotations_and_quantity(zemax):
    start = ZEMAX.index("Monochrome\nDataBegin")
    blocks = "".join(f"Tristimulus{name}\nDataBegin\n{BLOCK * 2}DataEnd\n" for name in "XYZ")
    changes = [("PlaneSymmetrical", "Asymmetrical"), ("Content Monochrome", "Content XYZ"), ("1\n0\n", "2\n0 90\n")]
    data = zemax((ZEMAX[start:], blocks), *changes, quantity="reflectance_factor")
    assert data.channels == ("X", "Y", "Z")
    assert data.values.shape == (16, 3)
    np.testing.assert_allclose(data.values[:8, 2], np.array([1, 2, 3, 4, 5, 6, 0, 8]) / np.pi)
    np.testing.assert_allclose(data.phi_i[[0, 8]], [180, 90])
    quarter_turn = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the whole geometry turns by -90 degrees
    np.testing.assert_allclose(data.wo[8:], data.wo[:8] @ quarter_turn.T, atol=1e-15)
    assert data.source.quantity == "reflectance_factor"


@pytest.mark.parametrize("symmetry", ["PlaneSymmetrical", "ASymmetrical", "Asymmetrical4D"])
def test_all_symmetries_are_read_as_they_stand(zemax, symmetry):
    """Two rotations of the sample, azimuths beyond 180: the light turns by the rotation, the lobe with it."""
    changes = [("PlaneSymmetrical", symmetry), ("1\n0\n", "2\n0 30\n"), ("0 90 180", "0 120 240"), (BLOCK, BLOCK * 2)]
    data = zemax(*changes)
    assert len(data) == 16
    np.testing.assert_allclose(data.phi_i, np.repeat([180, 150], 8))
    np.testing.assert_allclose(data.theta_o[:8], data.theta_o[8:])
    np.testing.assert_allclose((data.phi_o[:8] - data.phi_o[8:]) % 360, 30)
    # azimuths 120 and 240 lie on either side of the plane of incidence
    np.testing.assert_allclose(data.wo[2] * [1, -1, 1], data.wo[3], atol=1e-12)
    assert abs(data.wo[2, 1]) > 0.3
