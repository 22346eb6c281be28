"""ALTA's texts: all coordinates against angles measured on the directions they give, and errors."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fits.data.geometry import Floats, direction
from fits.data.reading import read

RANDOM = np.random.default_rng(1)
LIGHT = direction(RANDOM.uniform(1, 80, 40), RANDOM.uniform(-180, 180, 40))
VIEW = direction(RANDOM.uniform(1, 80, 40), RANDOM.uniform(-180, 180, 40))


def _file(tmp_path: Path, coordinates: str, numbers: Floats, output: str = "INV_STERADIAN", more: str = "") -> Path:
    path = tmp_path / "a.alta"
    count = len(numbers[0])
    dim_x = {"ISOTROPIC_TV_TL_DPHI": 3, "CARTESIAN": 6}.get(coordinates) or numbers.shape[1] - 1
    with path.open("w") as file:
        file.write(f"#ALTA HEADER\n#DIM {dim_x} {count - dim_x}\n#PARAM_IN  {coordinates}\n#PARAM_OUT {output}\n{more}")
        np.savetxt(file, numbers, "%.12g", "\t")
    return path


def _polar(w: Floats) -> Floats:
    return np.arccos(np.clip(w[:, 2], -1, 1))


def _around(w: Floats) -> Floats:
    return np.arctan2(w[:, 1], w[:, 0])


def _rusinkiewicz() -> Floats:
    """Half and difference angles (N, 4), by turning the half vector to the pole."""
    half = LIGHT + VIEW
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    angles = []
    for h, v in zip(half, VIEW, strict=True):
        theta, phi = np.arccos(h[2]), np.arctan2(h[1], h[0])
        d = Rotation.from_euler("zy", [-phi, -theta]).apply(v)
        angles.append((theta, phi, np.arccos(d[2]), np.arctan2(d[1], d[0])))
    return np.array(angles)


def _relative(light: Floats, view: Floats) -> Floats:
    """What does not change if all turns about the normal: cosines and the product, (N, 4)."""
    return np.stack([light[:, 2], view[:, 2], np.sum(light * view, axis=1), np.cross(light, view)[:, 2]], axis=1)


TURN = _around(VIEW) - _around(LIGHT)
HALF = _rusinkiewicz()
WHOLE = {
    "SPHERICAL_TL_PL_TV_PV": np.stack([_polar(LIGHT), _around(LIGHT), _polar(VIEW), _around(VIEW)], axis=1),
    "CARTESIAN": np.hstack([VIEW, LIGHT]),
    "RUSIN_TH_PH_TD_PD": HALF,
}
UP_TO_A_TURN = {
    "RUSIN_TH_TD_PD": HALF[:, [0, 2, 3]],
    "ISOTROPIC_TL_TV_PROJ_DPHI": np.stack(
        [_polar(LIGHT), _polar(VIEW) * np.cos(TURN), _polar(VIEW) * np.sin(TURN)], axis=1
    ),
    "ISOTROPIC_TV_TL_DPHI": np.stack([_polar(VIEW), _polar(LIGHT), -TURN], axis=1),  # from the view to the light
}


@pytest.mark.parametrize("coordinates", [*WHOLE, *UP_TO_A_TURN])
def test_coordinates(tmp_path: Path, coordinates: str) -> None:
    values = np.arange(40.0)[:, None]
    numbers = (WHOLE | UP_TO_A_TURN)[coordinates]
    data = read(_file(tmp_path, coordinates, np.hstack([numbers, values])))
    assert data.source.format == "alta"
    np.testing.assert_array_equal(data.values, values)
    np.testing.assert_allclose(_relative(data.wi, data.wo), _relative(LIGHT, VIEW), atol=1e-9)
    if coordinates in WHOLE:
        np.testing.assert_allclose([data.wi, data.wo], [LIGHT, VIEW], atol=1e-9)


@pytest.mark.parametrize("coordinates", ["RUSIN_TH_TD", "COS_TH_TD", "COS_TH"])
def test_half_angles_alone(tmp_path: Path, coordinates: str) -> None:
    """The angle between half vector and normal is that of the file, and that between half vector and light."""
    angles = RANDOM.uniform(0.05, 0.6, (20, 1 if coordinates == "COS_TH" else 2))
    numbers = np.cos(angles) if coordinates.startswith("COS") else angles
    data = read(_file(tmp_path, coordinates, np.hstack([numbers, np.ones((20, 1))])))
    half = data.wi + data.wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    np.testing.assert_allclose(_polar(half), angles[:, 0], atol=1e-9)
    difference = np.arccos(np.clip(np.sum(half * data.wi, axis=1), -1, 1))
    np.testing.assert_allclose(difference, angles[:, 1] if angles.shape[1] == 2 else 0.0, atol=1e-7)


def test_what_numbers_are(tmp_path: Path) -> None:
    """A cosine, colours, and vertical segments that are not read."""
    numbers = np.array([[0.5, 0.0, 0.6, 3.0, 0.2]])
    data = read(_file(tmp_path, "SPHERICAL_TL_PL_TV_PV", numbers, "INV_STERADIAN_COSINE_FACTOR"))
    assert data.source.quantity == "brdf_cos"
    np.testing.assert_allclose(data.values, 0.2 / np.cos(0.6))
    path = tmp_path / "b.alta"
    path.write_text("#DIM 1 3\n#VS 1 1 2\n#PARAM_IN COS_TH\n#PARAM_OUT XYZ_COLOR\n0.9 1 2 3 .1 .1 .1 .1\n")
    data = read(path, quantity="brdf")
    assert data.channels == ("X", "Y", "Z")
    np.testing.assert_array_equal(data.values, [[1, 2, 3]])
    assert "vertical segments" in " ".join(data.source.notes)


@pytest.mark.parametrize("output", ["", "#PARAM_OUT", *(f"#PARAM_OUT {word}" for word in ("UNKNOWN", "ENERGY"))])
def test_what_the_file_does_not_say_is_asked_for(tmp_path: Path, output: str) -> None:
    path = tmp_path / "hand.alta"
    rows = "0.2618 -0.2618 0.0 0.4\n0.2618 0.5236 0.0 0.1\n"
    path.write_text(f"#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n{output}\n{rows}")
    with pytest.raises(ValueError, match=r"hand\.alta: .*does not say what the values are: give quantity") as asked:
        read(path)
    assert "\n" not in str(asked.value)
    np.testing.assert_allclose(read(path, quantity="brdf").values[:, 0], [0.4, 0.1])
    cosines = np.cos([0.2618, 0.5236])
    np.testing.assert_allclose(read(path, quantity="brdf_cos").values[:, 0], [0.4, 0.1] / cosines)
    np.testing.assert_allclose(read(path, quantity="reflectance_factor").values[:, 0], np.array([0.4, 0.1]) / np.pi)


def test_colours_do_not_say_it_either_and_what_is_said_holds(tmp_path: Path) -> None:
    path = tmp_path / "a.alta"
    path.write_text("#DIM 1 3\n#PARAM_IN COS_TH\n#PARAM_OUT RGB_COLOR\n0.9 1 2 3\n")
    with pytest.raises(ValueError, match="PARAM_OUT RGB_COLOR does not say what the values are"):
        read(path)
    assert read(path, quantity="brdf").channels == ("red", "green", "blue")
    path.write_text("#DIM 1 1\n#PARAM_IN COS_TH\n#PARAM_OUT INV_STERADIAN\n0.9 1\n")
    with pytest.raises(ValueError, match=r"a\.alta: quantity is 'brdf_cos', this alta file says 'brdf'"):
        read(path, quantity="brdf_cos")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("COS_TH_TD", "STARK_3D"), "line 2: PARAM_IN is 'STARK_3D', must be one of RUSIN_TH_PH_TD_PD"),
        (("INV_STERADIAN", "WATTS"), "line 3: PARAM_OUT is 'WATTS'"),
        (("INV_STERADIAN", "RGB_COLOR"), "line 3: RGB_COLOR has 3 columns, DIM says 1"),
        (("#DIM 2 1", "#DIM 3 1"), "line 1: 3 columns of COS_TH_TD, must be 2"),
        (("#DIM 2 1", "#DIM 2"), "line 1: DIM must be followed by two numbers, found 1"),
        (("0.8 0.9 3", "0.8 0.9"), "line 5: 2 numbers, must be 3"),
        (("0.8 0.9 3", "0.8 0.9 x"), "line 5, column 3: 'x' is not a number"),
        (("0.8 0.9 3", "1.8 0.9 3"), "none of the 1 sample has directions"),
        (("0.8 0.9 3\n", ""), "no samples below the header"),
        (("#VS 0", "#VS 7"), "line 4: VS is '7'"),
        (("#VS 0", "#FORMAT binary\n#BEGIN_STREAM"), "ALTA's binary data, which have no reader here"),
    ],
)
def test_bad_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    text = "#DIM 2 1\n#PARAM_IN COS_TH_TD\n#PARAM_OUT INV_STERADIAN\n#VS 0\n0.8 0.9 3\n"
    assert change[0] in text
    path = tmp_path / "a.alta"
    path.write_text(text.replace(*change))
    with pytest.raises(ValueError, match=message) as error:
        read(path)
    assert "a.alta" in str(error.value)
