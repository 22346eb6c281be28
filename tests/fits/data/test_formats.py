"""Choosing a reader and what it reads."""

import os

import numpy as np
import pytest

from fits.data.geometry import slices
from fits.data.reading import ReadOptions, read
from fits.names import FORMATS


def test_bad_arguments(reading, tmp_path):
    text = "theta_i,theta_o,brdf\n10,20,0.5\n"
    for given, message in (
        ({"format": "xls"}, f"format is 'xls', must be one of {', '.join(FORMATS)}"),
        ({"quantity": "f"}, "quantity is 'f', must be one of"),
        ({"geometry": slices()}, "geometry and bins apply to MERL and RGL files only"),
        ({"bins": 10}, "geometry and bins apply to MERL and RGL files only"),
        ({"hold_out": ["incidence=50"]}, "hold_out: it is for a fit"),
        ({"format": "zemax"}, "unknown keyword"),
    ):
        with pytest.raises(ValueError, match=message):
            reading(text, **given)
    with pytest.raises(TypeError, match="bin"):
        reading(text, bin=4)
    with pytest.raises(FileNotFoundError, match="no such file"):
        read(tmp_path / "nothing.csv")
    os.mkfifo(tmp_path / "pipe")
    for place, message in (("", "is a directory, must be a file"), ("pipe", "is a pipe or a device, must be a file")):
        with pytest.raises(ValueError, match=message):
            read(tmp_path / place)


def test_what_is_masked_selected_and_held_out(reading, tmp_path):
    rows = [f"{incidence},180,{theta},0,0.1" for incidence in (10, 50) for theta in range(0, 90, 10)]
    text = "\n".join(["theta_i,phi_i,theta_o,phi_o,brdf", *rows])
    given = {"max_polar_angle": 60.0, "select": ["incidence=10"]}
    data = reading(text, **given)
    assert len(data.used()) == 7
    path = tmp_path / "data.txt"
    np.testing.assert_array_equal(data.mask, ReadOptions(**given).read(path).mask)
    fitted, held_out = ReadOptions(hold_out=["incidence=50"]).split(path)
    assert (len(fitted.used()), len(held_out.used())) == (9, 9)
