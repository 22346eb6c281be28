"""Input files of inverse adding-doubling: both ways to write them, their columns, spheres and comments."""

import numpy as np
import pytest

import layerjax as lj
from fits import Sphere, Spheres, read, read_slab
from tests.helpers.data_files import RXT, written
from tests.helpers.refusals import refuses

BARE, ONE = RXT.format(spheres=0), RXT.format(spheres=1)
STACKS = {(1.5, 1.4): [1.5, 1.4, None, 1.5, 1.0], (1.0, 1.4): [1.4, None, 1.0], (1.5, 1.5): [1.5, None, 1.0]}


@pytest.fixture
def slab(tmp_path):
    return lambda text, **options: read_slab(written(tmp_path, text, "slab.rxt"), **options)


def test_rows_by_a_count(slab):
    found = slab(f"{BARE}2 # R, T\n800 0.3 0.4\n810, 0.2, 0.5  # comma\n", sigma=0.02)
    assert (found.ior, found.ior_slides, found.thickness_mm) == (1.4, 1.5, 2.0)
    assert found.totals.channels == ("800 nm", "810 nm")
    assert found.totals.kinds == ("reflectance", "transmittance")
    np.testing.assert_allclose(found.totals.values, [[0.3, 0.2], [0.4, 0.5]])
    np.testing.assert_allclose(found.totals.sigma, 0.02)
    # all on one line, without wavelengths
    found = slab("IAD1 1.4 1.0 1 0 5 .96 0 200 25 12 1 .96 200 25 12 1 .96 2 0.168 0.249 0.162 0.264")
    assert (found.wavelengths, found.totals.channels, found.ior_slides) == (None, ("row 1", "row 2"), 1.0)
    np.testing.assert_allclose(found.totals.values, [[0.168, 0.162], [0.249, 0.264]])


@pytest.mark.parametrize(("slides", "ior"), STACKS)
def test_the_stack_is_the_slab(slab, slides, ior):
    text = BARE.replace("1.4 ", f"{ior} ").replace("1.5 ", f"{slides} ")
    stack = slab(f"{text}1\n0.3\n").stack(2.0, 0.1, lj.HenyeyGreenstein(0.8))
    assert [getattr(layer, "ior", None) for layer in stack.layers] == STACKS[slides, ior]
    assert all(layer.is_smooth for layer in stack.layers if isinstance(layer, lj.Interface))
    (medium,) = (layer for layer in stack.layers if isinstance(layer, lj.TurbidMedium))
    assert (medium.thickness_mm, medium.mu_s, medium.mu_a) == (2.0, 2.0, 0.1)


def test_rows_by_their_wavelengths(slab):
    text = f"{BARE}L r n\n800 0.3 1.3\n900 0.2 1.5"
    found = slab(text, wavelengths=(850, 950))
    assert (found.ior, found.totals.values.tolist()) == (1.5, [[0.2]])
    refuses(r"no row lies in \[100, 200\] nm; they go from 800 to 900", slab, text, wavelengths=(100, 200))
    for bad in ([800, 850, 900], (900, 800), 850, ("a", "b")):
        refuses(r"wavelengths is .*, must be two numbers in nm, the lowest and the hig", slab, text, wavelengths=bad)


def test_incidence_may_be_a_column(slab):
    found = slab(f"{BARE}Lrti\n800 0.3 0.4 8\n900 0.2 0.5 8\n800 0.35 0.3 30\n900 0.25 0.4 30\n")
    np.testing.assert_allclose(found.totals.theta_i, [8, 30, 8, 30])
    assert found.totals.channels == ("800 nm", "900 nm")
    np.testing.assert_allclose(found.totals.values, [[0.3, 0.2], [0.35, 0.25], [0.4, 0.5], [0.3, 0.4]])
    np.testing.assert_allclose(found.wavelengths, [800, 900])
    text = f"{BARE}r i\n0.3 8\n0.4 8\n"
    np.testing.assert_allclose(slab(text).totals.theta_i, 8)
    refuses("incidence is 5, and the file has a column i of its own", slab, text, incidence=5.0)


