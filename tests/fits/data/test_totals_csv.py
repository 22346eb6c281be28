"""Totals as columns of a CSV: read as they stand, refused on one line."""

from dataclasses import replace

import numpy as np
import pytest

from fits.data.formats import totals_csv, write_csv
from fits.data.geometry import direction
from fits.data.reading import read
from fits.data.totals import Totals

HEADER = "theta_i,total_reflectance,total_reflectance_std,total_transmittance,total_transmittance_std"


def written(tmp_path, *lines):
    path = tmp_path / "slab.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_every_cell_is_a_reading(tmp_path):
    found = read(written(tmp_path, "# a slab", HEADER + ",operator", "0,0.3,0.01,0.5,0.02,me", "60,0.4,0.01,,,me"))
    assert isinstance(found, Totals)
    assert found.kinds == ("reflectance", "reflectance", "transmittance")
    np.testing.assert_allclose(found.values[:, 0], [0.3, 0.4, 0.5])
    np.testing.assert_allclose(found.sigma[:, 0], [0.01, 0.01, 0.02])
    np.testing.assert_allclose(found.theta_i, [0.0, 60.0, 0.0], atol=1e-9)
    assert found.wo[:, 2].tolist() == pytest.approx([1.0, 0.5, -1.0])
    assert found.source.notes == ("columns not used: operator",)


def test_channels_and_unscattered_light(tmp_path):
    names = "theta_i,unscattered_transmittance_red,unscattered_transmittance_blue"
    found = read(written(tmp_path, names, "0,0.3,0.1"))
    assert found.channels == ("red", "blue")
    assert found.kinds == ("unscattered",)
    assert found.sigma is None


def test_readings_that_were_repeated_come_back(tmp_path):
    names = "theta_i,total_reflectance,total_reflectance_std,unscattered_transmittance,unscattered_transmittance_std"
    found = read(written(tmp_path, names, "0,0.3,0.01,0.2,0.01", "0,0.31,0.02,,", "30,0.4,0.01,0.1,0.01"))
    totals_csv.write(found, tmp_path / "again.csv")
    again = read(tmp_path / "again.csv")
    assert again.kinds == found.kinds == ("reflectance",) * 3 + ("unscattered",) * 2
    for name in ("theta_i", "values", "sigma"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), atol=1e-9)


def test_azimuths_of_the_light_are_not_lost_silently(tmp_path):
    found = Totals.of([30, 30], reflectance=0.3)
    turned = replace(found, wi=direction(30, [180, 90]))
    with pytest.raises(ValueError, match="several azimuths at 30 degrees"):
        totals_csv.write(turned, tmp_path / "turned.csv")


def test_a_bsdf_beside_a_column_of_totals_is_a_bsdf(tmp_path):
    found = read(written(tmp_path, "theta_i,theta_o,brdf,total_reflectance", "0,20,0.1,0.3"))
    assert not isinstance(found, Totals)
    assert "columns not used: total_reflectance" in found.source.notes


def test_they_are_not_written_as_what_they_are_not(tmp_path):
    with pytest.raises(ValueError, match="totals are no BSDF values"):
        write_csv(Totals.of(reflectance=0.3), tmp_path / "new.csv")
    assert not (tmp_path / "new.csv").exists()


def test_more_than_all_the_light_is_noted(tmp_path):
    found = read(written(tmp_path, HEADER, "0,0.7,0.01,0.5,0.02"))
    assert "1.2 together" in found.source.notes[0]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((HEADER, "90,0.3,0.01,0.5,0.02"), "line 2, column 'theta_i': 90 is not allowed"),
        ((HEADER, "0,-0.3,0.01,0.5,0.02"), "column 'total_reflectance': -0.3 is not allowed"),
        ((HEADER, "0,0.3,0,0.5,0.02"), "column 'total_reflectance_std': 0 is not allowed"),
        ((HEADER, "0,x,0.1,0.5,0.02"), "'x' is not a number"),
        ((HEADER,), "no samples below the header"),
        (("total_reflectance", "0.3"), "no column 'theta_i'"),
        (("theta_i,total_reflectance,total_reflectance_std,total_transmittance", "0,0.3,0.1,0.2"), "only some kinds"),
        (("theta_i,total_reflectance_a,total_transmittance_b", "0,0.3,0.1"), "every kind must have the same"),
        (
            ("theta_i,total_reflectance_a,total_reflectance_b", "0,0.3,"),
            "line 2, column 'total_reflectance_b': the cell",
        ),
        (("theta_i,total_reflectance", "0,", "10,"), "line 1: all cells of values are empty"),
        (("# a comment",), "the file holds only comments, must have a header line"),
    ],
)
def test_bad_files_are_refused_on_one_line(tmp_path, lines, words):
    with pytest.raises(ValueError, match=words) as refused:
        read(written(tmp_path, *lines), format="totals")
    assert "\n" not in str(refused.value)
    assert "slab.csv" in str(refused.value)
