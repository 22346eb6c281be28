"""CSV: reading with all its conversions, writing, and errors that name the place."""

import os
from functools import partial

import numpy as np
import pytest

from fits.data.formats import write_csv
from fits.data.geometry import direction
from fits.data.measurements import Measurements, Source
from fits.data.reading import read
from tests.helpers import data_files
from tests.helpers.places import COATINGS as DATA

HEADER = "theta_i,phi_i,theta_o,phi_o,brdf"


_file = partial(data_files.written, name="slices.csv")


def test_real_file_against_numpy():
    data = read(DATA / "aeroglaze_650nm_inplane.csv")
    raw = np.genfromtxt(DATA / "aeroglaze_650nm_inplane.csv", delimiter=",", names=True)
    assert len(data) == 584
    for name in ("theta_i", "phi_i", "theta_o", "phi_o"):
        np.testing.assert_allclose(getattr(data, name)[raw["theta_o"] > 0], raw[name][raw["theta_o"] > 0], atol=1e-9)
    np.testing.assert_array_equal(data.values[:, 0], raw["brdf"])
    np.testing.assert_array_equal(data.sigma[:, 0], raw["brdf_std"])
    assert data.mask.all()
    assert data.channels == ("value",)
    assert data.source.quantity == "brdf"
    assert data.source.notes == ("columns not used: n",)


@pytest.mark.parametrize(
    ("quantity", "factor"),
    [("brdf", 1.0), ("brdf_cos", 1 / np.cos(np.radians(60))), ("reflectance_factor", 1 / np.pi)],
)
def test_quantities_are_converted_once_and_recorded(tmp_path, quantity, factor):
    path = _file(tmp_path, f"theta_i,phi_i,theta_o,phi_o,{quantity},{quantity}_std\n10,180,60,0,0.3,0.02\n")
    data = read(path)
    np.testing.assert_allclose([data.values[0, 0], data.sigma[0, 0]], np.array([0.3, 0.02]) * factor, rtol=1e-14)
    assert data.source.quantity == quantity
    write_csv(data, tmp_path / "out.csv")
    again = read(tmp_path / "out.csv")
    np.testing.assert_array_equal(again.values, data.values)
    assert again.source.quantity == quantity  # what came in, although the new file holds BRDF


@pytest.mark.parametrize(
    ("column", "quantity", "factor", "meaning"),
    [
        ("bsdf", "brdf", 1.0, "the BRDF in 1/sr"),
        ("bsdf_cos", "brdf_cos", 1 / np.cos(np.radians(60)), "the BRDF times the cosine of theta_o"),
        ("brf", "reflectance_factor", 1 / np.pi, "the reflectance factor pi times the BRDF"),
        ("reflectance", "reflectance_factor", 1 / np.pi, "the reflectance factor pi times the BRDF"),
    ],
)
def test_other_names_of_quantities_are_noted(tmp_path, column, quantity, factor, meaning):
    path = _file(tmp_path, f"theta_i,phi_i,theta_o,phi_o,{column},{column}_sigma\n10,180,60,0,0.3,0.02\n")
    data = read(path)
    np.testing.assert_allclose([data.values[0, 0], data.sigma[0, 0]], np.array([0.3, 0.02]) * factor, rtol=1e-14)
    assert data.source.quantity == quantity
    assert data.source.notes == (f"column {column} taken for {meaning}",)
    np.testing.assert_array_equal(read(path, quantity=quantity).values, data.values)

    names = [f"{column}_{wavelength}" for wavelength in (450, 550, 650)]
    heads = ",".join([*names, *(f"{name}_std" for name in names)])
    path = _file(tmp_path, f"theta_i,phi_i,theta_o,phi_o,{heads}\n10,180,60,0,1,2,3,0.1,0.2,0.3\n")
    data = read(path)
    assert data.channels == ("450", "550", "650")
    np.testing.assert_allclose(data.values[0], factor * np.array([1, 2, 3]), rtol=1e-14)
    np.testing.assert_allclose(data.sigma[0], factor * np.array([0.1, 0.2, 0.3]), rtol=1e-14)
    assert data.source.notes == (f"columns {', '.join(names)} taken for {meaning}",)


