"""Input files of inverse adding-doubling: both ways to write them, and what is refused."""

import numpy as np
import pytest

import layerjax as lj
from fits.data.formats.rxt import SMOOTH, read_slab

SAMPLE = """\
IAD1   # first four characters
# a slab between slides
1.4    # index of the sample
1.5    # of the slides
2.0    # [mm] sample
1.0    # [mm] slides
5      # [mm] beam
0.98   # standard
{spheres}      # spheres
200 25 12 1 0.96   # reflection sphere
200 25 12 1 0.96   # transmission sphere
"""
BARE = SAMPLE.format(spheres=0)


def written(tmp_path, text):
    path = tmp_path / "slab.rxt"
    path.write_text(text)
    return path


def test_rows_by_a_count(tmp_path):
    slab = read_slab(written(tmp_path, BARE + "2 # R, T\n800 0.3 0.4\n810, 0.2, 0.5  # comma\n"), sigma=0.02)
    assert (slab.ior, slab.ior_slides, slab.thickness_mm) == (1.4, 1.5, 2.0)
    np.testing.assert_allclose(slab.wavelengths, [800, 810])
    assert slab.totals.channels == ("800 nm", "810 nm")
    assert slab.totals.kinds == ("reflectance", "transmittance")
    np.testing.assert_allclose(slab.totals.values, [[0.3, 0.2], [0.4, 0.5]])
    np.testing.assert_allclose(slab.totals.sigma, 0.02)


def test_all_on_one_line_and_without_wavelengths(tmp_path):
    text = "IAD1 1.4 1.0 1 0 5 .96 0 200 25 12 1 .96 200 25 12 1 .96 2 0.168 0.249 0.162 0.264"
    slab = read_slab(written(tmp_path, text))
    assert slab.wavelengths is None
    assert slab.totals.channels == ("row 1", "row 2")
    np.testing.assert_allclose(slab.totals.values, [[0.168, 0.162], [0.249, 0.264]])
    assert slab.ior_slides == 1.0


def test_columns_by_letters(tmp_path):
    slab = read_slab(written(tmp_path, BARE + "L r t u n g\n800 0.3 0.4 0.01 1.41 0.9\n810 0.2 0.5 0.02 1.412 0.8\n"))
    assert slab.totals.kinds == ("reflectance", "transmittance", "unscattered")
    assert slab.ior == pytest.approx(1.411)
    np.testing.assert_allclose(slab.asymmetry, [0.9, 0.8])


@pytest.mark.parametrize(
    ("slides", "ior", "expected"),
    [
        (1.5, 1.4, [1.5, 1.4, None, 1.5, 1.0]),
        (1.0, 1.4, [1.4, None, 1.0]),
        (1.0, 1.0, [None]),
        (1.5, 1.5, [1.5, None, 1.0]),
    ],
)
def test_the_stack_is_the_slab(tmp_path, slides, ior, expected):
    text = BARE.replace("1.4 ", f"{ior} ").replace("1.5 ", f"{slides} ")
    stack = read_slab(written(tmp_path, text + "1\n0.3\n")).stack(2.0, 0.1, lj.HenyeyGreenstein(0.8))
    assert [getattr(layer, "ior", None) for layer in stack.layers] == expected
    assert all(layer.alpha == SMOOTH for layer in stack.layers if isinstance(layer, lj.Interface))
    (medium,) = (layer for layer in stack.layers if isinstance(layer, lj.TurbidMedium))
    assert (medium.thickness_mm, medium.mu_s, medium.mu_a) == (2.0, 2.0, 0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("IAD2 1.4", "not an .rxt file, which begins with IAD1"),
        ("IAD1 1.4 1.0", "2 numbers, must be 17 before the readings"),
        (BARE, "no readings behind the description"),
        (BARE + "4\n0.3", r"line 12, column 'number of measurements': 4 is not allowed, must be a number in \[1, 3\]"),
        (BARE + "2\n800 0.3 0.4\n810 0.2", "line 14: 2 numbers, must be 3: L r t"),
        (BARE + "L r q\n800 0.3 0.4", "column 'q' is not one of r, t, u, L"),
        (BARE + "L r\n800 x", "'x' is not a number"),
        (BARE + "L r n\n800 0.3 1.3\n900 0.3 1.5", "n goes from 1.3 to 1.5"),
    ],
)
def test_bad_files_are_refused_on_one_line(tmp_path, text, words):
    with pytest.raises(ValueError, match=words) as refused:
        read_slab(written(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_rows_by_their_wavelengths(tmp_path):
    path = written(tmp_path, BARE + "L r n\n800 0.3 1.3\n900 0.2 1.5")
    slab = read_slab(path, wavelengths=(850, 950))
    assert (slab.ior, slab.totals.values.tolist()) == (1.5, [[0.2]])
    with pytest.raises(ValueError, match=r"no row lies in \[100, 200\] nm; they go from 800 to 900"):
        read_slab(path, wavelengths=(100, 200))
