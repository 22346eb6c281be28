"""XML of WINDOW and Radiance: what stands before it, and trees of tensors, boxes and their order by hand.

Matrices of WINDOW are read beside what is written, in `tests/fits/exports/test_klems.py`.
"""

import tracemalloc

import numpy as np
import pytest

from fits.data.formats.tensor_tree import boxes, disk, look_up, parse

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


EIGHT = "{ {1} {2} {3} {4} {5} {6} {7} { 10 11 12 13 14 15 16 17 } }"


def test_boxes_by_hand():
    """The first axis is the lowest bit of a node, and the slowest of a grid."""
    tree = parse(EIGHT, 3)
    found = boxes(tree, 3)
    at = {tuple(low): (edge, value) for low, edge, value in zip(found.low, found.edge, found.values, strict=True)}
    assert len(at) == 15
    expected = {(0.5, 0.0, 0.0): (0.5, 2.0), (0.0, 0.5, 0.0): (0.5, 3.0), (0.5, 0.5, 0.75): (0.25, 11.0)}
    assert expected.items() <= at.items()
    np.testing.assert_array_equal(look_up(tree, found.low + 0.5 * found.edge[:, None]), found.values)


def test_the_disk_has_the_area_of_the_square():
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


def test_an_isotropic_tree_by_hand(reading):
    data = reading(xml(3, ("{ {1} {0} {3} {0} {5} {0} {7} {0} }", {})))
    np.testing.assert_allclose(data.theta_i, 30.0)
    np.testing.assert_allclose(data.phi_i, 180.0)
    # middles of the quarters of the square are half way out on the diagonals; x ahead of the light, y turned with z
    assert dict(zip(data.values[:, 0], data.phi_o.round(), strict=True)) == {1.0: 135, 3.0: 45, 5.0: 225, 7.0: 315}
    np.testing.assert_allclose(data.theta_o, 30.0)


def test_sides_of_trees(reading):
    sides = [f"{kind} {side}" for kind in ("Reflection", "Transmission") for side in ("Front", "Back")]
    data = reading(xml(4, *(("{0.3}", {"side": side}) for side in sides)))
    np.testing.assert_array_equal(np.sign(data.wi[:, 2]), [1, -1, 1, -1])
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), [1, -1, -1, 1])
    np.testing.assert_array_equal(data.mask, [True, True, False, False])  # one box: it holds what passes straight


def test_colours_of_trees(reading):
    """u' = 0.1978, v' = 0.4683 are D65: X and Z beside Y are those of the white point."""
    data = reading(xml(3, (EIGHT, {}), ("{0.19784}", {"colour": "CIE-u"}), ("{0.46834}", {"colour": "CIE-v"})))
    assert data.channels == ("X", "Y", "Z")
    white = np.tile([0.95047, 1, 1.08883], (len(data), 1))
    np.testing.assert_allclose(data.values / data.values[:, 1:2], white, rtol=1e-3)
