"""Every format, as people leave files behind, damaged, and wrong: read right, or refused on one line that says why."""

import os
import re

import numpy as np
import pytest

from fits import Measurements, ReadOptions, read, slices
from fits.data.measurements import LARGEST
from fits.names import FORMATS
from tests.helpers.data_files import FILES, NAMES, RXT, TREE, ZEMAX, written
from tests.helpers.mutations import mutated
from tests.helpers.refusals import refuses

BINARY = ("merl", "rgl")
TEXT = sorted(set(FILES) - set(BINARY))
NUMBER = rb"(?<![\w.+-])[-+]?\d+(\.\d*)?([eE][-+]?\d+)?(?![\w.])"


@pytest.fixture
def found(tmp_path):
    """What a file of a format holds; the words of its refusal where it is refused, on one line that names it."""

    def of(kind: str, raw: bytes, format: str | None = None) -> Measurements | str:
        path = written(tmp_path, raw, NAMES.get(kind, "data.xyz"))
        try:
            return read(path, format=format)
        except ValueError as error:
            words = str(error)
        assert words.startswith(str(path)), words
        assert "\n" not in words
        return words

    return of


UNHURT = {
    "byte order mark": lambda raw: b"\xef\xbb\xbf" + raw,
    "byte order mark and blank line": lambda raw: b"\xef\xbb\xbf\r\n" + raw,
    "UTF-16": lambda raw: raw.decode("latin-1").encode("utf-16"),
    "leading blank lines": lambda raw: b"\n \n" + raw,
    "CRLF": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"),
    "CR": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b"\r"),
    "trailing blanks": lambda raw: raw.replace(b"\r\n", b"\n").replace(b"\n", b" \t\n") + b"\n\n",
    "no end of the last line": lambda raw: raw.rstrip(),
}


@pytest.mark.parametrize("kind", TEXT)
def test_what_is_not_content_changes_nothing(made, found, kind):
    assert set(FILES) == set(FORMATS)
    raw = made(kind)
    whole = found(kind, raw)
    assert kind in (whole.source.format, "totals")  # which are a CSV
    for name, change in UNHURT.items():
        changed = found(kind, change(raw))
        for part in ("wi", "wo", "values", "mask"):
            np.testing.assert_array_equal(getattr(changed, part), getattr(whole, part), name)


@pytest.mark.parametrize("kind", TEXT)
def test_no_number_passes_for_another(made, found, kind):
    raw = made(kind)
    whole, last = found(kind, raw), list(re.finditer(NUMBER, raw))[-1]
    line = raw[: last.start()].count(b"\n") + 1
    for number in ("1e300", "-1e300", "1e999", "nan", "inf", "1e-320", "", "1,5", "x"):
        data = found(kind, raw[: last.start()] + number.encode() + raw[last.end() :])
        if isinstance(data, Measurements):  # unused, out of range of what is read, or left out and said so
            assert np.isfinite(data.values).all()
            assert np.abs(data.values).max() <= LARGEST
            if number in ("nan", "") and len(data) != len(whole):
                assert any(note.startswith("skipped: 1 data point") for note in data.source.notes)
        elif number in ("x", "inf", "1e999") and kind not in ("klems", "tensortree"):
            assert f", line {line}, column" in data
            assert number in data


@pytest.mark.parametrize("kind", FILES)
def test_a_truncated_file_is_refused_or_holds_less(made, found, kind):
    raw = made(kind)
    whole = found(kind, raw)
    for share in (0.0, 0.02, 0.5, 0.9):
        data = found(kind, raw[: int(share * len(raw))])
        assert isinstance(data, str) or len(data) < len(whole)  # formats of lines without an end do not know