def test_names_of_one_quantity_do_not_stand_side_by_side(tmp_path):
    path = _file(tmp_path, "theta_i,theta_o,brf_red,reflectance_blue\n10,20,1,2\n")
    with pytest.raises(ValueError, match="columns brf, reflectance: names of one quantity, must be only one of them"):
        read(path)
    path = _file(tmp_path, "theta_i,theta_o,bsdf,brf\n10,20,1,2\n")
    with pytest.raises(ValueError, match=r"2 quantities \(brdf, reflectance_factor\): choose one with quantity"):
        read(path)
    assert read(path, quantity="reflectance_factor").source.notes[-1] == "columns not used: bsdf"


def test_channels_and_choice_among_quantities(tmp_path):
    head = "theta_i,phi_i,theta_o,phi_o,brdf_red,brdf_650nm,brdf_red_sigma,reflectance_factor_red"
    path = _file(tmp_path, f"{head}\n10,180,20,0,1,2,0.1,3\n20,180,20,0,1,4,,3\n")
    with pytest.raises(ValueError, match=r"2 quantities \(brdf, reflectance_factor\): choose one with quantity"):
        read(path)
    data = read(path, quantity="reflectance_factor")
    assert (data.channels, data.values.shape) == (("red",), (2, 1))
    with pytest.raises(ValueError, match="no column 'brdf_cos'"):
        read(path, quantity="brdf_cos")
    with pytest.raises(ValueError, match="channel '650nm' has no standard deviation"):
        read(path, quantity="brdf")


def test_missing_spread_is_estimated_and_noted(tmp_path):
    rows = ["10,180,0,0,1.0,0.1", "10,180,10,0,2.0,0.4", "10,180,20,0,4.0,2.0", "10,180,30,0,3.0,", "10,180,40,0,0.0,"]
    data = read(_file(tmp_path, f"{HEADER},brdf_std\n" + "\n".join(rows)))
    # relative spreads 0.1, 0.2, 0.5: median 0.2; the last one gets the smallest spread instead of 0
    np.testing.assert_allclose(data.sigma[:, 0], [0.1, 0.4, 2.0, 0.6, 0.1])
    assert data.source.notes == (
        "2 samples of channel 'value' without a standard deviation: taken as 0.2 of the value, "
        "the median of the 3 that have one",
    )
    empty = read(_file(tmp_path, f"{HEADER},brdf_std\n10,180,0,0,1.0,\n"))
    assert empty.sigma is None
    assert "sigma is unknown" in empty.source.notes[0]


@pytest.mark.parametrize("missing", ["", " ", "nan", "NaN", "-nan", "NA", "null"])
def test_what_was_not_measured_is_left_out_and_counted(tmp_path, missing):
    rows = f"10,180,20,0,1,0.1,7\n10,180,25,0,{missing},0.1,8\n10,180,30,0,3,{missing},{missing}\n"
    data = read(_file(tmp_path, f"{HEADER},brdf_std,reflectance_factor\n{rows}"), quantity="brdf")
    np.testing.assert_allclose(data.values[:, 0], [1, 3])
    np.testing.assert_allclose(data.theta_o, [20, 30])
    np.testing.assert_allclose(data.sigma[:, 0], [0.1, 0.3])  # unknown: as much of the value as where it is known
    assert data.source.notes[0] == "skipped: 1 data point without a value (an empty cell, or nan)"
    colours = f"theta_i,theta_o,brdf_red,brdf_blue\n10,20,1,{missing}\n10,25,{missing},1\n10,30,1,2\n"
    data = read(_file(tmp_path, colours))
    np.testing.assert_array_equal(data.values, [[1, 2]])
    assert "skipped: 2 data points without a value (an empty cell, or nan)" in data.source.notes


def test_signed_theta_without_azimuths(tmp_path):
    data = read(_file(tmp_path, "theta_i;theta_o;brdf\n30;30;1\n30;-30;2\n30;-120;3\n"))
    np.testing.assert_allclose(data.wo, [direction(30, 0), direction(30, 180), direction(120, 180)], atol=1e-15)
    np.testing.assert_allclose((data.wi + data.wo)[0, :2], 0, atol=1e-15)  # mirror
    np.testing.assert_allclose(data.wi[1], data.wo[1], atol=1e-15)  # retro-reflection
    assert "signed" in data.source.notes[0]


