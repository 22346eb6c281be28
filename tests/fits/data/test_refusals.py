"""Files that are refused: on one line, which names the file and the place, and says what stands there and what may.

That a cell is no number, or none that is allowed, is said of every format by `test_every_reader`.
"""

import pytest

from fits.data.reading import read
from tests.helpers.data_files import RXT, TREE, ZEMAX, written

HEAD = "theta_i,phi_i,theta_o,phi_o,brdf"
GOOD = "\n10,180,20,0,0.5"
SHARES = "theta_i,total_reflectance,total_reflectance_std,total_transmittance,total_transmittance_std"
FRED = "type bsdf_data\nformat scale=1\n"
SLAB = RXT.format(spheres=0)

WHOLE = {
    "csv": {
        "": "the file is empty",
        HEAD: "line 1: no samples below the header",
        "theta_i,phi_i,phi_o,brdf\n1,2,3,4": "line 1: no column 'theta_o', the file has theta_i, phi_i, phi_o, brdf",
        "theta_i,theta_o,value\n1,2,3": "no value column: must be one of brdf, brdf_cos, reflectance_factor, bsdf,",
        f"{HEAD},brdf_red\n10,180,20,0,1,1": "columns brdf, brdf_red: one without a channel name cannot stand beside",
        "theta_i,theta_o,brf_cos\n10,20,1": "column 'brf_cos': no channel may be called 'cos'; products with the",
        "theta_i,theta_o,brdf_a,brdf_b,brdf_a_std\n1,2,3,4,5\n1,2,3,4,": "'b' has no standard deviation to estimate",
        f"{HEAD}{GOOD}\n10,180,20,0,abc": "line 3, column 'brdf': 'abc' is not a number, must be a finite",
        f"{HEAD}\n10,180,nan,0,1": "line 2, column 'theta_o': nan is not allowed, must be a number in",
        f"{HEAD}\n10,180,20,0,1e300": r"line 2, column 'brdf': 1e300 is not allowed, .*at most 1e\+30 in size",
        f"{HEAD},brdf_std\n10,180,20,0,1,0": "line 2, column 'brdf_std': 0 is not allowed, must be > 0",
        f"{HEAD}\n91,180,20,0,1": r"line 2, column 'theta_i': 91 is not allowed, must be a number in \[0, 90\]",
        f"{HEAD}\n10,180,20,0": "line 2: 4 cells, must be 5 as in the header",
        HEAD.encode() + b"\n10,180,20,0,\xff\n": "not a text file",
    },
    "totals": {
        f"{SHARES}\n90,0.3,0.01,0.5,0.02": "line 2, column 'theta_i': 90 is not allowed",
        f"{SHARES}\n0,-0.3,0.01,0.5,0.02": "column 'total_reflectance': -0.3 is not allowed",
        f"{SHARES.rpartition(',')[0]}\n0,0.3,0.1,0.2": "only some kinds have standard deviations",
        "theta_i,total_reflectance_a,total_transmittance_b\n0,0.3,0.1": "every kind must have the same",
        "theta_i,total_reflectance_a,total_reflectance_b\n0,0.3,": "line 2, column 'total_reflectance_b': the cell",
    },
    "fred": {
        "type bsdf_data": "must be followed by a line 'format",
        "theta_i": "a FRED table starts with 'type bsdf_data', found 'theta_i'",
        FRED.replace("scale=1", "angles=sin"): "line 2: 'angles=sin' is not supported",
        FRED.replace("scale=1", "scale=x"): "line 2, column 'scale': 'x' is not a number",
        f"{FRED}1 2 3": "line 3: a scatter direction before any specular",
    },
    "rxt": {
        SLAB: "no measurements after the description",
        f"{SLAB}8\n0.3": r"line 12, column 'number of measurements': 8 is not allowed, must be a .*number in \[1, 7\]",
        f"{SLAB}L r z\n800 0.3 0.4": "column 'z' is not one of r, t, u, L",
        f"{SLAB}r c\n0.3 0": "c, the share of what is mirrored that M_R holds, is 0, must be 1",
        f"{RXT.format(spheres=1)}r w\n0.3 0.95\n0.3 0.98": "w, the reflectance of the wall.*restrict the wave",
        f"{SLAB}L r n\n800 0.3 1.3\n900 0.3 1.5": "n, the index of the sample, goes from 1.3 to 1.5, and one slab",
        f"{RXT.format(spheres=3)}1\n0.3": "number of spheres is 3, must be 0, 1 or 2",
        f"{RXT.format(spheres=2)}1\n0.3".replace(
            "25", "225"
        ): r"Sphere.sample is 225.0, must be a number in \[0, 200\)",
    },
    "astm": {"DATE 4/8/98\n": "no line 'VARS theta_i,phi_i,theta_s,phi_s,...' that names the columns"},
    "alta": {
        "#DIM 1 1\n#PARAM_IN COS_TH\n#PARAM_OUT INV_STERADIAN\n1.8 3": "none of the 1 sample has directions",
        "#DIM 1 1\n#PARAM_IN COS_TH\n0.8 3": "no PARAM_OUT: the header does not say what the values are: give quantity",
        "#DIM 1 3\n#PARAM_IN COS_TH\n#PARAM_OUT RGB_COLOR\n0.9 1 2 3": "RGB_COLOR does not say what the values are",
    },
    "rgl": {
        b"tensor_file\0\2\0": "version 2.0, must be 1.0",
        b"tensor_file\0\1\0\1\0\0\0\2\0ab\1\0\x63" + bytes(16): "is of type 99",
    },
    None: {  # no format is known of them
        b"\x01\x02\x00\x03rest": "unknown binary file, starts with 01 02 00 03",
        b"BSDF 2.0 of something\n1 2 3\n": "unknown format, the first line is 'BSDF 2.0 of something'",
        f"{HEAD}\n10,\0\n": "unknown binary file",
        b"<?xml version='1.0'?>": "not well-formed XML",
        bytes(range(200, 256)) * 10: "unknown format",
    },
}
"""By format, whole texts and what is said of them."""