@pytest.mark.parametrize("kind", BINARY)
def test_binary_values_are_limited_too(made, found, kind):
    raw, kept = made(kind), np.dtype("<f8" if kind == "merl" else "<f4")
    for number in (1e300, np.inf, np.nan):
        with np.errstate(over="ignore"):
            bad = np.array(number).astype(kept).tobytes()
        data = found(kind, raw[: -1000 * kept.itemsize] + 1000 * bad)
        assert isinstance(data, str) or np.abs(data.values).max() <= LARGEST
    assert isinstance(found(kind, b"\xef\xbb\xbf" + raw), str)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("count", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_damaged_files(made, found, kind, count):
    raw, random = made(kind), np.random.default_rng(len(kind))
    head = 4000 if kind == "zemax" else 400
    changed = (mutated(raw, random, head) for _ in range(count if kind not in BINARY else count // 5))
    assert any(isinstance(found(kind, one, kind), str) for one in changed)


def test_bad_arguments(reading, tmp_path):
    text = "theta_i,theta_o,brdf\n10,20,0.5\n"
    for given, message in (
        ({"format": "xls"}, f"format is 'xls', must be one of {', '.join(FORMATS)}"),
        ({"quantity": "f"}, "quantity is 'f', must be one of"),
        ({"geometry": slices()}, "geometry and bins apply to MERL and RGL files only"),
        ({"hold_out": ["incidence=50"]}, "hold_out: it is for a fit"),
    ):
        refuses(message, reading, text, **given)
    refuses("bin", reading, text, bin=4, error=TypeError)
    os.mkfifo(tmp_path / "pipe")
    for place, message in {"": "is a directory", "pipe": "is a pipe or a device", "none": "no such file"}.items():
        refuses(message, read, tmp_path / place, error=(ValueError, FileNotFoundError))


def test_what_is_masked_selected_and_held_out(reading, tmp_path):
    rows = [f"{incidence},180,{theta},0,0.1" for incidence in (10, 50) for theta in range(0, 90, 10)]
    text = "\n".join(["theta_i,phi_i,theta_o,phi_o,brdf", *rows])
    assert len(reading(text, max_polar_angle=60.0, select=["incidence=10"]).used()) == 7
    fitted, held_out = ReadOptions(hold_out=["incidence=50"]).split(tmp_path / "data.txt")
    assert (len(fitted.used()), len(held_out.used())) == (9, 9)


HEAD = "theta_i,phi_i,theta_o,phi_o,brdf"
GOOD = "\n10,180,20,0,0.5"
SHARES = "theta_i,total_reflectance,total_reflectance_std,total_transmittance,total_transmittance_std"
FRED = "type bsdf_data\nformat scale=1\n"
SLAB = RXT.format(spheres=0)

WHOLE = {
    "csv": {
        "": "the file is empty",
        "# nothing else\n": "the file holds only comments",
        HEAD: "line 1: no samples below the header",
        "theta_i,phi_i,phi_o,brdf\n1,2,3,4": "line 1: no column 'theta_o', the file has theta_i, phi_i, phi_o, brdf",
        "theta_i,phi_i,theta_o,brdf\n1,2,3,4": "line 1: no column 'phi_o'",
        "theta_i,theta_o,value\n1,2,3": "no value column: must be one of brdf, brdf_cos, reflectance_factor, bsdf,",
        f"{HEAD},brdf\n10,180,20,0,1,1": "line 1, column 'brdf': this column appears twice",
        f"{HEAD},brdf_red\n10,180,20,0,1,1": "columns brdf, brdf_red: one without a channel name cannot stand beside",
        "theta_i,theta_o,brf_cos\n10,20,1": "column 'brf_cos': no channel may be called 'cos'; products with the",
        "theta_i,theta_o,brf_red,reflectance_blue\n1,2,3,4": "columns brf, reflectance: names of one quantity, must be",
        "theta_i,theta_o,bsdf,brf\n1,2,3,4": r"2 quantities \(brdf, reflectance_factor\): choose one with quantity",
        "theta_i,theta_o,brdf_a,brdf_b,brdf_a_std\n1,2,3,4,5\n1,2,3,4,": "'b' has no standard deviation to estimate",
        f"{HEAD}{GOOD}\n10,180,20,0,abc": "line 3, column 'brdf': 'abc' is not a number, must be a finite",
        f"{HEAD}\n# x\n\n,180,20,0,1": "line 4, column 'theta_i': '' is not a number",
        f"{HEAD}\n10,180,20,0,\n10,180,25,0,NaN": "line 1: no data point below holds a number in column brdf",
        f"{HEAD},brdf_std\n10,180,20,0,1,1e-200": "line 2, column 'brdf_std': 1e-200 is not allowed, must be > 0",
        f"{HEAD}\n91,180,20,0,1": r"line 2, column 'theta_i': 91 is not allowed, must be a number in \[0, 90\]",
        f"{HEAD}\n10,180,-5,0,1": r"line 2, column 'theta_o': -5 is not allowed, must be a number in \[0, 180\]",
        f"{HEAD}\n10,720,20,0,1": r"line 2, column 'phi_i': 720 is not allowed, must be a number in \[-360, 360\]",
        f"{HEAD}\n10,180,20,0": "line 2: 4 cells, must be 5 as in the header",
        f"{HEAD},used\n10,180,20,0,1,2": "line 2, column 'used': 2 is not allowed",
        f'{HEAD}\n10,180,"20,0,1': "line 2: not a line of CSV",
        HEAD.encode() + b"\n10,180,20,0,\xff\n": "not a text file",
    },
    "totals": {
        f"{SHARES}\n90,0.3,0.01,0.5,0.02": "line 2, column 'theta_i': 90 is not allowed",
        f"{SHARES}\n0,-0.3,0.01,0.5,0.02": "column 'total_reflectance': -0.3 is not allowed",
        f"{SHARES}\n0,0.3,0,0.5,0.02": "column 'total_reflectance_std': 0 is not allowed",
        "theta_i\n0.3": "no column of total_reflectance, ",
        f"{SHARES.rpartition(',')[0]}\n0,0.3,0.1,0.2": "only some kinds have standard deviations",
        "theta_i,total_reflectance_a,total_transmittance_b\n0,0.3,0.1": "every kind must have the same",
        "theta_i,total_reflectance_a,total_reflectance_b\n0,0.3,": "line 2, column 'total_reflectance_b': the cell",
        "theta_i,total_reflectance\n0,\n10,": "line 1: all cells of values are empty",
        "# a comment": "the file holds only comments, must have a header line",
    },
    "fred": {
        "type bsdf_data": "must be followed by a line 'format",
        "theta_i": "a FRED table starts with 'type bsdf_data', found 'theta_i'",
        FRED.replace("scale=1", "angles=sin"): "line 2: 'angles=sin' is not supported",
        FRED.replace("scale=1", "scale=x"): "line 2, column 'scale': 'x' is not a number",
        FRED: "no samples",
        f"{FRED}1 2 3": "line 3: a scatter direction before any specular",
        f"{FRED}1 2\n3 4 5 6": "line 4: 4 numbers, must be 2",
        f"{FRED}1 2\n99 4 1": "line 4, column 'theta_scat': 99 is not allowed",
    },
    "rxt": {
        "IAD2 1.4": "not an .rxt file, which begins with IAD1",
        "IAD1 1.4 1.0": "2 numbers, must be 17 before the measurements",
        SLAB: "no measurements after the description",
        f"{SLAB}8\n0.3": r"line 12, column 'number of measurements': 8 is not allowed, must be a .*number in \[1, 7\]",
        f"{SLAB}2\n800 0.3 0.4\n810 0.2": "line 14: 2 numbers, must be 3: L r t",
        f"{SLAB}L r z\n800 0.3 0.4": "column 'z' is not one of r, t, u, L",
        f"{SLAB}L r r\n800 0.3 0.4": "column 'r' appears twice",
        f"{SLAB}r i\n0.3 95": r"incidence is \[95.0\], must be in \[0, 90\)",
        f"{SLAB}r c\n0.3 0": "c, the share of what is mirrored that M_R holds, is 0, must be 1",
        f"{SLAB}r E\n0.3 0.5": "E, the optical depth of a slide, is 0.5, must be 0",
        f"{SLAB}r D\n0.3 0\n0.3 1": "D is 0 in some rows only",
        f"{SLAB}L r i\n800 0.3 8\n900 0.3 30": "rows at 30 degrees have other wavelengths than those at 8",
        f"{RXT.format(spheres=1)}r w\n0.3 0.95\n0.3 0.98": "w, the reflectance of the wall.*restrict the wave",
        f"{SLAB}r S\n0.3 0\n0.3 1": "the number of spheres varies",
        f"{SLAB}L r n\n800 0.3 1.3\n900 0.3 1.5": "n, the index of the sample, goes from 1.3 to 1.5, and one slab",
        f"{RXT.format(spheres=3)}1\n0.3": "number of spheres is 3, must be 0, 1 or 2",
        f"{RXT.format(spheres=2).replace('25', '225')}1\n0.3": r"Sphere.sample is 225.0, must be .* in \[0, 200\)",
    },
    "astm": {"DATE 4/8/98\n": "no line 'VARS theta_i,phi_i,theta_s,phi_s,...' that names the columns"},
    "alta": {
        "#DIM 1 1\n#PARAM_IN COS_TH\n#PARAM_OUT INV_STERADIAN\n1.8 3": "none of the 1 sample has directions",
        "#DIM 1 3\n#PARAM_IN COS_TH\n#PARAM_OUT RGB_COLOR\n0.9 1 2 3": "RGB_COLOR does not say what the values are",
    },
    "rgl": {
        b"tensor_file\0\2\0": "version 2.0, must be 1.0",
        b"tensor_file\0\1\0": "ends within its header",
        b"tensor_file\0\1\0\xff\xff\xff\xff": "fields announced",
        b"tensor_file\0\1\0\1\0\0\0\2\0ab\1\0\x63" + bytes(16): "is of type 99",
    },
    None: {  # no format is known of them
        b"\x01\x02\x00\x03rest": "unknown binary file, starts with 01 02 00 03",
        b"BSDF 2.0 of something\n1 2 3\n": "unknown format, the first line is 'BSDF 2.0 of something'",
        b"<?xml version='1.0'?>": "not well-formed XML",
        b"<?xml version='1.0'?><html/>": "an XML file of <html>, must be a <WindowElement>",
    },
}
"""By format, whole texts and what is said of them."""

CHANGED = {
    "astm": [
        ("0.5,3.1,0.25,0.1,0.1,0.2,0.3\n", "", "no samples below VARS"),
        (",R,G,B", "", "line 2: no column of values"),
        (",R,G,B", ",R,G,beta", "line 2: column 'beta' is not known"),
        (",R,G,B", ",R,G,R", "line 2: column 'R' is named twice"),
        ("theta_s,", "", "line 2: no column 'theta_s'"),
        (",0.3\n0.5", "\n0.5", "line 3: 6 numbers, must be 7"),
        ("0.5,3.1,0.25", "0.5,3.1,4", "line 3, column 'theta_s': 4 is not allowed"),
        ("DATE", "some text\nDATE", "line 1: 'some text' found, must be a key in capitals"),
    ],
    "pab": [
        ("DSF", "energy", "line 2: format is 'theta phi energy'"),
        ("#incident_angle 30 180\n", "", "no #incident_angle, nor #intheta and #inphi"),
        ("30 180", "30", "line 1: incident_angle must be followed by theta and phi, found 1 word"),
        ("30 180", "200 180", "line 1, column 'theta': 200 is not allowed"),
        (" 0.2\n4", "\n4", "line 4: 2 numbers, must be 3"),
        ("50 20", "284.9 20", "line 4, column 'theta': 284.9 is not allowed"),
        ("#format", "#colorimetry: RGB\n#format", "line 2: colorimetry is 'RGB'"),
    ],
    "alta": [
        ("RUSIN_TH_TD_PD", "STARK_3D", "line 2: PARAM_IN is 'STARK_3D', must be one of RUSIN_TH_PH_TD_PD"),
        ("INV_STERADIAN", "WATTS", "line 3: PARAM_OUT is 'WATTS'"),
        ("INV_STERADIAN", "RGB_COLOR", "line 3: RGB_COLOR has 3 columns, DIM says 1"),
        ("#PARAM_IN", "#FROM", "the header has no line '#PARAM_IN ...'"),
        ("#DIM 3 1", "#DIM 2 1", "line 1: 2 columns of RUSIN_TH_TD_PD, must be 3"),
        ("#DIM 3 1", "#DIM 3", "line 1: DIM must be followed by two numbers, found 1"),
        ("0.4 0.5\n0.6", "0.4\n0.6", "line 4: 3 numbers, must be 4"),
        ("0.2 0.3 0.4 0.5\n0.6 0.1 1 2\n", "", "no samples below the header"),
        ("#DIM", "#VS 7\n#DIM", "line 1: VS is '7'"),
        ("#DIM", "#FORMAT binary\n#BEGIN_STREAM\n#DIM", "ALTA's binary data, which have no reader here"),
    ],
    "ssdd": [
        ("VERSION 0.3\n", "", "line 1: 'DATA_TYPE' found, must be VERSION"),
        ("VERSION 0.3", "VERSION 2", "line 1: VERSION is '2'"),
        ("DATA_TYPE brdf\n", "", "line 2: 'COLOR_MODEL' found before any DATA_TYPE"),
        ("DATA_TYPE brdf", "DATA_TYPE bssrdf", "line 2: DATA_TYPE is 'bssrdf'"),
        ("COLOR_MODEL rgb\n", "", "the header of this brdf has no COLOR_MODEL"),
        ("MODEL rgb", "MODEL cmyk", "line 3: COLOR_MODEL is 'cmyk'"),
        ("MODEL rgb", "MODEL spectrum", "line 3: spectrum without WAVELENGTH_LIST"),
        ("specular_coo", "distorted_coo", "line 4: PARAM_TYPE is 'distorted_coordinate_system'"),
        ("0_LIST 10 40", "0_LIST 95 40", "line 5, column 'PARAM0_LIST': 95 is not allowed"),
        ("PARAM2_LIST 0 20\n", "", "line 7: the header of this brdf has no PARAM2_LIST"),
        ("0_LIST 10 40", "0_LIST 10 40 50", "the file ends where 12 lines of data are expected"),
        ("0.3\n0.1", "0.3 1\n0.1", "line 9: 4 numbers, must be 3"),
        ("PARAM3_LIST", "PARAM9_LIST", "line 7: unknown entry 'PARAM9_LIST'"),
        ("DATA ascii\n" + "0.1 0.2 0.3\n" * 8, "", "the file ends where DATA is expected"),
        ("DATA ascii", "DATA hex", "line 8: DATA is 'hex', must be ascii or binary"),
    ],
    "speos": [
        ("OPTIS", "SPEOS", "a Speos BSDF starts with 'OPTIS - ...'"),
        ("v8.0\n0", "v8.0\n1", "line 2: a binary file, which has no reader here"),
        ("v8.0\n0", "v8.0\n2", "line 2: must be 0 for text, or 1 for binary"),
        ("Anisotropic BSDF", "Something", "the title is"),
        ("1\t0\n1\n", "0\t0\n1\n", "line 7: neither reflection nor transmission"),
        ("1\n10\n1\n10\n", "1\n95\n1\n10\n", "line 12, column 1: 95 is not allowed"),
        ("End of file", "1 2 3", "'1 2 3' found after the last table"),
        ("\n40 1 2 3 4\n", "\n95 1 2 3 4\n", "angles of this table do not rise"),
        ("3 4\n", "3 5\n", "line 22: 9 numbers for azimuths, must be 5"),
        ("3 4\n", "4 4\n", "line 25: 2 numbers, must be 5"),
    ],
    "lighttools": [
        ("AOI 20", "AOI 95", "line 8, column 'AOI': 95 is not allowed"),
        ("AOI 20\n", "", "line 12: a table without AOI"),
        ("Side Front", "Side Top", "line 10: Side is 'Top', must be one of front, back"),
        ("3 4\n", "3\n", "line 17, column 1: 'DataEnd' is not a number"),
        ("DataEnd", "", "the file ends where DataEnd is expected"),
        ("ScatterRadial 2\n0 30\n", "", "line 5: the header ends here without scatterradial"),
        ("Monochrome", "RGB", "line 2: SpectralContent is 'RGB'"),
        ("Monochrome", "XYZ", "1 table of this AOI, must be 3"),
        ("TIS 0.2", "Index 1.5", "line 13: 'Index 1.5' found, must be one value after one of"),
        ("DataEnd", "DataEnd\n1 2\n", "line 18: '1 2' found after the last table"),
    ],
    "klems": [
        (">Columns<", ">TensorTree5<", "IncidentDataStructure is 'tensortree5'"),
        ("<RowAngleBasis>LBNL", "<RowAngleBasis>LBL", "RowAngleBasis is"),
        ("<nPhis>8<", "<nPhis>7<", "must be 144 x 144"),
        ("<UpperTheta>15<", "<UpperTheta>150<", "a ring from 5 to 150 degrees"),
        ("<UpperTheta>15<", "<UpperTheta>x<", "ThetaBounds/UpperTheta is 'x', must be a number"),
        ("Reflection Front", "Reflection Left", "WavelengthDataDirection is 'reflection left'"),
        (">Visible<", ">Solar<", "no WavelengthData of 'Visible'"),
        ("e-01,", "e-x1,", "could not convert"),
        ("1.273240e-01,", "inf,", "holds inf, must be finite"),
    ],
    "tensortree": [
        (TREE, tree, f"reflection back: the tree .*{message}")
        for tree, message in {
            "{1 2 3}": "a grid of 3 numbers, must be a power of 8",
            "{ {1} {2} }": "a node of 2, must be 8",
            "{ {1} {2}": "has no end",
            "{1} }": "a '}' too many",
            "{nan}": "holds nan, must be finite",
            "{1} 2": "numbers beside nodes",
            "{" * 30: "deeper than",
        }.items()
    ]
    + [(TREE, "{x}", "the tree: could not convert string to float"), (TREE, "", "reflection back: there is no tree")],
    "zemax": [
        ("DataEnd\n", "", "the file ends where DataEnd is expected"),
        ("5 8\nDataEnd\n", "", "the file ends where a row of values is expected"),
        ("5 0\n", "5\n", "line 23: 1 value, must be 2 as announced by ScatterRadial"),
        ("ScatterAzimuth 3", "ScatterAzimuth 4", "line 12, column 1: 'ScatterRadial' is not a number"),
        ("0 90 180", "0 90 180 270", "line 11: 4 angles for ScatterAzimuth, must be 3 as announced in line 10"),
        ("BRDF", "BSSRDF", "line 5: ScatterType is 'BSSRDF', must be one of brdf, btdf"),
        ("Symmetry PlaneSymmetrical\n", "", "line 14: the header ends here without symmetry"),
        ("Monochrome\nDataBegin", "TristimulusX\nDataBegin", "line 15: 'TristimulusX' found, must be 'monochrome'"),
        ("DataEnd\n", "DataEnd\n1 2\n", "line 26: '1 2' found after the last block"),
        ("TIS 0.1\n5", "5", "line 21: '5 6' found, must be 'tis'"),
        ("ScatterRadial", "Radial", "unknown keyword 'Radial'"),
    ],
}
"""By format, what takes the place of what in a sound file."""

CASES = [
    *((kind, text, message) for kind, texts in WHOLE.items() for text, message in texts.items()),
    *((kind, tuple(change), message) for kind, changes in CHANGED.items() for *change, message in changes),
]


@pytest.mark.parametrize(("kind", "given", "message"), CASES)
def test_what_is_wrong_is_said_on_one_line(made, found, kind, given, message):
    if isinstance(given, tuple):
        sound = ZEMAX if kind == "zemax" else made(kind).decode("latin-1")
        given = sound.replace(*given).encode("latin-1")
    assert re.search(message, found(None, given, kind))
