"""Matrices of WINDOW: sums, symmetries and sides, beside the stack, also as Radiance reads them."""

import itertools
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import fits
import layerjax as lj

TRANSPORT = lj.SingleScattering()
FIBERS = lj.Medium(0.7, 0.9, lj.SGGX("fiber", 0.4, (1.0, 0.5, 0.6)))
SHEET = lj.Stack([lj.Medium(0.3, 0.0), FIBERS])  # what absorbs is on top: front and back differ
COUNTS = (1, 8, 16, 20, 24, 24, 24, 16, 12)
BOUNDS = (0, 5, 15, 25, 35, 45, 55, 65, 75, 90)
PROJECTED = np.repeat(-np.pi * np.diff(np.cos(np.radians(BOUNDS)) ** 2) / COUNTS, COUNTS)
"""Solid angles of the patches times their cosines, from the basis as it is published."""

WHITE = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""From linear sRGB to XYZ, by the matrix that the standard gives (IEC 61966-2-1)."""


def matrices(path):
    """By wavelength and direction, rows of light that leaves."""
    name, found = "{http://windows.lbl.gov}", {}
    for data in ElementTree.parse(path).getroot().iter(f"{name}WavelengthData"):
        block = data.find(f"{name}WavelengthDataBlock")
        words = block.findtext(f"{name}ScatteringData").replace(",", " ").split()
        direction = block.findtext(f"{name}WavelengthDataDirection")
        found[data.findtext(f"{name}Wavelength"), direction] = np.array(words, float).reshape(145, 145)
    return found


@pytest.fixture(scope="module")
def sheet_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("klems") / "sheet.xml"
    return fits.export(SHEET, path, "klems", transport=TRANSPORT).path


@pytest.mark.slow
def test_columns_hold_what_the_stack_sends(sheet_file):
    sheet = matrices(sheet_file)
    assert len(sheet) == 4
    for side, above in (("Front", True), ("Back", False)):
        down = lj.direction(0.0 if above else np.pi, 0.0)
        reflected, passed = (float(share[0]) for share in lj.albedo(SHEET, down, TRANSPORT))
        straight = float(lj.unscattered(SHEET, down)[0])
        sums = {kind: PROJECTED @ sheet["Visible", f"{kind} {side}"] for kind in ("Reflection", "Transmission")}
        # the first patch is 5 degrees wide
        assert sums["Reflection"][0] == pytest.approx(reflected, rel=0.01)
        assert sums["Transmission"][0] == pytest.approx(passed + straight, rel=0.01)


def test_unscattered_light_stays_in_its_patch(tmp_path):
    fits.export(lj.Stack([lj.Medium(0.5, 0.0)]), tmp_path / "dye.xml", "klems", transport=TRANSPORT)
    matrix = matrices(tmp_path / "dye.xml")["Visible", "Transmission Front"]
    assert np.count_nonzero(matrix) == 145
    squares = np.linspace(*np.sin(np.radians([BOUNDS[:-1], BOUNDS[1:]])) ** 2, 20001)  # of sines: even in flux
    passed = np.mean(np.exp(-0.5 / np.sqrt(np.maximum(1.0 - squares, 1e-12))), axis=0)
    np.testing.assert_allclose(np.diag(matrix) * PROJECTED, np.repeat(passed, COUNTS), rtol=1e-3, atol=1e-4)


def test_panes_mirror_and_pass_light_in_its_own_patch(tmp_path):
    fits.export(lj.Stack([lj.Interface(1.5), lj.Interface(1.0)]), tmp_path / "pane.xml", "klems")
    found = matrices(tmp_path / "pane.xml")
    shares = []
    for kind, side in itertools.product(("Reflection", "Transmission"), ("Front", "Back")):
        matrix = found["Visible", f"{kind} {side}"]
        assert np.count_nonzero(matrix) == 145
        shares.append(np.diag(matrix) * PROJECTED)
    np.testing.assert_allclose(shares[0] + shares[2], 1.0, atol=1e-4)
    np.testing.assert_allclose(shares[0], shares[1], atol=1e-4)
    assert shares[0][0] == pytest.approx(0.0769, abs=1e-4)


def test_colours_are_xyz_and_an_opaque_stack_has_no_back(tmp_path):
    stack = lj.Stack([], lj.Lambertian([0.8, 0.4, 0.2]))
    done = fits.export(stack, tmp_path / "paint.xml", "klems")
    found = matrices(tmp_path / "paint.xml")
    assert list(found) == [(name, "Reflection Front") for name in ("CIE-X", "Visible", "CIE-Z")]
    assert any("opaque: no data of the back" in note for note in done.notes)
    data = fits.read(tmp_path / "paint.xml")
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_allclose(data.values, np.tile(WHITE @ [0.8, 0.4, 0.2] / np.pi, (145**2, 1)), rtol=1e-5)
    text = (tmp_path / "paint.xml").read_text()
    (tmp_path / "paint.xml").write_text(text.replace("Reflection Front", "Reflection Back", 1))  # of Y alone
    data = fits.read(tmp_path / "paint.xml")
    assert (len(data), data.source.notes[-1]) == (145**2, "skipped: X and Z, the blocks are not those of the visible")


def test_what_is_written_is_read_with_axes_that_are_not_turned(sheet_file):
    data = fits.read(sheet_file)
    assert len(data) == 4 * 145**2
    assert np.count_nonzero(~data.mask) == 2 * 145  # what passes straight through
    data = data.used()
    steep = (abs(data.wi[:, 2]) > 0.5) & (abs(data.wo[:, 2]) > 0.5)

    def apart(mirror):
        wi, wo = data.wi[steep] * mirror, data.wo[steep] * mirror
        true = np.asarray(lj.evaluate(SHEET, wi, wo, TRANSPORT))
        return float(np.sqrt(np.mean((data.values[steep] - true) ** 2)) / np.sqrt(np.mean(true**2)))

    assert apart((1.0, 1.0, 1.0)) < 0.15
    for mirror in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, 1.0, -1.0)):
        assert apart(mirror) > 0.3


@pytest.mark.peers
def test_radiance_finds_sides_and_shares(sheet_file):
    """What its library sums over all that leaves, from patches 10 degrees wide; its z points where the room is."""
    bsdf = pytest.importorskip("pyradiance").bsdf
    read, every = bsdf.load_file(str(sheet_file)), bsdf.SAMPLE_ALL
    for theta in (20.0, 40.0, 140.0, 160.0):
        for phi in (0.0, 90.0, 200.0, 290.0):
            t, p = np.radians([theta, phi])
            wi = np.array([-np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), -np.cos(t)])
            reflected, passed = (float(share[0]) for share in lj.albedo(SHEET, wi, TRANSPORT))
            passed += float(lj.unscattered(SHEET, wi)[0])
            assert bsdf.direct_hemi(read, theta, phi, every & ~bsdf.SAMPLE_T) == pytest.approx(reflected, abs=0.02)
            assert bsdf.direct_hemi(read, theta, phi, every & ~bsdf.SAMPLE_R) == pytest.approx(passed, abs=0.02)
