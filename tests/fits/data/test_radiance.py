"""XML of Radiance's own programs, read as they read it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import direction, slices
from fits.data.reading import read
from tests.helpers.data_files import written

pytestmark = pytest.mark.peers


@pytest.fixture(autouse=True)
def programs(monkeypatch):
    root = Path(pytest.importorskip("pyradiance").__file__).parent
    if not (root / "bin" / "bsdf2ttree").exists():
        pytest.skip("no bsdf2ttree")
    monkeypatch.setenv("PATH", f"{root / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("RAYPATH", str(root / "lib"))


def output(*words):
    return subprocess.run([*map(str, words)], check=True, capture_output=True).stdout


def test_radiance_takes_the_azimuths_of_pab_as_we_do(tmp_path):
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


FUNCTION = "f(ix,iy,iz,ox,oy,oz)=.16+.03*(ix*oy-iy*ox)+if(iz,.03,.01)+if(iz*oz,.4,.9)*exp(-6*((ix+ox)^2+(iy+oy)^2))"


def true(wi, wo):
    """FUNCTION: turned about the normal it stays, mirrored it does not."""
    x, y = (wi + wo).T[:2]
    turned = 0.03 * (wi[:, 0] * wo[:, 1] - wi[:, 1] * wo[:, 0])
    lobe = np.where(wi[:, 2] * wo[:, 2] > 0, 0.4, 0.9) * np.exp(-6 * (x**2 + y**2))
    return 0.16 + turned + np.where(wi[:, 2] > 0, 0.03, 0.01) + lobe


QUERY = """
import os, sys
import numpy as np
from pyradiance import bsdf
tree = bsdf.load_file(sys.argv[1] + "/tree.xml")
angles = np.load(sys.argv[1] + "/angles.npy").tolist()
np.save(sys.argv[1] + "/values.npy", [float(bsdf.query(tree, *row)[1]) for row in angles])
os._exit(0)
"""


@pytest.mark.parametrize("rank", [3, 4])
def test_radiance_finds_the_same_values(tmp_path, rank):
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
