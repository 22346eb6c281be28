"""Input files of inverse adding-doubling: both ways to write them, and what is refused."""

from functools import partial

import numpy as np
import pytest

import layerjax as lj
from fits.cli.parser import main
from fits.data.formats.rxt import SMOOTH, read_slab
from fits.data.reading import read
from tests.helpers import data_files

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


written = partial(data_files.written, name="slab.rxt")


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
        ("IAD1 1.4 1.0", "2 numbers, must be 17 before the measurements"),
        (BARE, "no measurements after the description"),
        (BARE + "8\n0.3", r"line 12, column 'number of measurements': 8 is not allowed, must be a number in \[1, 7\]"),
        (BARE + "2\n800 0.3 0.4\n810 0.2", "line 14: 2 numbers, must be 3: L r t"),
        (BARE + "L r z\n800 0.3 0.4", "column 'z' is not one of r, t, u, L"),
        (BARE + "L r r\n800 0.3 0.4", "column 'r' appears twice"),
        (BARE + "r i\n0.3 95", r"incidence is \[95.0\], must be in \[0, 90\)"),
        (BARE + "r c\n0.3 0", "c, the share of what is mirrored that M_R holds, is 0, must be 1"),
        (BARE + "r E\n0.3 0.5", "E, the optical depth of a slide, is 0.5, must be 0"),
        (BARE + "r D\n0.3 0\n0.3 1", "D is 0 in some rows only"),
        (BARE + "L r i\n800 0.3 8\n900 0.3 30", "rows at 30 degrees have other wavelengths than those at 8"),
        (SAMPLE.format(spheres=1) + "r w\n0.3 0.95\n0.3 0.98", "w, the reflectance of the wall.*restrict the wave"),
        (BARE + "r S\n0.3 0\n0.3 1", "the number of spheres varies"),
        (BARE + "L r\n800 x", "'x' is not a number"),
        (
            BARE + "L r n\n800 0.3 1.3\n900 0.3 1.5",
            "n, the index of the sample, goes from 1.3 to 1.5, and one slab has one: restrict the wav",
        ),
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
    for bad in ([800, 850, 900], (900, 800), 850, ("a", "b"), (800, float("nan"))):
        with pytest.raises(
            ValueError, match=r"wavelengths is .*, must be two numbers in nm, the lowest and the highest"
        ):
            read_slab(path, wavelengths=bad)


def test_incidence_may_be_a_column(tmp_path):
    slab = read_slab(written(tmp_path, BARE + "Lrti\n800 0.3 0.4 8\n900 0.2 0.5 8\n800 0.35 0.3 30\n900 0.25 0.4 30\n"))
    np.testing.assert_allclose(slab.totals.theta_i, [8, 30, 8, 30])
    assert slab.totals.channels == ("800 nm", "900 nm")
    np.testing.assert_allclose(slab.totals.values, [[0.3, 0.2], [0.35, 0.25], [0.4, 0.5], [0.3, 0.4]])
    np.testing.assert_allclose(slab.wavelengths, [800, 900])
    path = written(tmp_path, BARE + "r i\n0.3 8\n0.4 8\n")
    np.testing.assert_allclose(read_slab(path).totals.theta_i, 8)
    assert read_slab(path).totals.channels == ("row 1", "row 2")
    with pytest.raises(ValueError, match="incidence is 5, and the file has a column i of its own"):
        read_slab(path, incidence=5.0)
    assert read_slab(written(tmp_path, BARE + "1\n0.3\n")).totals.theta_i[0] == 0.0


def test_columns_say_more_than_the_header(tmp_path):
    """As iad 4 reads them: w without W is the wall of both spheres, no slide where its thickness is 0."""
    one = SAMPLE.format(spheres=1)
    slab = read_slab(written(tmp_path, one + "- r t w R S n N d D a q\n0.3 0.4 0.97 0.99 2 1.41 1.52 3 1 0.9 16\n"))
    spheres = slab.totals.spheres
    assert (spheres.reflection.wall, spheres.transmission.wall, spheres.standard) == (0.97, 0.97, 0.99)
    assert spheres.together
    assert (slab.ior, slab.ior_slides, slab.thickness_mm) == (1.41, 1.52, 3.0)
    assert slab.totals.source.notes == ("columns not used: a (albedo), q (quadrature)",)
    slab = read_slab(written(tmp_path, one + "r W w D\n0.3 0.96 0.97 0\n"))
    assert (slab.totals.spheres.reflection.wall, slab.totals.spheres.transmission.wall) == (0.97, 0.96)
    assert slab.ior_slides == 1.0
    slab = read_slab(written(tmp_path, one + "6\n0.3 0.4 0.1 0.95 0.96 0.99\n"))
    assert slab.totals.kinds == ("reflectance", "transmittance", "unscattered")
    spheres = slab.totals.spheres
    assert (spheres.reflection.wall, spheres.transmission.wall, spheres.standard) == (0.95, 0.96, 0.99)


@pytest.mark.parametrize(
    "comment",
    ["measured by a dual beam spectrometer", "Process this file as 'iad -X -i 8 -g 0.9 filename'", "dual-beam method"],
)
def test_two_beams_need_no_sphere(tmp_path, comment):
    """iad's ``-X``, which such a file asks for: what is read is the sample's own."""
    rows = "2\n0.3 0.4\n"
    path = written(tmp_path, SAMPLE.format(spheres=1).replace("a slab", comment) + rows)
    slab = read_slab(path)
    assert slab.totals.spheres is None
    assert "two beams were compared: spheres are ignored" in slab.totals.source.notes[0]
    assert read_slab(path, corrected=False).totals.spheres is not None
    assert read_slab(path, corrected=True).totals.spheres is None
    path = written(tmp_path, SAMPLE.format(spheres=2).replace("a slab", comment) + rows)
    with pytest.raises(ValueError, match="two beams were compared, and the header that two spheres stand together"):
        read_slab(path)
    path = written(tmp_path, SAMPLE.format(spheres=1).replace("a slab", "iad -x 8 -g 0.9") + rows)
    assert read_slab(path).totals.spheres is not None


def test_the_command_line_chooses_rows_and_spheres(tmp_path, capsys):
    path = written(tmp_path, SAMPLE.format(spheres=1) + "L r n\n600 0.3 1.3\n620 0.25 1.3\n900 0.2 1.5\n")
    words = ["info", str(path), "--out", str(tmp_path / "a.png"), "--force"]
    assert main(words) == 2
    assert "restrict the wavelengths" in capsys.readouterr().err
    assert main([*words, "--read", "wavelengths=600,620"]) == 0
    told = capsys.readouterr().out
    assert "600 nm, 620 nm" in told
    assert "as measured with an integrating sphere" in told
    assert main([*words, "--read", "wavelengths=600,620", "corrected=yes"]) == 0
    assert "integrating sphere" not in capsys.readouterr().out
    assert main(["convert", str(path), str(tmp_path / "a.csv"), "--read", "wavelengths=600,620", "corrected=yes"]) == 0
    np.testing.assert_allclose(read(tmp_path / "a.csv").values, [[0.3, 0.25]])
    capsys.readouterr()
    assert main(["info", str(tmp_path / "a.csv"), "--read", "corrected=yes"]) == 2
    assert "wavelengths and corrected apply to rxt files only" in capsys.readouterr().err
    assert main([*words, "--read", "wavelengths=600,610,620"]) == 2
    assert "it must be the lowest and the highest in nm, as in 600,620" in capsys.readouterr().err
