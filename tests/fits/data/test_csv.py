"""CSV: what its columns mean, what is estimated and left out, and that what is written comes back; totals too."""

from dataclasses import replace

import numpy as np
import pytest

from fits import Measurements, Totals, read, write_csv
from fits.data.geometry import direction
from fits.data.measurements import Source
from tests.helpers.refusals import refuses

HEADER = "theta_i,phi_i,theta_o,phi_o,brdf"
COSINE = 1 / np.cos(np.radians(60))
KINDS = "total_reflectance", "unscattered_transmittance"
TOTALS = "theta_i,total_reflectance,total_reflectance_std,total_transmittance,total_transmittance_std"


def test_capitals_in_names_of_columns_are_as_good(reading):
    data = reading("Theta_I,PHI_I,theta_O,Phi_o,BRDF_Red,BRDF_Red_STD,Used\n10,180,20,0,0.5,0.1,1\n")
    assert (data.channels, data.source.notes) == (("Red",), ())
    np.testing.assert_array_equal([data.values, data.sigma], [[[0.5]], [[0.1]]])
    np.testing.assert_array_equal(reading("Theta_i,Total_Reflectance\n0,0.3\n").values, [[0.3]])


@pytest.mark.parametrize(
    ("column", "quantity", "factor", "meaning"),
    [
        ("brdf", "brdf", 1.0, ""),
        ("brdf_cos", "brdf_cos", COSINE, ""),
        ("reflectance_factor", "reflectance_factor", 1 / np.pi, ""),
        ("bsdf", "brdf", 1.0, "the BRDF in 1/sr"),
        ("bsdf_cos", "brdf_cos", COSINE, "the BRDF times the cosine of theta_o"),
        ("brf", "reflectance_factor", 1 / np.pi, "the reflectance factor pi times the BRDF"),
        ("reflectance", "reflectance_factor", 1 / np.pi, "the reflectance factor pi times the BRDF"),
    ],
)
def test_quantities_are_converted_once_and_recorded(reading, tmp_path, column, quantity, factor, meaning):
    names = [f"{column}_{wavelength}" for wavelength in (450, 550)]
    for columns, suffix, cells in (([column], "std", "0.3,0.02"), (names, "sigma", "1,2,0.1,0.2")):
        head = ",".join([*columns, *(f"{name}_{suffix}" for name in columns)])
        data = reading(f"theta_i,phi_i,theta_o,phi_o,{head}\n10,180,60,0,{cells}\n")
        found = np.concatenate([data.values[0], data.sigma[0]])
        np.testing.assert_allclose(found, factor * np.array(cells.split(","), float), rtol=1e-14)
        said = f"column{'s' * (columns is names)} {', '.join(columns)} taken for {meaning}"
        assert data.source.notes == ((said,) if meaning else ())
        write_csv(data, tmp_path / "out.csv", force=True)
        again = read(tmp_path / "out.csv")
        np.testing.assert_array_equal(again.values, data.values)
        assert again.source.quantity == quantity  # what came in, although the new file holds BRDF
    assert data.channels == ("450", "550")


def test_one_of_several_quantities_is_chosen(reading):
    text = "theta_i,theta_o,brdf_red,brdf_650nm,brf_red\n10,20,1,2,3\n20,20,1,4,3\n"
    data = reading(text, quantity="reflectance_factor")
    assert (data.channels, data.source.notes[-1]) == (("red",), "columns not used: brdf_red, brdf_650nm")
    refuses("no column 'brdf_cos'", reading, text, quantity="brdf_cos")
    found = reading("theta_i,theta_o,brdf,total_reflectance\n0,20,0.1,0.3\n")
    assert not isinstance(found, Totals)
    assert "columns not used: total_reflectance" in found.source.notes


def test_missing_spread_is_estimated_and_noted(reading):
    rows = "10,180,0,0,1.0,0.1\n10,180,10,0,2.0,0.4\n10,180,20,0,4.0,2.0\n10,180,30,0,3.0,\n10,180,40,0,0.0,"
    data = reading(f"{HEADER},brdf_std\n{rows}")
    # relative spreads 0.1, 0.2, 0.5: median 0.2; the last one gets the smallest spread instead of 0
    np.testing.assert_allclose(data.sigma[:, 0], [0.1, 0.4, 2.0, 0.6, 0.1])
    (note,) = data.source.notes
    assert note.startswith("2 samples of channel 'value' without a standard deviation: taken as 0.2 of the value, the")
    empty = reading(f"{HEADER},brdf_std\n10,180,0,0,1.0,\n")
    assert empty.sigma is None
    assert "sigma is unknown" in empty.source.notes[0]


