"""Choosing a reader, and FRED tables."""

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fits.data.formats._text import read_lines
from fits.data.geometry import direction, slices
from fits.data.reading import ReadOptions, read
from fits.names import FORMATS
from tests.helpers import data_files
from tests.helpers.places import COATINGS as DATA

_file = partial(data_files.written, name="table.txt")


@pytest.mark.parametrize(
    ("name", "format"),
    [
        ("AnoBlackNiTEonSteel.bsdf", "zemax"),
        ("AnoBlackNiTEonSteel.txt", "fred"),
        ("aeroglaze_650nm_inplane.csv", "csv"),
    ],
)
def test_content_decides_and_not_the_name(tmp_path, name, format):
    disguised = _file(tmp_path, (DATA / name).read_bytes(), name="data.xyz")
    assert read(disguised).source.format == read(DATA / name).source.format == format


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"<?xml version='1.0'?>", "not well-formed XML"),
        (b"\x01\x02\x00\x03rest", "unknown binary file, starts with 01 02 00 03"),
        (b"BSDF 2.0 of something\n1 2 3\n", "unknown format, the first line is 'BSDF 2.0 of something'"),
    ],
)
def test_unknown_bsdf_files_say_what_was_seen(tmp_path, head, message):
    with pytest.raises(ValueError, match=message):
        read(_file(tmp_path, head, name="sample.bsdf"))


def test_bad_arguments(tmp_path):
    path = _file(tmp_path, "theta_i,theta_o,brdf\n10,20,0.5\n")
    with pytest.raises(ValueError, match=f"format is 'xls', must be one of {', '.join(FORMATS)}"):
        read(path, format="xls")
    with pytest.raises(ValueError, match="quantity is 'f', must be one of"):
        read(path, quantity="f")
    with pytest.raises(ValueError, match="geometry and bins apply to MERL and RGL files only"):
        read(path, geometry=slices())
    with pytest.raises(FileNotFoundError, match="no such file"):
        read(tmp_path / "nothing.csv")
    with pytest.raises(ValueError, match="starts with 'type bsdf_data'"):
        read(path, format="fred")
    with pytest.raises(ValueError, match="unknown keyword"):
        read(path, format="zemax")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_what_is_no_file_is_said(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: is a pipe or a device, must be a file"):
        read(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is a directory, must be a file"):
        read(tmp_path)


def test_a_byte_order_mark_is_no_text(tmp_path):
    path = _file(tmp_path, b"\xef\xbb\xbf1 2\n\xb0\n")
    assert [line.text for line in read_lines(path, "latin-1")] == ["1 2", "°"]


def test_fred_file_is_the_csv_plus_the_laboratory_floor():
    """The laboratory shifted its readings by one constant before it wrote this file: f cos theta_o differs by that."""
    fred, csv = read(DATA / "AnoBlackNiTEonSteel.txt"), read(DATA / "nite_on_blasted_steel1008_650nm_hemisphere.csv")
    there = {
        (*np.round(wi, 6), *np.round(wo, 6)): f for wi, wo, f in zip(csv.wi, csv.wo, csv.values[:, 0], strict=True)
    }
    pairs = [
        (f, there[key], wo[2])
        for wi, wo, f in zip(fred.wi, fred.wo, fred.values[:, 0], strict=True)
        if (key := (*np.round(wi, 6), *np.round(wo, 6))) in there
    ]
    ours, theirs, cosine = np.array(pairs).T
    assert len(pairs) > 0.95 * len(fred)
    # at the normal the CSV averages the readings of all azimuths, the FRED file those of one
    tilted = cosine < 0.9999
    ours, theirs, cosine = ours[tilted], theirs[tilted], cosine[tilted]
    floor = np.median((ours - theirs) * cosine)
    assert 7.5e-5 < floor < 7.6e-5
    rounding = 5e-7 + 5e-6 * theirs + 2e-8  # six decimals here, six digits there, and the floor as found
    assert (abs(ours - theirs - floor / cosine) <= rounding).all()


def test_fred_by_hand(tmp_path):
    text = "type bsdf_data\nformat angles=deg bsdf=value scale=2\n15 0\n-30 0 0.1\n30 90 0.2\n0 0\n10 0 0.3\n"
    data = read(_file(tmp_path, text))
    np.testing.assert_allclose(data.values[:, 0], [0.2, 0.4, 0.6])
    np.testing.assert_allclose(data.theta_i, [15, 15, 0])
    np.testing.assert_allclose(data.wo[:2], [direction(30, 180), direction(30, 90)], atol=1e-15)
    np.testing.assert_allclose(data.phi_i[:2], 180)  # the file gives the mirror direction


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("type bsdf_data\n", "must be followed by a line 'format"),
        ("type bsdf_data\nformat angles=sin\n", "line 2: 'angles=sin' is not supported"),
        ("type bsdf_data\nformat bsdf=log\n", "line 2: 'bsdf=log' is not supported"),
        ("type bsdf_data\nformat scale=x\n", "line 2, column 'scale': 'x' is not a number"),
        ("type bsdf_data\nformat scale=1\n", "no samples"),
        ("type bsdf_data\nformat scale=1\n1 2 3\n", "line 3: a scatter direction before any specular"),
        ("type bsdf_data\nformat scale=1\n1 2\n3 4 5 6\n", "line 4: 4 numbers, must be 2"),
        ("type bsdf_data\nformat scale=1\n1 2\n3 4 x\n", "line 4, column 'bsdf': 'x' is not a number"),
        ("type bsdf_data\nformat scale=1\n1 2\n99 4 1\n", "line 4, column 'theta_scat': 99 is not allowed"),
    ],
)
def test_bad_fred(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read(_file(tmp_path, text))


def test_keywords_and_options_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{incidence},180,{theta},0,0.1" for incidence in (10, 50) for theta in range(0, 90, 10)]
    path.write_text("\n".join(["theta_i,phi_i,theta_o,phi_o,brdf", *rows]))
    given = {"max_polar_angle": 60.0, "select": ["incidence=10"]}
    assert read(path, **given).used().values.shape == (7, 1)
    np.testing.assert_array_equal(read(path, **given).mask, ReadOptions(**given).read(path).mask)
    fitted, held_out = ReadOptions(hold_out=["incidence=50"]).split(path)
    assert (len(fitted.used()), len(held_out.used())) == (9, 9)
    with pytest.raises(ValueError, match="hold_out: it is for a fit"):
        read(path, hold_out=["incidence=50"])
    with pytest.raises(TypeError, match="bin"):
        read(path, bin=4)
