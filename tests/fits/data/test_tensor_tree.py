"""Tensor trees: boxes and their order against numbers written down by hand, and against Radiance's own reader."""

import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fits.data.formats.tensor_tree import boxes, disk, look_up, parse
from fits.data.geometry import Floats
from fits.data.reading import read
from tests.helpers import data_files

HEAD = "<?xml version='1.0'?>\n<WindowElement><Optical><Layer><DataDefinition><IncidentDataStructure>TensorTree{rank}"
HEAD += "</IncidentDataStructure></DataDefinition>"
BLOCK = """<WavelengthData><Wavelength unit='Integral'>{colour}</Wavelength><WavelengthDataBlock>
<WavelengthDataDirection>{name}</WavelengthDataDirection><AngleBasis>LBNL/Shirley-Chiu</AngleBasis>
<ScatteringData>{tree}</ScatteringData></WavelengthDataBlock></WavelengthData>"""
TAIL = "</Layer></Optical></WindowElement>\n"
EIGHT = "{ {1} {2} {3} {4} {5} {6} {7} { 10 11 12 13 14 15 16 17 } }"


def _xml(rank: int, *parts: tuple[str, str, str]) -> str:
    blocks = "".join(BLOCK.format(colour=colour, name=name, tree=tree) for colour, name, tree in parts)
    return HEAD.format(rank=rank) + blocks + TAIL


_file = partial(data_files.written, name="tree.xml")


def test_boxes_by_hand() -> None:
    """The first axis is the lowest bit of a node, and the slowest of a grid."""
    found = boxes(parse(EIGHT, 3), 3)
    at = {tuple(low): (edge, value) for low, edge, value in zip(found.low, found.edge, found.values, strict=True)}
    assert at[0.5, 0.0, 0.0] == (0.5, 2.0)
    assert at[0.0, 0.5, 0.0] == (0.5, 3.0)
    assert at[0.0, 0.0, 0.5] == (0.5, 5.0)
    assert at[0.5, 0.5, 0.75] == (0.25, 11.0)
    assert at[0.75, 0.5, 0.5] == (0.25, 14.0)
    assert len(at) == 15


def test_nodes_of_equal_grids_become_one() -> None:
    grid = parse("{ {1} {2} {3} {4} {5} {6} {7} {8} }", 3)
    assert isinstance(grid, np.ndarray)
    assert grid.shape == (2, 2, 2)
    assert (grid[1, 0, 0], grid[0, 1, 0], grid[0, 0, 1]) == (2.0, 3.0, 5.0)
    twice = parse(
        "{" + " ".join(f"{{ {' '.join(str(10 * node + i) for i in range(8))} }}" for node in range(8)) + "}", 3
    )
    assert isinstance(twice, np.ndarray)
    assert twice.shape == (4, 4, 4)
    assert twice[2, 1, 3] == 10 * 5 + 3  # node: first and last axis above the middle, 1 + 4; in it 0, 1, 1


def test_look_up_finds_each_box() -> None:
    tree = parse(EIGHT, 3)
    found = boxes(tree, 3)
    np.testing.assert_array_equal(look_up(tree, found.low + 0.5 * found.edge[:, None]), found.values)


def test_disk_has_the_area_of_the_square() -> None:
    """Points on concentric squares land on concentric circles; the map keeps areas."""
    u, v = np.random.default_rng(0).random((2, 2000))
    square = np.stack([u, v], axis=-1)
    np.testing.assert_allclose(np.hypot(*disk(square).T), abs(2 * square - 1).max(axis=1), atol=1e-12)
    step = 1e-6
    along, across = np.array([step, 0.0]), np.array([0.0, step])
    du = (disk(square + along) - disk(square - along)) / (2 * step)
    dv = (disk(square + across) - disk(square - across)) / (2 * step)
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    assert np.median(abs(area - np.pi)) < 1e-6
    edges = np.array([[1.0, 0.5], [0.5, 1.0], [0.0, 0.5], [0.5, 0.5]])
    np.testing.assert_allclose(disk(edges), [[1, 0], [0, 1], [-1, 0], [0, 0]], atol=1e-12)


def test_isotropic_by_hand(tmp_path: Path) -> None:
    """In eight boxes: light at sin theta 0.5; the upper half of the first axis is empty."""
    tree = "{ {1} {0} {3} {0} {5} {0} {7} {0} }"
    data = read(_file(tmp_path, _xml(3, ("Visible", "Reflection Front", tree))))
    assert data.source.format == "tensortree"
    np.testing.assert_allclose(data.theta_i, 30.0)
    np.testing.assert_allclose(data.phi_i, 180.0)
    # middles of the quarters of the square are half way out on the diagonals; x ahead of the light, y turned with z
    got = {
        float(value): (phi, theta)
        for value, phi, theta in zip(data.values[:, 0], data.phi_o, data.theta_o, strict=True)
    }
    assert got.keys() == {1.0, 3.0, 5.0, 7.0}
    assert {value: round(phi) for value, (phi, _) in got.items()} == {1.0: 135, 3.0: 45, 5.0: 225, 7.0: 315}
    np.testing.assert_allclose([theta for _, theta in got.values()], 30.0)