@pytest.mark.parametrize("column", ["std", "sigma"])
def test_a_spread_beside_a_single_value_column_is_taken_for_its_own(reading, column):
    data = reading(f"{HEADER}_cos,{column}\n10,180,0,0,2.0,0.1\n10,180,60,0,4.0,0.3\n")
    np.testing.assert_allclose(data.sigma[:, 0], [0.1, 0.6])
    assert data.source.notes == (f"column {column} taken for the standard deviation of brdf_cos",)
    colours = reading(f"theta_i,theta_o,brdf_red,brdf_blue,{column}\n10,20,1,2,0.1\n")
    assert (colours.sigma, colours.source.notes[-1]) == (None, f"columns not used: {column}")


@pytest.mark.parametrize("missing", ["", " ", "nan", "NaN", "-nan", "NA", "null"])
def test_what_was_not_measured_is_left_out_and_counted(reading, missing):
    rows = f"10,180,20,0,1,0.1,7\n10,180,25,0,{missing},0.1,8\n10,180,30,0,3,{missing},{missing}\n"
    data = reading(f"{HEADER},brdf_std,reflectance_factor\n{rows}", quantity="brdf")
    numbers = np.stack([data.theta_o, data.values[:, 0], data.sigma[:, 0]], axis=1)
    np.testing.assert_allclose(numbers, [[20, 1, 0.1], [30, 3, 0.3]])  # unknown: of the value as where it is known
    assert data.source.notes[0] == "skipped: 1 data point without a value (an empty cell, or nan)"
    colours = reading(f"theta_i,theta_o,brdf_red,brdf_blue\n10,20,1,{missing}\n10,25,{missing},1\n10,30,1,2\n")
    np.testing.assert_array_equal(colours.values, [[1, 2]])
    assert "skipped: 2 data points without a value (an empty cell, or nan)" in colours.source.notes


def test_angles_without_azimuths_are_signed_and_the_tangent_plane_is_masked(reading):
    data = reading("theta_i;theta_o;brdf\n30;30;1\n30;-30;2\n30;-120;3\n")
    np.testing.assert_allclose(data.wo, direction([30, 30, 120], [0, 180, 180]), atol=1e-15)
    np.testing.assert_allclose(data.wi, direction([30, 30, 30], 180), atol=1e-15)  # mirror, then retro-reflection
    assert "signed" in data.source.notes[0]
    data = reading("theta_i,phi_i,theta_o,phi_o,brdf_cos\n10,180,90,0,0\n90,180,10,0,1\n10,180,10,0,1\n")
    np.testing.assert_array_equal(data.mask, [False, False, True])
    assert data.source.notes == ("masked: 2 samples in the tangent plane (theta of 90 degrees)",)


def test_comments_quotes_blanks_and_an_attribution(reading):
    text = '# measured on a Monday\n# attribution: A. Author, CC-BY\n\n"theta_i","phi_i","theta_o","phi_o","brdf"\r\n'
    data = reading(f"{text}10, 180, 20, 0, 1e-3\r\n\n")
    assert (data.values.tolist(), data.source.attribution, data.source.notes) == ([[1e-3]], "A. Author, CC-BY", ())
    windows = f"# attribution: Prüfstand, 20 °C … Nr. 7\n{HEADER}\n10,180,20,0,0.5\n".encode("cp1252")
    assert reading(windows).source.attribution == "Prüfstand, 20 °C … Nr. 7"


