"""SSDD files: the examples of its specification, all coordinates, binary numbers, and errors."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fits.data.geometry import direction
from fits.data.reading import read
from tests.helpers import data_files

LAMBERTIAN = """VERSION 0.2

DATA_TYPE brdf
COLOR_MODEL monochrome
PARAM_TYPE spherical_coordinate_system
PARAM0_LIST 0
PARAM2_LIST 0
PARAM3_LIST 0
DATA ascii
0.3183
"""
BLOCK = """DATA_TYPE {kind}
COLOR_MODEL {colour}
PARAM_TYPE {system}
PARAM0_LIST 10 40
PARAM2_LIST 0 20 60
PARAM3_LIST 0 90 200
{more}DATA {mode}
"""


_file = partial(data_files.written, name="a.ssdd")


def _block(kind="brdf", colour="monochrome", system="spherical_coordinate_system", more="", mode="ascii") -> str:
    return BLOCK.format(kind=kind, colour=colour, system=system, more=more, mode=mode)


NUMBERS = "\n".join(str(number) for number in range(18)) + "\n"  # PARAM0 runs fastest


def test_the_example_of_the_specification(tmp_path: Path) -> None:
    data = read(_file(tmp_path, LAMBERTIAN))
    assert data.source.format == "ssdd"
    np.testing.assert_array_equal(data.values, [[0.3183]])


def test_spherical(tmp_path: Path) -> None:
    data = read(_file(tmp_path, "VERSION 0.3\n" + _block() + "# a comment\n" + NUMBERS))
    number = {float(value): row for row, value in enumerate(data.values[:, 0])}
    np.testing.assert_allclose(data.wi[number[1]], direction(40, 0), atol=1e-15)
    np.testing.assert_allclose(data.wo[number[2]], direction(20, 0), atol=1e-15)
    np.testing.assert_allclose(data.wo[number[8]], direction(20, 90), atol=1e-15)
    np.testing.assert_allclose(data.wo[number[17]], direction(60, 200), atol=1e-15)


@pytest.mark.parametrize(
    ("system", "count"),
    [
        ("spherical_coordinate_system", 9),  # of each of three directions of the light: the pole, and two azimuths
        ("specular_coordinate_system", 10),  # light along the normal: its azimuth and the viewer's add up to 0, 90, 180
    ],
)
def test_directions_that_a_file_repeats_are_read_once(tmp_path: Path, system: str, count: int) -> None:
    lists = "PARAM0_LIST 0 30\nPARAM1_LIST 0 90 360\nPARAM2_LIST 0 20\nPARAM3_LIST 0 90 360\n"
    head = f"VERSION 0.3\nDATA_TYPE brdf\nCOLOR_MODEL monochrome\nPARAM_TYPE {system}\n{lists}DATA ascii\n"
    data = read(_file(tmp_path, head + "\n".join(map(str, range(36)))))
    pairs = np.round(np.hstack([data.wi, data.wo]), 9) + 0.0
    assert len(np.unique(pairs, axis=0)) == len(data) == count
    assert data.values.max() < 24  # the first of them: none of the azimuth 360
    assert f"skipped: {36 - count} values at directions that the file holds already" in data.source.notes


@pytest.mark.parametrize("kind", ["brdf", "btdf"])
def test_around_the_mirror_direction(tmp_path: Path, kind: str) -> None:
    """Angles from the specular direction, and of a BTDF from where it bends by an offset."""
    more = "PARAM4_LIST 0 -12.5\n" if kind == "btdf" else ""
    data = read(
        _file(tmp_path, "VERSION 0.3\n" + _block(kind, system="specular_coordinate_system", more=more) + NUMBERS)
    )
    sign = -1 if kind == "btdf" else 1
    for light, theta in ((10, 10), (40, 27.5 if kind == "btdf" else 40)):
        here = abs(data.theta_i - light) < 1e-9
        specular = direction(theta, 180) * [1, 1, sign]
        away = np.degrees(np.arccos(np.clip(data.wo[here] @ specular, -1, 1)))
        expected = np.repeat([[0.0, 20.0, 60.0]], 3, axis=0).ravel()
        kept = data.values[here, 0].astype(int) // 2  # which of param 2 and 3
        np.testing.assert_allclose(away, expected[kept % 9], atol=1e-6)
    # azimuth 0 leads towards the normal, azimuth 90 to +y
    first = data.wo[data.values[:, 0] == 3][0]  # light at 40, 20 degrees away, azimuth 0
    theta = (27.5 if kind == "btdf" else 40) - 20
    np.testing.assert_allclose(first, direction(theta, 180) * [1, 1, sign], atol=1e-12)
    assert data.wo[data.values[:, 0] == 9][0, 1] == pytest.approx(np.sin(np.radians(20)))


def test_half_vectors(tmp_path: Path) -> None:
    data = read(_file(tmp_path, "VERSION 0.3\n" + _block(system="half_difference_coordinate_system") + NUMBERS))
    for wi, wo, value in zip(data.wi, data.wo, data.values[:, 0], strict=True):
        half = (wi + wo) / np.linalg.norm(wi + wo)
        theta_h = [10, 40][int(value) % 2]
        assert np.degrees(np.arccos(half[2])) == pytest.approx(theta_h)
        assert half[1] == pytest.approx(0, abs=1e-12)
        local = Rotation.from_euler("y", -theta_h, degrees=True).apply(wi.copy())  # towards x is positive
        theta_d, phi_d = [0, 20, 60][int(value) // 2 % 3], [0, 90, 200][int(value) // 6]
        np.testing.assert_allclose(local, direction(theta_d, phi_d), atol=1e-12)
    assert "skipped" in " ".join(data.source.notes)  # some lie below the horizon


def test_blocks_colours_and_binary(tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).random((2, 18, 3)).astype("<f4")
    spectrum = {"colour": "spectrum", "more": "WAVELENGTH_LIST 400 500 600\n", "mode": "binary"}
    heads = [_block(kind, **spectrum).encode() for kind in ("brdf", "btdf")]
    blocks = [head + part.tobytes() + b"\n" for head, part in zip(heads, numbers, strict=True)]
    mirror = b"DATA_TYPE specular_reflectance\nCOLOR_MODEL monochrome\nPARAM0_LIST 0 90\nDATA ascii\n0.05\n1\n"
    data = read(_file(tmp_path, b"VERSION 0.3\n\nAPI libbsdf\n" + blocks[0] + mirror + blocks[1]))
    assert data.channels == ("400 nm", "500 nm", "600 nm")
    once = np.r_[0:6, 8:12, 14:18]  # at PARAM2 = 0 all azimuths are one direction
    np.testing.assert_array_equal(data.values, numbers[:, once].reshape(-1, 3).astype(float))
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), np.repeat([1, -1], 14))
    assert "skipped: specular_reflectance" in data.source.notes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("VERSION 0.2", "VERSION 2"), "line 1: VERSION is '2'"),
        (("DATA_TYPE brdf\n", ""), "line 3: 'COLOR_MODEL' found before any DATA_TYPE"),
        (("DATA_TYPE brdf", "DATA_TYPE bssrdf"), "line 3: DATA_TYPE is 'bssrdf'"),
        (("monochrome", "cmyk"), "line 4: COLOR_MODEL is 'cmyk'"),
        (("monochrome", "spectrum"), "line 4: spectrum without WAVELENGTH_LIST"),
        (("spherical_coo", "distorted_spherical_coo"), "line 5: PARAM_TYPE is 'distorted_spherical_coordinate_system'"),
        (("PARAM0_LIST 0", "PARAM0_LIST 95"), "line 6, column 'PARAM0_LIST': 95 is not allowed"),
        (("PARAM2_LIST 0\n", ""), "line 8: the header of this brdf has no PARAM2_LIST"),
        (("PARAM0_LIST 0", "PARAM0_LIST 0 10"), "the file ends where 2 lines of data are expected"),
        (("0.3183", "0.3183 1"), "line 10: 2 numbers, must be 1"),
        (("0.3183", "x"), "line 10, column 1: 'x' is not a number"),
        (("DATA ascii\n0.3183\n", ""), "the file ends where DATA is expected"),
        (("PARAM3_LIST 0", "PARAM9_LIST 0"), "line 8: unknown entry 'PARAM9_LIST'"),
    ],
)
def test_bad_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert change[0] in LAMBERTIAN
    with pytest.raises(ValueError, match=message) as error:
        read(_file(tmp_path, LAMBERTIAN.replace(*change)), format="ssdd")
    assert "a.ssdd" in str(error.value)


def test_bad_binary(tmp_path: Path) -> None:
    head = LAMBERTIAN.replace("DATA ascii\n0.3183\n", "DATA binary\n").encode()
    with pytest.raises(ValueError, match=r"line 9: 3 bytes of data, must be 4 \(truncated\?\)"):
        read(_file(tmp_path, head + b"abc"))
    with pytest.raises(ValueError, match="line 9: the data hold nan, must be finite"):
        read(_file(tmp_path, head + np.float32(np.nan).tobytes()))
