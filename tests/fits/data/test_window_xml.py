"""XML of WINDOW and Radiance: what stands before it, and trees of tensors by hand.

Matrices of WINDOW are read beside what is written, in `tests/fits/exports/test_klems.py`.
"""

import tracemalloc

import numpy as np
import pytest

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


TREE, FINE = "{ {1} {2} {3} {4} {5} {6} {%s} {8} }", " 10 11 12 13 14 15 16 17 "


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