def test_sides(tmp_path: Path) -> None:
    parts = [
        ("Visible", f"{kind} {side}", "{0.3}") for kind in ("Reflection", "Transmission") for side in ("Front", "Back")
    ]
    data = read(_file(tmp_path, _xml(4, *parts)))
    np.testing.assert_array_equal(np.sign(data.wi[:, 2]), [1, -1, 1, -1])
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), [1, -1, -1, 1])
    np.testing.assert_array_equal(data.mask, [True, True, False, False])  # one box: it holds what passes straight


def test_colours(tmp_path: Path) -> None:
    """u' = 0.1978, v' = 0.4683 are D65: X and Z beside Y are those of the white point."""
    parts = [("Visible", "Reflection Front", EIGHT), ("CIE-u", "Reflection Front", "{0.19784}")]
    data = read(_file(tmp_path, _xml(3, *parts, ("CIE-v", "Reflection Front", "{0.46834}"))))
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_allclose(
        data.values / data.values[:, 1:2], np.tile([0.95047, 1, 1.08883], (len(data), 1)), rtol=1e-3
    )


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ("{1 2 3}", "a grid of 3 numbers, must be a power of 8"),
        ("{ {1} {2} }", "a node of 2, must be 8"),
        ("{ {1} {2}", "has no end"),
        ("{1} }", "a '}' too many"),
        ("{x}", "could not convert string to float"),
        ("{nan}", "holds nan, must be finite"),
        ("", "there is no tree"),
        ("{1} 2", "numbers beside nodes"),
        ("{" * 30, "deeper than"),
    ],
)
def test_bad_trees(tmp_path: Path, tree: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read(_file(tmp_path, _xml(3, ("Visible", "Reflection Front", tree))))
    assert "tree.xml: reflection front" in str(error.value)


def test_a_million_values_in_seconds() -> None:
    values = " ".join(["0.123456"] * 16)
    node = "{" + f"{{{values}}} " * 16 + "}"
    tree = "{" + ("{" + ("{" + node * 16 + "}") * 16 + "}") * 16 + "}"
    assert boxes(parse(tree, 4), 4).values.size == 16**5


FUNCTION = "f(ix,iy,iz,ox,oy,oz)=.16+.03*(ix*oy-iy*ox)+if(iz,.03,.01)+if(iz*oz,.4,.9)*exp(-6*((ix+ox)^2+(iy+oy)^2))"


def _true(wi: Floats, wo: Floats) -> Floats:
    """FUNCTION: turned about the normal it stays, mirrored it does not."""
    x, y = (wi + wo).T[:2]
    turned = 0.03 * (wi[:, 0] * wo[:, 1] - wi[:, 1] * wo[:, 0])
    lobe = np.where(wi[:, 2] * wo[:, 2] > 0, 0.4, 0.9) * np.exp(-6 * (x**2 + y**2))
    return np.asarray(0.16 + turned + np.where(wi[:, 2] > 0, 0.03, 0.01) + lobe)


QUERY = """
import os, sys
import numpy as np
from pyradiance import bsdf
tree = bsdf.load_file(sys.argv[1] + "/tree.xml")
angles = np.load(sys.argv[1] + "/angles.npy").tolist()
np.save(sys.argv[1] + "/values.npy", [float(bsdf.query(tree, *row)[1]) for row in angles])
os._exit(0)
"""


@pytest.mark.peers
@pytest.mark.parametrize("rank", [3, 4])
def test_radiance_finds_the_same_values(tmp_path: Path, rank: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tree that Radiance makes of a formula: its own reader and the formula, at all middles of boxes, all sides."""
    pyradiance = pytest.importorskip("pyradiance")
    root = Path(pyradiance.__file__).parent
    if not (root / "bin" / "bsdf2ttree").exists():
        pytest.skip("no bsdf2ttree")
    monkeypatch.setenv("PATH", f"{root / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("RAYPATH", str(root / "lib"))
    command = ["bsdf2ttree", "-g", "4" if rank == 3 else "3", f"-t{rank}", "+f", "+b", "-e", FUNCTION, "f"]
    path = tmp_path / "tree.xml"
    path.write_bytes(subprocess.run(command, check=True, capture_output=True).stdout)
    data = read(path)
    assert len(re.findall("WavelengthDataDirection>\\w", path.read_text())) == 4
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
    error = abs(data.values[:, 0] / _true(wi, wo) - 1)
    assert np.median(error) < (0.04 if rank == 3 else 0.12)  # of means over boxes, 16 and 8 along an axis
