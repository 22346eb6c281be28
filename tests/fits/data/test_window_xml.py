"""XML of WINDOW and Radiance that does not begin as XML does: known by what it holds, as for Radiance."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fits.data.reading import read

MATRIX = """<?xml version="1.0" encoding="UTF-8"?>
<WindowElement xmlns="http://windows.lbl.gov"><Optical><Layer><DataDefinition>
<IncidentDataStructure>Columns</IncidentDataStructure><AngleBasis><AngleBasisName>two</AngleBasisName>
<AngleBasisBlock><Theta>0</Theta><nPhis>1</nPhis><ThetaBounds><LowerTheta>0</LowerTheta><UpperTheta>90</UpperTheta>
</ThetaBounds></AngleBasisBlock></AngleBasis></DataDefinition><WavelengthData><Wavelength>Visible</Wavelength>
<WavelengthDataBlock><WavelengthDataDirection>Reflection Back</WavelengthDataDirection>
<ColumnAngleBasis>two</ColumnAngleBasis><RowAngleBasis>two</RowAngleBasis><ScatteringData>0.25</ScatteringData>
</WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>
"""
TREE = """<WindowElement><Optical><Layer><DataDefinition><IncidentDataStructure>TensorTree3</IncidentDataStructure>
</DataDefinition><WavelengthData><Wavelength>Visible</Wavelength><WavelengthDataBlock>
<WavelengthDataDirection>Reflection Back</WavelengthDataDirection><AngleBasis>LBNL/Shirley-Chiu</AngleBasis>
<ScatteringData>{0.25}</ScatteringData></WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>
"""


@pytest.mark.parametrize(
    "before",
    ["", "written by a laboratory\n", "# of <us>\n", "<!-- genBSDF -n 4 -->\n", "\n\n", "\ufeff", "\ufeff\n\n"],
)
@pytest.mark.parametrize(("kind", "text"), [("klems", MATRIX), ("tensortree", TREE)])
def test_what_stands_before_is_no_part_of_it(tmp_path: Path, kind: str, text: str, before: str) -> None:
    path = tmp_path / "shade.dat"
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes((before + text).encode(encoding))
        data = read(path)
        assert data.source.format == kind
        np.testing.assert_array_equal(data.values, np.full((1, 1), 0.25))


def test_other_xml_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "page.xml"
    path.write_text("<?xml version='1.0'?><html/>")
    with pytest.raises(ValueError, match=r"page\.xml: an XML file of <html>, must be a <WindowElement>"):
        read(path)


def test_rings_stand_for_no_more_patches_than_there_may_be(tmp_path: Path) -> None:
    ring = MATRIX[MATRIX.index("<AngleBasisBlock>") : MATRIX.index("</AngleBasis>")].replace(
        "<nPhis>1<", "<nPhis>2000<"
    )
    path = tmp_path / "rings.xml"
    path.write_text(MATRIX.replace("<AngleBasisBlock>", 20_000 * ring + "<AngleBasisBlock>", 1))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"rings\.xml: two: 4000 patches or more, must be 2000 at most"):
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # 40 million patches would take a GB