def test_tangent_plane_is_masked(tmp_path):
    path = _file(tmp_path, "theta_i,phi_i,theta_o,phi_o,brdf_cos\n10,180,90,0,0\n90,180,10,0,1\n10,180,10,0,1\n")
    data = read(path)
    np.testing.assert_array_equal(data.mask, [False, False, True])
    assert np.isfinite(data.values).all()
    assert data.source.notes == ("masked: 2 samples in the tangent plane (theta of 90 degrees)",)


def test_comments_quotes_blank_lines_and_bom(tmp_path):
    text = '\ufeff# measured on a Monday\n\n"theta_i","phi_i","theta_o","phi_o","brdf"\r\n10, 180, 20, 0, 1e-3\r\n\n'
    assert read(_file(tmp_path, text)).values.tolist() == [[1e-3]]


GOOD = "10,180,20,0,0.5\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        (" \n\n", "the file is empty"),
        ("# nothing else\n", "the file holds only comments"),
        (HEADER + "\n", "line 1: no samples below the header"),
        (
            "theta_i,phi_i,phi_o,brdf\n1,2,3,4\n",
            "line 1: no column 'theta_o', the file has theta_i, phi_i, phi_o, brdf",
        ),
        ("theta_i,phi_i,theta_o,brdf\n1,2,3,4\n", "line 1: no column 'phi_o'"),
        (
            "theta_i,phi_i,theta_o,phi_o,value\n1,2,3,4,5\n",
            "no value column: must be one of brdf, brdf_cos, reflectance_factor, bsdf, bsdf_cos, brf, reflectance;",
        ),
        (HEADER + ",brdf\n10,180,20,0,1,1\n", "line 1, column 'brdf': this column appears twice"),
        (
            HEADER + ",brdf_red\n10,180,20,0,1,1\n",
            "columns brdf, brdf_red: one without a channel name cannot stand beside others",
        ),
        ("theta_i,theta_o,brf_cos\n10,20,1\n", "column 'brf_cos': no channel may be called 'cos'; products with the"),
        (HEADER + "\n" + GOOD + "10,180,20,0,abc\n", "line 3, column 'brdf': 'abc' is not a number, must be a finite"),
        (HEADER + "\n# x\n\n,180,20,0,1\n", "line 4, column 'theta_i': '' is not a number"),
        (HEADER + "\n10,180,nan,0,1\n", "line 2, column 'theta_o': nan is not allowed, must be a number in"),
        (HEADER + "\n10,180,20,0,\n10,180,25,0,NaN\n", "line 1: no data point below holds a number in column brdf"),
        (HEADER + "\n10,180,20,0,inf\n", "line 2, column 'brdf': inf is not allowed"),
        (HEADER + "\n10,180,20,0,1e300\n", r"line 2, column 'brdf': 1e300 is not allowed, .*at most 1e\+30 in size"),
        (HEADER + ",brdf_std\n10,180,20,0,1,1e-200\n", "line 2, column 'brdf_std': 1e-200 is not allowed, must be > 0"),
        (HEADER + ",brdf_std\n10,180,20,0,1,1e300\n", "line 2, column 'brdf_std': 1e300 is not allowed"),
        (HEADER + "\n91,180,20,0,1\n", r"line 2, column 'theta_i': 91 is not allowed, must be a number in \[0, 90\]"),
        (HEADER + "\n10,180,-5,0,1\n", r"line 2, column 'theta_o': -5 is not allowed, must be a number in \[0, 180\]"),
        (
            HEADER + "\n10,720,20,0,1\n",
            r"line 2, column 'phi_i': 720 is not allowed, must be a number in \[-360, 360\]",
        ),
        (HEADER + "\n10,180,20,0\n", "line 2: 4 cells, must be 5 as in the header"),
        (
            HEADER + ",brdf_std\n10,180,20,0,1,-0.1\n",
            r"line 2, column 'brdf_std': -0.1 is not allowed, must be a number in",
        ),
        (HEADER + ",brdf_std\n" + "10,180,20,0,1,0\n", "line 2, column 'brdf_std': 0 is not allowed, must be > 0"),
        (HEADER + ",used\n10,180,20,0,1,2\n", "line 2, column 'used': 2 is not allowed"),
        (HEADER + '\n10,180,"20,0,1\n', "line 2: not a line of CSV"),
        (HEADER.encode() + b"\n10,180,20,0,\xff\n", "not a text file"),
        (HEADER.encode() + b"\n10,\x00\n", "unknown binary file"),
        (bytes(range(200, 256)) * 10, "not a text file"),
    ],
)
def test_bad_csv_is_one_line_that_names_the_place(tmp_path, text, message):
    path = _file(tmp_path, text)
    with pytest.raises(ValueError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_written_csv_comes_back_exactly(tmp_path):
    random = np.random.default_rng(0)
    count = 200
    data = Measurements(
        wi=direction(random.uniform(0, 90, count), random.uniform(0, 360, count)),
        wo=direction(random.uniform(0, 180, count), random.uniform(0, 360, count)),
        values=random.lognormal(0, 5, (count, 2)) * random.choice([-1, 1], (count, 2)),
        sigma=random.lognormal(0, 5, (count, 2)),
        mask=random.random(count) < 0.5,
        channels=("650nm", "near infrared"),
        source=Source("somewhere", "memory", "brdf", ("first note", "second\nnote"), "A. Author, MIT"),
    )
    path = tmp_path / "out.csv"
    write_csv(data, path)
    again = read(path)
    for name in ("values", "sigma", "mask"):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))
    for name in ("wi", "wo"):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), atol=5e-12)  # 1e-10 degrees, both angles
    assert again.channels == data.channels
    assert again.source.attribution == "A. Author, MIT"
    assert {"first note", "second note", "written by layerjax from somewhere (memory)"} <= set(again.source.notes)