CHANGED = {
    "astm": [
        (",R,G,B", "", "line 2: no column of values"),
        (",R,G,B", ",R,G,beta", "line 2: column 'beta' is not known"),
        ("DATE", "some text\nDATE", "line 1: 'some text' found, must be a key in capitals"),
    ],
    "pab": [
        ("DSF", "energy", "line 2: format is 'theta phi energy'"),
        ("30 180", "30", "line 1: incident_angle must be followed by theta and phi, found 1 word"),
        ("#format", "#colorimetry: RGB\n#format", "line 2: colorimetry is 'RGB'"),
    ],
    "alta": [
        ("RUSIN_TH_TD_PD", "STARK_3D", "line 2: PARAM_IN is 'STARK_3D', must be one of RUSIN_TH_PH_TD_PD"),
        ("INV_STERADIAN", "WATTS", "line 3: PARAM_OUT is 'WATTS'"),
        ("0.2 0.3 0.4 0.5\n0.6 0.1 1 2\n", "", "no samples below the header"),
        ("#DIM", "#FORMAT binary\n#BEGIN_STREAM\n#DIM", "ALTA's binary data, which have no reader here"),
    ],
    "ssdd": [
        ("VERSION 0.3\n", "", "line 1: 'DATA_TYPE' found, must be VERSION"),
        ("DATA_TYPE brdf", "DATA_TYPE bssrdf", "line 2: DATA_TYPE is 'bssrdf'"),
        ("0_LIST 10 40", "0_LIST 10 40 50", "the file ends where 12 lines of data are expected"),
        ("DATA ascii\n" + "0.1 0.2 0.3\n" * 8, "", "the file ends where DATA is expected"),
    ],
    "speos": [
        ("OPTIS", "SPEOS", "a Speos BSDF starts with 'OPTIS - ...'"),
        ("v8.0\n0", "v8.0\n1", "line 2: a binary file, which has no reader here"),
        ("1\n10\n1\n10\n", "1\n95\n1\n10\n", "line 12, column 1: 95 is not allowed"),
        ("3 4\n", "3 5\n", "line 22: 9 numbers for azimuths, must be 5"),
    ],
    "lighttools": [
        ("AOI 20", "AOI 95", "line 8, column 'AOI': 95 is not allowed"),
        ("Side Front", "Side Top", "line 10: Side is 'Top', must be one of front, back"),
        ("Monochrome", "RGB", "line 2: SpectralContent is 'RGB'"),
    ],
    "klems": [
        ("</WindowElement>", "</WindowElemen>", "not well-formed XML"),
        (">Columns<", ">TensorTree5<", "IncidentDataStructure is 'tensortree5'"),
        ("<UpperTheta>15<", "<UpperTheta>150<", "a ring from 5 to 150 degrees"),
        ("Reflection Front", "Reflection Left", "WavelengthDataDirection is 'reflection left'"),
    ],
    "tensortree": [
        (TREE, tree, f"reflection back: the tree .*{message}")
        for tree, message in {
            "{1 2 3}": "a grid of 3 numbers, must be a power of 8",
            "{ {1} {2} }": "a node of 2, must be 8",
            "{1} }": "a '}' too many",
            "{" * 30: "deeper than",
        }.items()
    ]
    + [(TREE, "{x}", "the tree: could not convert string to float"), (TREE, "", "reflection back: there is no tree")],
    "zemax": [
        ("DataEnd\n", "", "the file ends where DataEnd is expected"),
        ("0 90 180", "0 90 180 270", "line 11: 4 angles for ScatterAzimuth, must be 3 as announced in line 10"),
        ("Symmetry PlaneSymmetrical\n", "", "line 14: the header ends here without symmetry"),
    ],
}
"""By format, what takes the place of what in a sound file."""

CASES = [
    *((kind, text, message) for kind, texts in WHOLE.items() for text, message in texts.items()),
    *((kind, tuple(change), message) for kind, changes in CHANGED.items() for *change, message in changes),
]


@pytest.mark.parametrize(("kind", "given", "message"), CASES)
def test_what_is_wrong_is_said_on_one_line(made, tmp_path, kind, given, message):
    if isinstance(given, tuple):
        sound = ZEMAX if kind == "zemax" else made(kind).decode("latin-1")
        assert given[0] in sound
        given = sound.replace(*given).encode("latin-1")
    path = written(tmp_path, given, "some.file")
    with pytest.raises(ValueError, match=message) as refused:
        read(path, format=kind)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)