def test_written_csv_comes_back_exactly(tmp_path):
    random, count = np.random.default_rng(0), 200
    data = Measurements(
        wi=direction(random.uniform(0, 180, count), random.uniform(0, 360, count)),  # which others may not write
        wo=direction(random.uniform(0, 180, count), random.uniform(0, 360, count)),
        values=random.lognormal(0, 5, (count, 2)) * random.choice([-1, 1], (count, 2)),
        sigma=random.lognormal(0, 5, (count, 2)),
        mask=random.random(count) < 0.5,
        channels=("650nm", "near infrared"),
        source=Source("somewhere", "memory", "brdf", ("first note", "second\nnote"), "A. Author, MIT"),
    )
    write_csv(data, tmp_path / "out.csv")
    again = read(tmp_path / "out.csv")
    for name in ("values", "sigma", "mask"):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))
    for name in ("wi", "wo"):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), atol=5e-12)  # 1e-10 degrees, both angles
    assert (again.channels, again.source.attribution) == (data.channels, "A. Author, MIT")
    assert {"first note", "second note", "written by layerjax from somewhere (memory)"} <= set(again.source.notes)
    write_csv(replace(data, sigma=None), tmp_path / "bare.csv")
    assert read(tmp_path / "bare.csv").sigma is None
    for path, message in {"out.csv": "the file exists already", "no/new.csv": "there is no directory"}.items():
        refuses(message, write_csv, data, tmp_path / path)


def test_channels_come_back_or_are_not_written(tmp_path):
    path = tmp_path / "out.csv"

    def with_channel(channel):
        wi, wo = direction([30], 180), direction([20], 0)
        return Measurements(wi, wo, [[1.0, 2.0]], [[0.1, 0.2]], [True], ("red", channel))

    for channel in ("cos", "Cos", "STD", "cos_red", "blue_std", "blue_sigma", "sigma", "", "red ", "red\nedge"):
        refuses(r"channel .* cannot be written: its column would be read as", write_csv, with_channel(channel), path)
        assert not path.exists()
    for channel in ("cosine", "Red", "650nm", "red edge", "a, b", "value", "brdf"):
        data = with_channel(channel)
        write_csv(data, path, force=True)
        again = read(path)
        assert again.channels == data.channels
        np.testing.assert_array_equal([again.values, again.sigma], [data.values, data.sigma])


def test_every_cell_is_a_reading_and_rows_without_any_are_counted(reading):
    found = reading(f"# a slab\n{TOTALS},operator\n0,0.3,0.01,0.5,0.02,me\n60,0.4,0.01,,,me\n")
    assert found.kinds == ("reflectance", "reflectance", "transmittance")
    numbers = [found.values[:, 0], found.sigma[:, 0], found.theta_i, found.wo[:, 2]]
    expected = [[0.3, 0.4, 0.5], [0.01, 0.01, 0.02], [0.0, 60.0, 0.0], [1.0, 0.5, -1.0]]
    np.testing.assert_allclose(numbers, expected, atol=1e-9)
    assert found.source.notes == ("columns not used: operator",)
    found = reading("theta_i,total_reflectance,total_transmittance\n0,0.3,0.5\n10,,nan\n20,0.3,\n30,NA,\n")
    np.testing.assert_allclose(found.values[:, 0], [0.3, 0.3, 0.5])
    assert found.source.notes == ("skipped: 2 rows without a value (an empty cell, or nan)",)


@pytest.mark.parametrize(("first", "second", "channels"), [("", "_std", ("value",)), ("_r", "_b", ("r", "b"))])
def test_readings_that_were_repeated_come_back(reading, tmp_path, first, second, channels):
    columns = ",".join(f"{kind}{end}" for kind in KINDS for end in (first, second))
    found = reading(f"theta_i,{columns}\n0,0.3,0.01,0.2,0.01\n0,0.31,0.02,,\n30,0.4,0.01,0.1,0.01\n")
    write_csv(found, tmp_path / "again.csv")
    again = read(tmp_path / "again.csv")
    assert again.kinds == found.kinds == ("reflectance",) * 3 + ("unscattered",) * 2
    assert again.channels == found.channels == channels
    for name in ("theta_i", "values", *(["sigma"] if second == "_std" else [])):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), atol=1e-9)


def test_what_would_not_come_back_is_not_written(tmp_path):
    turned = replace(Totals.of([30, 30], reflectance=0.3), wi=direction(30, [180, 90]))
    refuses("several azimuths at 30 degrees", write_csv, turned, tmp_path / "new.csv")
    named = Totals.of(reflectance=0.1, channels=("a_std",))
    refuses("'a_std' of a channel would not come back", write_csv, named, tmp_path / "new.csv")
    assert not list(tmp_path.iterdir())
