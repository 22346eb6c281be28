"""Totals as columns of a CSV: read as they stand, and written so that they come back."""

from dataclasses import replace

import numpy as np
import pytest

from fits import Totals, read, write_csv
from fits.data.geometry import direction

HEADER = "theta_i,total_reflectance,total_reflectance_std,total_transmittance,total_transmittance_std"


def test_every_cell_is_a_reading(reading):
    found = reading(f"# a slab\n{HEADER},operator\n0,0.3,0.01,0.5,0.02,me\n60,0.4,0.01,,,me\n")
    assert isinstance(found, Totals)
    assert found.kinds == ("reflectance", "reflectance", "transmittance")
    np.testing.assert_allclose(found.values[:, 0], [0.3, 0.4, 0.5])
    np.testing.assert_allclose(found.sigma[:, 0], [0.01, 0.01, 0.02])
    np.testing.assert_allclose(found.theta_i, [0.0, 60.0, 0.0], atol=1e-9)
    assert found.wo[:, 2].tolist() == pytest.approx([1.0, 0.5, -1.0])
    assert found.source.notes == ("columns not used: operator",)


@pytest.mark.parametrize("missing", ["", "nan", "NA"])
def test_rows_without_any_value_are_counted(reading, missing):
    rows = f"0,0.3,0.5\n10,{missing},{missing}\n20,0.3,{missing}\n30,{missing},{missing}\n"
    found = reading(f"theta_i,total_reflectance,total_transmittance\n{rows}")
    np.testing.assert_allclose(found.values[:, 0], [0.3, 0.3, 0.5])
    assert found.source.notes == ("skipped: 2 rows without a value (an empty cell, or nan)",)


def test_channels_and_unscattered_light(reading):
    found = reading("theta_i,unscattered_transmittance_red,unscattered_transmittance_blue\n0,0.3,0.1\n")
    assert found.channels == ("red", "blue")
    assert found.kinds == ("unscattered",)
    assert found.sigma is None


def test_readings_that_were_repeated_come_back(reading, tmp_path):
    names = "theta_i,total_reflectance,total_reflectance_std,unscattered_transmittance,unscattered_transmittance_std"
    found = reading(f"{names}\n0,0.3,0.01,0.2,0.01\n0,0.31,0.02,,\n30,0.4,0.01,0.1,0.01\n")
    write_csv(found, tmp_path / "again.csv")
    again = read(tmp_path / "again.csv")
    assert again.kinds == found.kinds == ("reflectance",) * 3 + ("unscattered",) * 2
    for name in ("theta_i", "values", "sigma"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), atol=1e-9)


def test_a_bsdf_beside_a_column_of_totals_is_a_bsdf(reading):
    found = reading("theta_i,theta_o,brdf,total_reflectance\n0,20,0.1,0.3\n")
    assert not isinstance(found, Totals)
    assert "columns not used: total_reflectance" in found.source.notes


def test_what_would_not_come_back_is_not_written(tmp_path):
    turned = replace(Totals.of([30, 30], reflectance=0.3), wi=direction(30, [180, 90]))
    for totals, message in (
        (turned, "several azimuths at 30 degrees"),
        (Totals.of(reflectance=0.1, channels=("a_std",)), "'a_std' of a channel would not come back"),
    ):
        with pytest.raises(ValueError, match=message):
            write_csv(totals, tmp_path / "new.csv")
    assert not list(tmp_path.iterdir())
    write_csv(Totals.of(reflectance=0.1), tmp_path / "new.csv")
    with pytest.raises(ValueError, match="exists"):
        write_csv(Totals.of(reflectance=0.2), tmp_path / "new.csv")
