"""Texts by hand of ASTM, pab, LightTools, FRED and Zemax: rows of angles and values, channels, quantities and notes."""

import numpy as np
import pytest

from fits.data.geometry import azimuth, direction, polar
from fits.data.reading import read
from tests.helpers.data_files import LIGHTTOOLS, ZEMAX
from tests.helpers.places import COATINGS

ASTM = "ASTM 1\nDATE 4/8/1998\nSAMPLE Paint, blue\nNUM_POINTS 2\nVARS theta_i,phi_i,theta_s,phi_s,R,G,B\n"
PAB = """#sample_name "a sample"
#incident_angle 82.5 180
#colorimetry: CIE-Y
#format: theta phi DSF
84.968 125.790 0.009744
84.889 125.610 -0.007737
"""
LIT = "azimuths about the normal"
SKIPPED = "ScatterRadial and|skipped: 0 grid points at|masked: 1 zero above the horizon, not measured"
BLOCK = ZEMAX[ZEMAX.index("TIS") : ZEMAX.index("DataEnd")]
SIDES = [[("Front", side), ("BRDF", kind)] for side in ("Front", "Back") for kind in ("BRDF", "BTDF")]
COLOURS = [
    [("Wavelength 550", f"TristimulusValue Tris{name}"), ("1 2", f"{first} 2")]
    for name, first in (("Y", 8), ("X", 7), ("Z", 9))
]
XYZ = "".join(f"Tristimulus{name}\nDataBegin\n{BLOCK}DataEnd\n" for name in "XYZ")
TURNED = [("1\n0\n", "2\n0 30\n"), ("0 90 180", "0 120 240"), (BLOCK, BLOCK * 2)]


def lighttools(*tables, spectrum="Monochrome"):
    """A file of tables, each the usual one but for some words."""
    head, table = LIGHTTOOLS.removesuffix("DataEnd\n").replace("Monochrome", spectrum).split("DataBegin\n")
    return f"LightTools BSDF\n# a comment\n{head}DataBegin\n{''.join(changed(table, *one) for one in tables)}DataEnd\n"


def lit(theta_i=20, phi_i=90, first=1, turned=0):
    """Rows of such a table: outgoing angles about the normal, which counts once."""
    outgoing = ((0, 0, first), (30, 0, 2), (30, 90, 4), (30, 180, 6))
    return [(theta_i, phi_i, abs(turned - theta), phi, value) for theta, phi, value in outgoing]


def changed(text, *changes):
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def about_specular(theta, *values, phi_i=180.0, below=0, turns=(0, 90, 180)):
    """Rows of Zemax: the specular direction once, and 25 degrees away, at azimuths from where the normal lies."""
    rows = [(theta, phi_i, theta, phi_i + 180.0, values[0])]
    for turn, value in zip(np.radians(turns), values[1:], strict=True):
        # in a frame of the specular direction, the direction towards the normal, and sideways
        away = np.cos(np.radians(25)) * direction(theta, 0) + np.sin(np.radians(25)) * (
            np.cos(turn) * direction(theta - 90.0, 0) - np.sin(turn) * np.array([0, 1, 0])
        )
        rows.append((theta, phi_i, polar(away), azimuth(away) + phi_i + 180.0, value))
    return [(*row[:2], abs(below - row[2]), *row[3:]) for row in rows]


def plain(**how):
    return about_specular(20, 1, 2, 3, 4, **how) + about_specular(60, 5, 6, 0, 8, **how)


def case(text, rows, channels="value", notes="", masked=(), **options):
    """notes: how each of them begins."""
    return text, rows, channels.split(","), notes.split("|") if notes else [], masked, options


