"""Tables of text by hand, ASTM, pab, LightTools and FRED: angles, sides, colours and quantities."""

import numpy as np
import pytest

from fits.data.geometry import direction
from fits.data.reading import read
from tests.helpers.places import COATINGS

ASTM = "ASTM 1\nDATE 4/8/1998\nSAMPLE Paint, blue\nNUM_POINTS 2\nVARS theta_i,phi_i,theta_s,phi_s,R,G,B\n"


def test_astm_in_radians(reading):
    data = reading(f"{ASTM}0.5,3.14159265,0.25,0.1,0.1,0.2,0.3\n\n0.5,1,-0.25,6.2,0.4,0.5,-0.01\n")
    assert data.channels == ("red", "green", "blue")
    half, quarter, first, second = np.degrees([0.5, 0.25, 0.1, 6.2])
    np.testing.assert_allclose(data.wi, direction(half, [180, np.degrees(1)]), atol=1e-8)
    np.testing.assert_allclose(data.wo, direction(quarter, [first, second + 180]), atol=1e-12)
    np.testing.assert_array_equal(data.values, [[0.1, 0.2, 0.3], [0.4, 0.5, -0.01]])
    assert data.source.notes == ("angles taken as radians", "1 sample below zero, kept as measured")


def test_astm_in_degrees_with_blanks_and_wavelengths(reading):
    text = "VARS theta_i phi_i theta_s phi_s 550nm 650nm\n30 180 40 0 0.1 0.2\n30 180 120 0 0.1 0.2\n"
    data = reading(text, quantity="brdf_cos")
    assert data.channels == ("550 nm", "650 nm")
    np.testing.assert_allclose(data.theta_o, [40, 120])
    np.testing.assert_allclose(data.values[:, 0], [0.1 / np.cos(np.radians(40)), 0.1 / 0.5])
    assert data.source.notes[0].startswith("angles taken as degrees")


def test_astm_without_azimuth_of_the_light(reading):
    data = reading("VARS theta_i,theta_s,phi_s,Integrated BRDF\n0.3,0.3,0,0.7\n")
    np.testing.assert_allclose(data.wi * [-1, 1, 1], data.wo, atol=1e-15)
    assert data.channels == ("value",)


def test_many_numbers_of_astm(tmp_path):
    numbers = np.random.default_rng(0).random((20_000, 7))
    np.savetxt(tmp_path / "big.astm", numbers, "%.6f", ",", header=ASTM.strip(), comments="")
    np.testing.assert_allclose(read(tmp_path / "big.astm").values, numbers[:, 4:].round(6))


PAB = """#sample_name "a sample"
#incident_angle 82.5 180
#format: theta phi DSF
84.968 125.790 0.009744
84.889 125.610 0.007737
84.805 125.427 0.008569
"""


def test_pab_as_in_the_manual_of_radiance(reading):
    data = reading(PAB)
    assert (data.source.format, data.source.quantity) == ("pab", "brdf_cos")
    np.testing.assert_allclose(data.wi, np.tile(direction(82.5, 180), (3, 1)))
    np.testing.assert_allclose(data.wo[0], direction(84.968, 125.79))
    np.testing.assert_allclose(data.values[0, 0], 0.009744 / np.cos(np.radians(84.968)))
    apart = PAB.replace("#incident_angle 82.5 180", "#intheta 82.5\n#inphi 180\n#upphi 90\n#colorimetry: CIE-Y")
    same = reading(apart)
    np.testing.assert_array_equal(same.values, data.values)
    assert "up is at phi 90" in same.source.notes[-1]


def test_pab_with_colours_of_a_btdf(reading):
    data = reading("#format: theta phi BTDF\n#incident_angle 20 0\n#colorimetry: CIE-XYZ\n150 180 1 2 3\n90 0 1 1 1\n")
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_array_equal(data.values[0], [1, 2, 3])
    assert data.wo[0, 2] < 0
    np.testing.assert_array_equal(data.mask, [True, False])
    assert "1 sample below zero, kept as measured" in reading(PAB.replace("0.009744", "-0.01")).source.notes