def test_columns_say_more_than_the_header(slab):
    """As iad 4 reads them: w without W is the wall of both spheres, no slide where its thickness is 0."""
    found = slab(f"{BARE}L r t u n g\n800 0.3 0.4 0.01 1.41 0.9\n810 0.2 0.5 0.02 1.412 0.8\n")
    assert found.totals.kinds == ("reflectance", "transmittance", "unscattered")
    assert found.ior == pytest.approx(1.411)
    np.testing.assert_allclose(found.asymmetry, [0.9, 0.8])

    def walls(spheres):
        return spheres.reflection.wall, spheres.transmission.wall

    found = slab(f"{ONE}- r t w R S n N d D a q\n0.3 0.4 0.97 0.99 2 1.41 1.52 3 1 0.9 16\n")
    assert (walls(found.totals.spheres), found.totals.spheres.standard) == ((0.97, 0.97), 0.99)
    assert found.totals.spheres.together
    assert (found.ior, found.ior_slides, found.thickness_mm) == (1.41, 1.52, 3.0)
    assert found.totals.source.notes == ("columns not used: a (albedo), q (quadrature)",)
    found = slab(f"{ONE}r W w D\n0.3 0.96 0.97 0\n")
    assert (walls(found.totals.spheres), found.ior_slides) == ((0.97, 0.96), 1.0)
    found = slab(f"{ONE}6\n0.3 0.4 0.1 0.95 0.96 0.99\n")
    assert found.totals.kinds[2] == "unscattered"
    assert (walls(found.totals.spheres), found.totals.spheres.standard) == ((0.95, 0.96), 0.99)


def test_headers_say_which_spheres(slab):
    text = "IAD1 1.4 1.0 1 0 5 0.98 {} 100 30 15 10 0.95 80 30 0 12 0.97 2 0.3 0.4"
    front, behind = Sphere(100.0, 30.0, 15.0, 10.0, 0.95), Sphere(80.0, 30.0, 0.0, 12.0, 0.97)
    for count, expected in ((0, None), (1, Spheres(front, behind, 0.98)), (2, Spheres(front, behind, 0.98, True))):
        assert slab(text.format(count)).totals.spheres == expected
        assert slab(text.format(count), corrected=True).totals.spheres is None
    none = text.format(1).replace(" 80 30 0 12 0.97", " 0 0 0 0 0")
    assert slab(none).totals.spheres == Spheres(front, None, 0.98)


@pytest.mark.parametrize("comment", ["a dual beam spectrometer", "as 'iad -X -i 8 -g 0.9 filename'", "dual-beam"])
def test_two_beams_need_no_sphere(slab, comment):
    """iad's ``-X``, which such a file asks for: what is read is the sample's own."""
    text = f"{ONE}2\n0.3 0.4\n".replace("a slab", comment)
    found = slab(text)
    assert "two beams were compared: spheres are ignored" in found.totals.source.notes[0]
    assert slab(text, corrected=False).totals.spheres is not None
    assert found.totals.spheres is slab(text, corrected=True).totals.spheres is None
    with pytest.raises(ValueError, match="two beams were compared, and the header that two spheres stand together"):
        slab(text.replace("1      # spheres", "2      # spheres"))
    assert slab(text.replace(comment, "iad -x 8 -g 0.9")).totals.spheres is not None


def test_the_command_line_chooses_rows_and_spheres(tmp_path, layerjax):
    path = written(tmp_path, f"{ONE}L r n\n600 0.3 1.3\n620 0.25 1.3\n900 0.2 1.5\n", "slab.rxt")
    out, chosen = tmp_path / "a.csv", "--read wavelengths=600,620"
    assert "must be two numbers in nm, the lowest" in layerjax(f"convert {path} {out} {chosen},700", 2).err
    for more, corrected in (("", False), ("corrected=yes", True)):
        said = layerjax(f"info {path} --out {tmp_path}/a.png --force {chosen} {more}").out
        assert "600 nm, 620 nm" in said
        assert ("as measured with an integrating sphere" in said) != corrected
    layerjax(f"convert {path} {out} {chosen} corrected=yes")
    np.testing.assert_allclose(read(out).values, [[0.3, 0.25]])
