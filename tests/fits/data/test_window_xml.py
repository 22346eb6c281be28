"""XML of WINDOW and Radiance, by hand and by Radiance's own programs; matrices as exported: `exports/test_klems.py`."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import direction, slices
from fits.data.reading import read
from tests.helpers.data_files import written

MATRIX = """<?xml version="1.0" encoding="UTF-8"?>
<WindowElement xmlns="http://windows.lbl.gov"><Optical><Layer><DataDefinition>
<IncidentDataStructure>Columns</IncidentDataStructure><AngleBasis><AngleBasisName>two</AngleBasisName>
<AngleBasisBlock><Theta>0</Theta><nPhis>1</nPhis><ThetaBounds><LowerTheta>0</LowerTheta><UpperTheta>90</UpperTheta>
</ThetaBounds></AngleBasisBlock></AngleBasis></DataDefinition><WavelengthData><Wavelength>Visible</Wavelength>
<WavelengthDataBlock><WavelengthDataDirection>Reflection Back</WavelengthDataDirection>
<ColumnAngleBasis>two</ColumnAngleBasis><RowAngleBasis>two</RowAngleBasis><ScatteringData>0.25</ScatteringData>
</WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>
"""
BLOCK = """<WavelengthData><Wavelength unit='Integral'>{colour}</Wavelength><WavelengthDataBlock>
<WavelengthDataDirection>{side}</WavelengthDataDirection><AngleBasis>LBNL/Shirley-Chiu</AngleBasis>
<ScatteringData>{tree}</ScatteringData></WavelengthDataBlock></WavelengthData>"""
TREE, FINE = "{ {1} {2} {3} {4} {5} {6} {%s} {8} }", " 10 11 12 13 14 15 16 17 "
FUNCTION = "f(ix,iy,iz,ox,oy,oz)=.16+.03*(ix*oy-iy*ox)+if(iz,.03,.01)+if(iz*oz,.4,.9)*exp(-6*((ix+ox)^2+(iy+oy)^2))"
QUERY = """
import os, sys
import numpy as np
from pyradiance import bsdf
tree = bsdf.load_file(sys.argv[1] + "/tree.xml")
angles = np.load(sys.argv[1] + "/angles.npy").tolist()
np.save(sys.argv[1] + "/values.npy", [float(bsdf.query(tree, *row)[1]) for row in angles])
os._exit(0)
"""


def xml(rank, *blocks):
    """Trees: each a tree, and of what side and colour it is, if not of the usual."""
    head = f"<IncidentDataStructure>TensorTree{rank}</IncidentDataStructure>"
    usual = {"colour": "Visible", "side": "Reflection Front"}
    body = "".join(BLOCK.format(tree=tree, **usual | said) for tree, said in blocks)
    layer = f"<Optical><Layer><DataDefinition>{head}</DataDefinition>{body}</Layer></Optical>"
    return f"<WindowElement>{layer}</WindowElement>\n"


@pytest.mark.parametrize(("kind", "text"), [("klems", MATRIX), ("tensortree", xml(3, ("{0.25}", {})))])
def test_what_stands_before_is_no_part_of_it(reading, kind, text):
    for before in ("written by a laboratory\n", "# of <us>\n", "<!-- genBSDF -n 4 -->\n"):
        data = reading(before + text)
        assert (data.source.format, data.values.tolist()) == (kind, [[0.25]])


def test_rings_stand_for_no_more_patches_than_there_may_be(reading):
    ring = MATRIX[MATRIX.index("<AngleBasisBlock>") : MATRIX.index("</AngleBasis>")]
    many = 20_000 * ring.replace("<nPhis>1<", "<nPhis>2000<")
    tracemalloc.start()
    with pytest.raises(ValueError, match="two: 4000 patches or more, must be 2000 at most"):
        reading(MATRIX.replace("<AngleBasisBlock>", f"{many}<AngleBasisBlock>", 1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # 40 million patches would take a GB


@pytest.mark.parametrize("fine", ["7", FINE])
def test_an_isotropic_tree_by_hand(reading, fine):
    """The first axis is the lowest bit of a node, and the slowest of a grid; squares become circles."""
    data = reading(xml(3, (TREE % fine, {})))
    np.testing.assert_allclose(data.phi_i, 180.0)
    angles = np.round([data.theta_i, data.theta_o, data.phi_o], 2).T.tolist()
    low, high = np.round(np.degrees(np.arcsin([0.25, 0.75])), 2)
    # x is ahead of the light, y turned with z; along a side of a square azimuths are even
    expected = {1: [30, 30, 135], 3: [30, 30, 45], 5: [30, 30, 225]} | ({7: [30, 30, 315]} if fine == "7" else {})
    for first, theta_i in ((10, high), (14, low)) if fine != "7" else ():
        for place, phi in enumerate((315, 285, 345, 315)):
            expected[first + place] = [theta_i, high if place else low, phi]
    assert dict(zip(data.values[:, 0], angles, strict=True)) == expected


def test_sides_and_colours_of_trees(reading):
    sides = [f"{kind} {side}" for kind in ("Reflection", "Transmission") for side in ("Front", "Back")]
    data = reading(xml(4, *(("{0.3}", {"side": side}) for side in sides)))
    np.testing.assert_array_equal(np.sign(data.wi[:, 2]), [1, -1, 1, -1])
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), [1, -1, -1, 1])
    np.testing.assert_array_equal(data.mask, [True, True, False, False])  # one box: it holds what passes straight
    # u' = 0.1978, v' = 0.4683 are D65: X and Z beside Y are those of the white point
    tree, v = (TREE % FINE, {}), ("{0.46834}", {"colour": "CIE-v"})
    data = reading(xml(3, tree, ("{0.19784}", {"colour": "CIE-u"}), v))
    assert data.channels == ("X", "Y", "Z")
    white = np.tile([0.95047, 1, 1.08883], (len(data), 1))
    np.testing.assert_allclose(data.values / data.values[:, 1:2], white, rtol=1e-3)
    # u' a hundredth of what Y is there: X is 9 u' / 4 v' of it
    u = "{ {.01} {.02} {.03} {.04} {.05} {.06} { .1 .11 .12 .13 .14 .15 .16 .17 } {.08} }"
    data = reading(xml(3, tree, (u, {"colour": "CIE-u"}), v))
    np.testing.assert_allclose(data.values[:, 0], 0.0225 * data.values[:, 1] ** 2 / 0.46834)


@pytest.fixture
def programs(monkeypatch):
    root = Path(pytest.importorskip("pyradiance").__file__).parent
    if not (root / "bin" / "bsdf2ttree").exists():
        pytest.skip("no bsdf2ttree")
    monkeypatch.setenv("PATH", f"{root / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("RAYPATH", str(root / "lib"))


def output(*words):
    return subprocess.run([*map(str, words)], check=True, capture_output=True).stdout


@pytest.mark.peers
def test_radiance_takes_the_azimuths_of_pab_as_we_do(tmp_path, programs):
    """A lobe off the plane of incidence, by `pabopto2bsdf` and `bsdf2ttree`, lies where our reading of the file is."""
    names = []
    for theta in (0.0, 20.0, 40.0, 60.0):  # the same azimuth: isotropic
        geometry = slices([theta], np.arange(0, 85, 2.5), list(np.arange(0, 360, 10.0)))
        peak = direction(theta, 180 + 30)
        value = 0.05 + 2.0 * np.exp(-20 * (1 - geometry.wo @ peak))
        rows = np.stack([geometry.theta_o, geometry.phi_o, value], axis=-1)
        names.append(tmp_path / f"{theta:g}.dat")
        head = f"#incident_angle {theta} 0\n#format: theta phi BSDF\n#upphi 90"
        np.savetxt(names[-1], rows, "%.6g", header=head, comments="")
    written(tmp_path, output("pabopto2bsdf", "-s", "i", *names), "a.sir")
    theirs = read(written(tmp_path, output("bsdf2ttree", "-g", "5", tmp_path / "a.sir"), "a.xml"))
    ours = read(tmp_path / "40.dat")

    def off_plane(data) -> float:
        """Azimuth of the mean direction of the lobe, from where the light travels."""
        near = (abs(data.theta_i % 180 - (40 if data is ours else 140)) < 6) & (data.values[:, 0] > 0.5)
        azimuth = np.radians(data.phi_o[near] - data.phi_i[near] - 180)
        return float(np.degrees(np.angle(np.sum(data.values[near, 0] * np.exp(1j * azimuth)))))

    assert off_plane(ours) == pytest.approx(30, abs=1)
    # its z points to the room, to WINDOW's back: turned over, azimuths run the other way
    assert set(np.sign(theirs.wi[:, 2])) == {-1}
    assert off_plane(theirs) == pytest.approx(-30, abs=2)  # it fits a sum of Gaussians, in boxes of 4 degrees and more


def true(wi, wo):
    """FUNCTION: turned about the normal it stays, mirrored it does not."""
    x, y = (wi + wo).T[:2]
    turned = 0.03 * (wi[:, 0] * wo[:, 1] - wi[:, 1] * wo[:, 0])
    lobe = np.where(wi[:, 2] * wo[:, 2] > 0, 0.4, 0.9) * np.exp(-6 * (x**2 + y**2))
    return 0.16 + turned + np.where(wi[:, 2] > 0, 0.03, 0.01) + lobe


@pytest.mark.peers
@pytest.mark.parametrize("rank", [3, 4])
def test_radiance_finds_the_same_values(tmp_path, programs, rank):
    """A tree that Radiance makes of a formula: its own reader and the formula, at all middles of boxes, all sides."""
    words = ["-g", "4" if rank == 3 else "3", f"-t{rank}", "+f", "+b", "-e", FUNCTION, "f"]
    path = written(tmp_path, output("bsdf2ttree", *words), "tree.xml")
    data = read(path)
    sides = data.wi[:, 2] > 0, data.wo[:, 2] > 0
    assert {tuple(pair) for pair in np.transpose(sides)} == {(a, b) for a in (True, False) for b in (True, False)}

    turn = np.array([-1, 1, -1])  # Radiance's z points to the room, and WINDOW's front to the outside
    wi, wo = data.wi * turn, data.wo * turn
    angles = [np.degrees([np.arccos(w[:, 2]), np.arctan2(w[:, 1], w[:, 0])]).T for w in (wi, wo)]
    np.save(tmp_path / "angles.npy", np.hstack(angles))
    # in a process of its own: freeing several trees in one corrupts memory (pyradiance 1.3.1)
    subprocess.run([sys.executable, "-c", QUERY, str(tmp_path)], check=True, timeout=60)
    theirs = np.load(tmp_path / "values.npy")
    # it dithers values by 1e-4 for each axis
    np.testing.assert_allclose(data.values[:, 0], theirs, rtol=5e-4)
    error = abs(data.values[:, 0] / true(wi, wo) - 1)
    assert np.median(error) < (0.04 if rank == 3 else 0.12)  # of means over boxes, 16 and 8 along an axis