def test_light_from_below_comes_back_but_is_refused_in_foreign_files(tmp_path):
    data = Measurements(direction([120], 180), direction([30], 0), [[1.0]], None, [True], ("value",))
    path = tmp_path / "out.csv"
    write_csv(data, path)
    np.testing.assert_allclose(read(path).wi, data.wi, atol=5e-12)
    with pytest.raises(ValueError, match=r"column 'theta_i': 120\.0 is not allowed"):
        read(_file(tmp_path, path.read_text().replace("# layerjax measurements", "# mine")))


def test_attribution_is_read_from_a_comment(tmp_path):
    data = read(_file(tmp_path, f"# attribution: A. Author, CC-BY\n{HEADER}\n{GOOD}"))
    assert (data.source.attribution, data.source.notes) == ("A. Author, CC-BY", ())


def test_writer_is_atomic_and_does_not_overwrite(tmp_path, monkeypatch):
    data = read(_file(tmp_path, f"{HEADER}\n{GOOD}"))
    path = tmp_path / "out.csv"
    path.write_text("precious")
    with pytest.raises(ValueError, match=r"out\.csv: the file exists already"):
        write_csv(data, path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", _full_disk)
        with pytest.raises(OSError, match="disk full"):
            write_csv(data, path, force=True)
    assert path.read_text() == "precious"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["out.csv", "slices.csv"]
    write_csv(data, path, force=True)
    np.testing.assert_array_equal(read(path).values, data.values)
    with pytest.raises(ValueError, match="there is no directory"):
        write_csv(data, tmp_path / "no" / "out.csv")


def _full_disk(*_) -> None:
    raise OSError("disk full")


@pytest.mark.parametrize("channel", ["cos", "cos_red", "blue_std", "blue_sigma", "sigma", "", "red ", "red\nedge"])
def test_a_channel_whose_column_would_be_read_as_another_is_not_written(tmp_path, channel):
    w = np.array([[0.0, 0.6, 0.8]])
    data = Measurements(w, w, np.ones((1, 2)), None, np.array([True]), ("red", channel))
    with pytest.raises(ValueError, match=r"channel .* cannot be written: its column would be read as"):
        write_csv(data, tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("channel", ["cosine", "650nm", "red edge", "a, b", "value", "brdf"])
def test_other_channels_come_back(tmp_path, channel):
    w = np.array([[0.0, 0.6, 0.8]])
    data = Measurements(w, w, np.array([[1.0, 2.0]]), np.full((1, 2), 0.1), np.array([True]), ("other", channel))
    write_csv(data, tmp_path / "out.csv")
    again = read(tmp_path / "out.csv")
    assert again.channels == data.channels
    np.testing.assert_array_equal(again.values, data.values)
    np.testing.assert_array_equal(again.sigma, data.sigma)