HEAD = """LightTools BSDF
# a comment
Symmetry Asymmetric
SpectralContent {spectrum}
ScatterAzimuth 3
0 90 180
ScatterRadial 2
0 30
DataBegin
"""
TABLE = "AOI {aoi}\nPOI 0\nSide {side}\nScatterType {kind}\n{more}TIS 0.2\n{first} 1\n{first} 2\n{first} 3\n"


def lighttools(*tables, spectrum="Monochrome"):
    usual = {"aoi": 20, "side": "Front", "kind": "BRDF", "more": "Wavelength 550\n", "first": 5}
    return HEAD.format(spectrum=spectrum) + "".join(TABLE.format(**usual | table) for table in tables) + "DataEnd\n"


def test_lighttools(reading):
    """Angles about the normal, the light at azimuth 90: the mirror direction is at 270."""
    data = reading(lighttools({}, {"aoi": 60, "first": 7}))
    assert data.source.format == "lighttools"
    np.testing.assert_allclose(data.wi[0], direction(20, 90), atol=1e-15)
    np.testing.assert_array_equal(data.values[:, 0], [5, 1, 2, 3, 7, 1, 2, 3])  # the normal once
    np.testing.assert_allclose(data.wo[1:4], direction(30, [0, 90, 180]), atol=1e-15)
    with pytest.raises(ValueError, match="line 19: this table stands twice"):
        reading(lighttools({}, {}))


def test_sides_of_lighttools(reading):
    data = reading(
        lighttools(*({"side": side, "kind": kind} for side in ("Front", "Back") for kind in ("BRDF", "BTDF")))
    )
    np.testing.assert_array_equal(np.sign(data.wi[::4, 2]), [1, 1, -1, -1])
    np.testing.assert_array_equal(np.sign(data.wo[::4, 2]), [1, -1, -1, 1])


def test_colours_of_lighttools_in_any_order(reading):
    tables = [
        {"more": f"TristimulusValue Tris{name}\n", "first": value} for name, value in (("Y", 2), ("X", 1), ("Z", 3))
    ]
    data = reading(lighttools(*tables, spectrum="XYZ"), quantity="reflectance_factor")
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_allclose(data.values[0] * np.pi, [1, 2, 3])


def test_fred(reading):
    text = "type bsdf_data\nformat angles=deg bsdf=value scale=2\n15 0\n-30 0 0.1\n30 90 0.2\n0 0\n10 0 0.3\n"
    data = reading(text)
    np.testing.assert_allclose(data.values[:, 0], [0.2, 0.4, 0.6])
    np.testing.assert_allclose(data.theta_i, [15, 15, 0])
    np.testing.assert_allclose(data.wo[:2], [direction(30, 180), direction(30, 90)], atol=1e-15)
    np.testing.assert_allclose(data.phi_i[:2], 180)  # the file gives the mirror direction


def test_a_fred_file_is_the_csv_plus_the_laboratory_floor():
    """The laboratory shifted its readings by one constant before it wrote this file: f cos theta_o differs by that."""
    fred, csv = (
        read(COATINGS / name) for name in ("AnoBlackNiTEonSteel.txt", "nite_on_blasted_steel1008_650nm_hemisphere.csv")
    )
    places, there = (np.hstack([data.wi, data.wo]).round(6) + 0.0 for data in (fred, csv))
    known = {tuple(place): value for place, value in zip(there, csv.values[:, 0], strict=True)}
    theirs = np.array([known.get(tuple(place), np.nan) for place in places])
    assert np.isfinite(theirs).mean() > 0.95
    # at the normal the CSV averages the readings of all azimuths, the FRED file those of one
    used = np.isfinite(theirs) & (fred.wo[:, 2] < 0.9999)
    ours, theirs, cosine = fred.values[used, 0], theirs[used], fred.wo[used, 2]
    floor = np.median((ours - theirs) * cosine)
    assert 7.5e-5 < floor < 7.6e-5
    rounding = 5e-7 + 5e-6 * theirs + 2e-8  # six decimals here, six digits there, and the floor as found
    assert (abs(ours - theirs - floor / cosine) <= rounding).all()
