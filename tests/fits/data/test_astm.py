"""ASTM E1392 tables: angles, columns and errors."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fits.data.geometry import direction
from fits.data.reading import read
from tests.helpers import data_files

HEAD = "ASTM 1\nDATE 4/8/1998\nSAMPLE Paint, blue\nNUM_POINTS 2\nVARS theta_i,phi_i,theta_s,phi_s"


_file = partial(data_files.written, name="paint.astm")


def test_by_hand(tmp_path: Path) -> None:
    """Radians; both azimuths in one frame, as the directions stand."""
    text = f"{HEAD},R,G,B\n0.5,3.14159265,0.25,0.1,0.1,0.2,0.3\n\n0.5,0,-0.25,6.2,0.4,0.5,-0.01\n"
    data = read(_file(tmp_path, text))
    assert data.source.format == "astm"
    assert data.channels == ("red", "green", "blue")
    deg = np.degrees
    np.testing.assert_allclose(data.wi, [direction(deg(0.5), 180), direction(deg(0.5), 0)], atol=1e-8)
    np.testing.assert_allclose(
        data.wo, [direction(deg(0.25), deg(0.1)), direction(deg(0.25), deg(6.2) + 180)], atol=1e-12
    )
    np.testing.assert_array_equal(data.values, [[0.1, 0.2, 0.3], [0.4, 0.5, -0.01]])
    assert data.source.notes == ("angles taken as radians", "1 sample below zero, kept as measured")


def test_degrees_blanks_and_wavelengths(tmp_path: Path) -> None:
    text = "VARS theta_i phi_i theta_s phi_s 550nm 650nm\n30 180 40 0 0.1 0.2\n30 180 120 0 0.1 0.2\n"
    data = read(_file(tmp_path, text), quantity="brdf_cos")
    assert data.channels == ("550 nm", "650 nm")
    np.testing.assert_allclose(data.theta_o, [40, 120])
    np.testing.assert_allclose(data.values[:, 0], [0.1 / np.cos(np.radians(40)), 0.1 / 0.5])
    assert data.source.notes[0].startswith("angles taken as degrees")


def test_without_azimuth_of_the_light(tmp_path: Path) -> None:
    data = read(_file(tmp_path, "VARS theta_i,theta_s,phi_s,Integrated BRDF\n0.3,0.3,0,0.7\n"))
    np.testing.assert_allclose(data.wi * [-1, 1, 1], data.wo, atol=1e-15)
    assert data.channels == ("value",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HEAD},R,G,B\n", "no samples below VARS"),
        (f"{HEAD}\n1,2,3,4\n", "line 5: no column of values"),
        (f"{HEAD},beta\n1,2,3,4,5\n", "line 5: column 'beta' is not known"),
        (f"{HEAD},R,R\n1,2,3,4,5,6\n", "line 5: column 'R' is named twice"),
        ("VARS theta_i,phi_i,value\n1,2,3\n", "line 1: no column 'theta_s'"),
        (f"{HEAD},R\n1,2,1,4,5\n1,2,1,4\n", "line 7: 4 numbers, must be 5"),
        (f"{HEAD},R\n1,2,1,4,x\n", "line 6, column 5: 'x' is not a number"),
        (f"{HEAD},R\n1,2,1,4,nan\n", "line 6, column 5: nan is not allowed"),
        (f"{HEAD},R\n1,2,4,4,1\n", "line 6, column 'theta_s': 4 is not allowed"),
        (f"{HEAD},R\n10,20,40,400,1\n", "line 6, column 'phi_s': 400 is not allowed"),
        ("DATE 1\nsome text\nVARS theta_i,theta_s,R\n1,1,1\n", "line 2: 'some text' found, must be a key in capitals"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read(_file(tmp_path, text), format="astm")
    assert "paint.astm" in str(error.value)


def test_many_values(tmp_path: Path) -> None:
    """A million numbers."""
    numbers = np.random.default_rng(0).random((140_000, 7))
    np.savetxt(tmp_path / "big.astm", numbers, "%.6f", ",", header=f"{HEAD},R,G,B", comments="")
    data = read(tmp_path / "big.astm")
    np.testing.assert_allclose(data.values, numbers[:, 4:].round(6))
