"""LightTools' dialect of the Zemax format: layout, sides, and errors."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import direction
from fits.data.reading import read
from tests.helpers import data_files

HEAD = """# a comment
Symmetry {symmetry}
SpectralContent {spectrum}
ScatterAzimuth 3
0 90 180
ScatterRadial 2
0 30
DataBegin
"""
TABLE = "AOI {aoi}\nPOI 0\nSide {side}\nWavelength 550\nScatterType {kind}\n{more}TIS 0.2\n{a} 1\n{a} 2\n{a} 3\n"


def _text(*tables: str, symmetry: str = "PlaneSymmetrical", spectrum: str = "Monochrome") -> str:
    return HEAD.format(symmetry=symmetry, spectrum=spectrum) + "".join(tables) + "DataEnd\n"


def _table(aoi=20, side="Front", kind="BRDF", more="", a=5) -> str:
    return TABLE.format(aoi=aoi, side=side, kind=kind, more=more, a=a)


_file = partial(data_files.written, name="a.bsdf")


def test_by_hand(tmp_path: Path) -> None:
    """Angles about the normal, the light at azimuth 90: the mirror direction is at 270."""
    data = read(_file(tmp_path, "LightTools BSDF\n" + _text(_table(), _table(60, a=7))))
    assert data.source.format == "lighttools"
    np.testing.assert_allclose(data.wi[0], direction(20, 90), atol=1e-15)
    np.testing.assert_array_equal(data.values[:, 0], [5, 1, 2, 3, 7, 1, 2, 3])  # the normal once
    np.testing.assert_allclose(data.wo[1:4], direction(30, [0, 90, 180]), atol=1e-15)


def test_sides_and_transmission(tmp_path: Path) -> None:
    tables = [_table(side=side, kind=kind) for side in ("Front", "Back") for kind in ("BRDF", "BTDF")]
    data = read(_file(tmp_path, _text(*tables, symmetry="Asymmetric")))
    np.testing.assert_array_equal(np.sign(data.wi[::4, 2]), [1, 1, -1, -1])
    np.testing.assert_array_equal(np.sign(data.wo[::4, 2]), [1, -1, -1, 1])


def test_colours_in_any_order(tmp_path: Path) -> None:
    tables = [_table(more=f"TristimulusValue Tris{name}\n", a=a) for name, a in (("Y", 2), ("X", 1), ("Z", 3))]
    data = read(_file(tmp_path, _text(*tables, spectrum="XYZ")), quantity="reflectance_factor")
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_allclose(data.values[0] * np.pi, [1, 2, 3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("AOI 20", "AOI 95"), "line 9, column 'AOI': 95 is not allowed"),
        (("AOI 20\n", ""), "line 13: a table without AOI"),
        (("Side Front", "Side Top"), "line 11: Side is 'Top', must be one of front, back"),
        (("5 2\n", "5\n"), "line 18, column 1: 'DataEnd' is not a number"),
        (("5 2\n", "5 2 9\n"), "7 numbers for values of a table, must be 6"),
        (("5 2\n", "5 x\n"), "line 16, column 2: 'x' is not a number"),
        (("DataEnd\n", ""), "the file ends where DataEnd is expected"),
        (("ScatterRadial 2\n0 30\n", ""), "line 6: the header ends here without scatterradial"),
        (("Monochrome", "RGB"), "line 3: SpectralContent is 'RGB'"),
        (("TIS 0.2", "Index 1.5"), "line 14: 'Index 1.5' found, must be one value after one of"),
        (("DataEnd\n", "DataEnd\n1 2\n"), "line 19: '1 2' found after the last table"),
    ],
)
def test_bad_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    text = _text(_table())
    assert change[0] in text
    with pytest.raises(ValueError, match=message):
        read(_file(tmp_path, text.replace(*change)), format="lighttools")


def test_a_table_twice_and_a_colour_missing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="line 18: this table stands twice"):
        read(_file(tmp_path, _text(_table(), _table())))
    with pytest.raises(ValueError, match="1 table of this AOI, must be 3"):
        read(_file(tmp_path, _text(_table(more="TristimulusValue TrisX\n"), spectrum="XYZ")))