TABLES = {
    "astm": case(
        f"{ASTM}0.5,3.1,0.25,0.1,0.1,0.2,0.3\n\n0.5,1,-0.25,6.2,0.4,0.5,-0.01\n",
        [(*np.degrees([0.5, 3.1, 0.25, 0.1]), 0.1, 0.2, 0.3), (*np.degrees([0.5, 1, -0.25, 6.2]), 0.4, 0.5, -0.01)],
        "red,green,blue",
        "angles taken as radians|1 sample below zero, kept as measured",
    ),
    "astm in degrees": case(
        "VARS theta_i phi_i theta_s phi_s 550nm 650nm\n30 180 40 0 0.1 0.2\n30 180 120 0 0.1 0.2\n",
        [(30, 180, theta, 0, *np.array([0.1, 0.2]) / abs(np.cos(np.radians(theta)))) for theta in (40, 120)],
        "550 nm,650 nm",
        "angles taken as degrees",
        quantity="brdf_cos",
    ),
    "astm without azimuth of the light": case(
        "VARS theta_i,theta_s,phi_s,Integrated BRDF\n0.3,0.3,0,0.7\n",
        [(np.degrees(0.3), 180, np.degrees(0.3), 0, 0.7)],
        notes="angles taken as radians|no phi_i",
    ),
    "pab": case(  # as in the manual of Radiance
        PAB,
        [
            (82.5, 180, theta, phi, value / np.cos(np.radians(theta)))
            for theta, phi, value in ((84.968, 125.79, 0.009744), (84.889, 125.61, -0.007737))
        ],
        notes="light at|1 sample below zero, kept as measured",
    ),
    "pab of a BTDF, angles apart": case(
        "#format: theta phi BTDF\n#intheta 20\n#inphi 0\n#upphi 90\n#colorimetry: CIE-XYZ\n150 180 1 2 3\n90 0 1 1 1\n",
        [(20, 0, 150, 180, 1, 2, 3), (20, 0, 90, 0, 1, 1, 1)],
        "X,Y,Z",
        "light at|masked: 1 sample in|the sample's up is at phi 90",
        masked=[1],
    ),
    "lighttools": case(lighttools([], [("AOI 20", "AOI 60"), ("1 2", "7 2")]), lit() + lit(60, first=7), notes=LIT),
    "lighttools, sides": case(
        lighttools(*SIDES), [*lit(), *lit(turned=180), *lit(160, turned=180), *lit(160)], notes=LIT
    ),
    "lighttools, colours in any order": case(
        lighttools(*COLOURS, spectrum="XYZ"),
        [(*row[:4], *np.array((7, 8, 9) if row[2] == 0 else [row[4]] * 3) / np.pi) for row in lit()],
        "X,Y,Z",
        LIT,
        quantity="reflectance_factor",
    ),
    "fred": case(
        "type bsdf_data\nformat angles=deg bsdf=value scale=2\n15 0\n-30 0 0.1\n30 90 0.2\n0 0\n10 0 0.3\n",
        [(15, 180, 30, 180, 0.2), (15, 180, 30, 90, 0.4), (0, 180, 10, 0, 0.6)],  # the mirror direction is given
    ),
    "zemax": case(ZEMAX, plain(), notes=SKIPPED, masked=[6]),
    "zemax, transmission": case(
        ZEMAX.replace("BRDF", "BTDF"),  # straight on, towards the lower normal, and past it
        plain(below=180, turns=(0, -90, 180)),
        notes=f"{SKIPPED}|BTDF: AngleOfIncidence",
        masked=[6],
    ),
    "zemax in colours": case(
        changed(ZEMAX, ("Content Monochrome", "Content XYZ"), (ZEMAX[ZEMAX.index("Monochrome\nDataB") :], XYZ)),
        [(*row[:4], *[row[4] / np.pi] * 3) for row in plain()],
        "X,Y,Z",
        SKIPPED,
        masked=[6],
        quantity="reflectance_factor",
    ),
    **{
        f"zemax, {symmetry}": case(  # as they stand: the light turns by the rotation, the lobe with it
            changed(ZEMAX, ("PlaneSymmetrical", symmetry), *TURNED),
            [row for phi_i in (180, 150) for row in plain(phi_i=phi_i, turns=(0, 120, 240))],
            notes=f"{SKIPPED.replace('1 zero', '2 zeros')}|SampleRotation and ScatterAzimuth|the sample's x",
            masked=[6, 14],
        )
        for symmetry in ("PlaneSymmetrical", "ASymmetrical", "Asymmetrical4D")
    },
}


@pytest.mark.parametrize("name", TABLES)
def test_rows_of_a_file(reading, name):
    text, rows, channels, notes, masked, options = TABLES[name]
    data, expected = reading(text, **options), np.array(rows, float)
    assert data.source.format == name.split()[0].strip(",")
    assert data.source.quantity == options.get("quantity", "brdf_cos" if text.startswith("#sample") else "brdf")
    assert list(data.channels) == channels
    np.testing.assert_allclose(data.wi, direction(*expected[:, :2].T), atol=1e-8)
    np.testing.assert_allclose(data.wo, direction(*expected[:, 2:4].T), atol=1e-8)
    used = data.mask
    np.testing.assert_array_equal(np.flatnonzero(~used), masked)
    np.testing.assert_allclose(data.values[used], expected[used, 4:], rtol=1e-9)
    assert all(note.startswith(start) for note, start in zip(data.source.notes, notes, strict=True))


def test_directions_below_the_horizon_and_tables_twice_are_no_data(reading):
    data = reading(ZEMAX.replace("0 25", "0 35"))
    assert len(data) == 7  # 60 + 35 degrees away from the normal is below
    assert (data.wo[:, 2] > 0).all()
    assert "skipped: 1 grid point at or beyond the horizon" in data.source.notes
    with pytest.raises(ValueError, match="line 19: this table stands twice"):
        reading(lighttools([], []))


def test_a_fred_file_is_the_csv_plus_the_laboratory_floor():
    """The laboratory shifted its readings by one constant before it wrote this file: f cos theta_o differs by that."""
    names = "AnoBlackNiTEonSteel.txt", "nite_on_blasted_steel1008_650nm_hemisphere.csv"
    fred, csv = (read(COATINGS / name) for name in names)
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


def test_a_zemax_file_is_measured_up_to_80_degrees_from_the_normal():
    """There its zeros must lie: angles about the normal, or azimuths from the other side, would scatter them."""
    steel = read(COATINGS / "AnoBlackNiTEonSteel.bsdf")
    assert (steel.theta_o[steel.mask] <= 80 + 1e-9).all()
    assert (steel.theta_o[~steel.mask] > 80).all()
    assert (steel.mask.sum(), (~steel.mask).sum()) == (647, 59)
    assert sorted(set(steel.theta_i)) == [10, 30, 50, 70]
    np.testing.assert_allclose(steel.phi_i, 180)
    mirror = np.linalg.norm(steel.wi * [-1, -1, 1] - steel.wo, axis=1) < 1e-9  # once
    np.testing.assert_allclose(steel.values[mirror, 0], [6.039e-2, 7.562e-2, 1.601e-1, 1.522], rtol=1e-3)
