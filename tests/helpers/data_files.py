"""Files of every format that is read: small ones by what makes them, and any text as one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

import fits
import layerjax as lj
from tests.helpers.merl import SHAPE
from tests.helpers.places import ROOT

COATINGS = ROOT / "examples" / "arizona_black_coatings"
PAINT = lj.Stack([], lj.Lambertian(0.4))


def written(folder: Path, text: str | bytes, name: str) -> Path:
    """A file of this name that holds the text."""
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def csv(folder: Path) -> bytes:
    return b"\n".join((COATINGS / "aeroglaze_650nm_inplane.csv").read_bytes().splitlines()[:60])


def totals(folder: Path) -> bytes:
    return b"theta_i,total_reflectance,total_reflectance_std\n8,0.31,0.01\n20,0.32,0.01\n45,0.4,0.02\n"


def merl(folder: Path) -> bytes:
    return np.array(SHAPE, "<i4").tobytes() + np.full((3, *SHAPE), 0.2).tobytes()


def exported(to: str, ending: str) -> Callable[[Path], bytes]:
    def of(folder: Path) -> bytes:
        path = folder / f"paint{ending}"
        fits.export(PAINT, path, to)  # type: ignore[arg-type]
        return path.read_bytes()

    return of


RXT = """\
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

ZEMAX = """\
# comment
Source Measured
Symmetry PlaneSymmetrical
SpectralContent Monochrome
ScatterType BRDF
SampleRotation 1
0
AngleOfIncidence 2
20 60
ScatterAzimuth 3
0 90 180
ScatterRadial 2
0 25

Monochrome
DataBegin
TIS 0.1
1 2
1 3
1 4
TIS 0.1
5 6
5 0
5 8
DataEnd
"""

TREE = "{ {0.1} {0} {0.3} {0} {0.5} {0} { 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8 } {0} }"
XML = """<WindowElement><Optical><Layer><DataDefinition><IncidentDataStructure>TensorTree3</IncidentDataStructure>
</DataDefinition><WavelengthData><Wavelength>Visible</Wavelength><WavelengthDataBlock>
<WavelengthDataDirection>Reflection Back</WavelengthDataDirection><AngleBasis>LBNL/Shirley-Chiu</AngleBasis>
<ScatteringData>TREE</ScatteringData></WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>
"""

ASTM = "DATE 4/8/98\nVARS theta_i,phi_i,theta_s,phi_s,R,G,B\n" + "0.5,3.1,0.25,0.1,0.1,0.2,0.3\n" * 12
PAB = "#incident_angle 30 180\n#format: theta phi DSF\n" + "40 10 0.1\n50 20 0.2\n" * 12
ALTA = "#DIM 3 1\n#PARAM_IN RUSIN_TH_TD_PD\n#PARAM_OUT INV_STERADIAN\n" + "0.2 0.3 0.4 0.5\n0.6 0.1 1 2\n" * 12
SPEOS = (
    """OPTIS - Anisotropic BSDF surface file v8.0\n0\na comment\n5\nwords\n0\t1\t0\n1\t0\n1\n2\n0 90\n1\n10\n1\n10
10\t0\nwhite\n2\n400\t30\n700\t60\n"""
    + "3 4\n\t0 90 180 270\n0 1 1 1 1\n40 1 2 3 4\n90 1 1 2 2\n" * 2
    + "End of file\n"
)
SSDD = (
    """VERSION 0.3\nDATA_TYPE brdf\nCOLOR_MODEL rgb\nPARAM_TYPE specular_coordinate_system\nPARAM0_LIST 10 40
PARAM2_LIST 0 20\nPARAM3_LIST 0 90\nDATA ascii\n"""
    + "0.1 0.2 0.3\n" * 8
)
LIGHTTOOLS = """Symmetry PlaneSymmetrical\nSpectralContent Monochrome\nScatterAzimuth 3\n0 90 180\nScatterRadial 2\n0 30
DataBegin\nAOI 20\nPOI 0\nSide Front\nWavelength 550\nScatterType BRDF\nTIS 0.2\n1 2\n3 4\n5 6\nDataEnd\n"""


def text(words: str) -> Callable[[Path], bytes]:
    return lambda folder: words.encode()


FILES: dict[str, Callable[[Path], bytes]] = {
    "csv": csv,
    "totals": totals,
    "rxt": text(RXT.format(spheres=1) + "2\n800 0.3 0.4\n810 0.2 0.5\n"),
    "merl": merl,
    "rgl": exported("rgl", ".bsdf"),
    "zemax": lambda folder: (COATINGS / "AnoBlackNiTEonSteel.bsdf").read_bytes(),
    "fred": lambda folder: (COATINGS / "AnoBlackNiTEonSteel.txt").read_bytes(),
    "klems": exported("klems", ".xml"),
    "tensortree": text(XML.replace("TREE", TREE)),
    "astm": text(ASTM),
    "pab": text(PAB),
    "alta": text(ALTA),
    "speos": text(SPEOS),
    "ssdd": text(SSDD),
    "lighttools": text(LIGHTTOOLS),
}
NAMES = {"merl": "x.binary", "rxt": "x.rxt"}
"""Of files that are known by the ends of their names; all others by their content."""
