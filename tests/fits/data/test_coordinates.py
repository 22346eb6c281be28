"""ALTA's and SSDD's files: all coordinates against angles measured on the directions they give; what values are."""

import numpy as np
import pytest

from fits.data.geometry import direction
from tests.helpers.merl import half_angles
from tests.helpers.refusals import refuses

RANDOM = np.random.default_rng(1)
LIGHT, VIEW = (direction(RANDOM.uniform(1, 80, 40), RANDOM.uniform(-180, 180, 40)) for _ in range(2))
(TL, TV), (PL, PV) = np.arccos([LIGHT[:, 2], VIEW[:, 2]]), (np.arctan2(w[:, 1], w[:, 0]) for w in (LIGHT, VIEW))
HALF = half_angles(VIEW, LIGHT).T
COORDINATES = {
    "SPHERICAL_TL_PL_TV_PV": np.stack([TL, PL, TV, PV], axis=1),
    "CARTESIAN": np.hstack([VIEW, LIGHT]),
    "RUSIN_TH_PH_TD_PD": HALF,
    # these are known up to a turn
    "RUSIN_TH_TD_PD": HALF[:, [0, 2, 3]],
    "ISOTROPIC_TL_TV_PROJ_DPHI": np.stack([TL, TV * np.cos(PV - PL), TV * np.sin(PV - PL)], axis=1),
    "ISOTROPIC_TV_TL_DPHI": np.stack([TV, TL, PL - PV], axis=1),  # from the view to the light
}
BLOCK = """DATA_TYPE {kind}
COLOR_MODEL {colour}
PARAM_TYPE {system}_coordinate_system
PARAM0_LIST {incidences}
PARAM2_LIST 0 20 60
PARAM3_LIST 0 90 200
{more}DATA {mode}
"""
NUMBERS = "\n".join(map(str, range(18))) + "\n"  # PARAM0 runs fastest


def alta(coordinates, numbers, output="INV_STERADIAN"):
    """A text of one column of values, after those of coordinates."""
    head = f"#ALTA HEADER\n#DIM {numbers.shape[1] - 1} 1\n#PARAM_IN  {coordinates}\n#PARAM_OUT {output}\n"
    return head + "\n".join("\t".join(f"{number:.12g}" for number in row) for row in numbers)


def relative(light, view):
    """What does not change if all turns about the normal: cosines and the product, (N, 4)."""
    return np.stack([light[:, 2], view[:, 2], np.sum(light * view, axis=1), np.cross(light, view)[:, 2]], axis=1)


@pytest.mark.parametrize("coordinates", COORDINATES)
def test_coordinates(reading, coordinates):
    values = np.arange(40.0)[:, None]
    data = reading(alta(coordinates, np.hstack([COORDINATES[coordinates], values])))
    np.testing.assert_array_equal(data.values, values)
    np.testing.assert_allclose(relative(data.wi, data.wo), relative(LIGHT, VIEW), atol=1e-9)
    if coordinates in list(COORDINATES)[:3]:
        np.testing.assert_allclose([data.wi, data.wo], [LIGHT, VIEW], atol=1e-9)


@pytest.mark.parametrize("coordinates", ["RUSIN_TH_TD", "COS_TH"])
def test_half_angles_alone(reading, coordinates):
    angles = RANDOM.uniform(0.05, 0.6, (20, 1 if coordinates == "COS_TH" else 2))
    numbers = np.cos(angles) if coordinates.startswith("COS") else angles
    data = reading(alta(coordinates, np.hstack([numbers, np.ones((20, 1))])))
    theta_h, _, theta_d, _ = half_angles(data.wi, data.wo)
    np.testing.assert_allclose(theta_h, angles[:, 0], atol=1e-9)
    np.testing.assert_allclose(theta_d, angles[:, 1] if angles.shape[1] == 2 else 0.0, atol=1e-7)


def test_what_values_are(reading):
    """A cosine, colours, and vertical segments that are not read; what is not said is asked for, what is said holds."""
    cosine = alta("SPHERICAL_TL_PL_TV_PV", np.array([[0.5, 0.0, 0.6, 3.0, 0.2]]), "INV_STERADIAN_COSINE_FACTOR")
    data = reading(cosine)
    assert data.source.quantity == "brdf_cos"
    np.testing.assert_allclose(data.values, 0.2 / np.cos(0.6))
    refuses("quantity is 'brdf', this alta file says 'brdf_cos'", reading, cosine, quantity="brdf")
    colours = "#DIM 1 3\n#VS 1 1 2\n#PARAM_IN COS_TH\n#PARAM_OUT {}_COLOR\n0.9 1 2 3 .1 .1 .1 .1\n"
    for name, channels in (("XYZ", ("X", "Y", "Z")), ("RGB", ("red", "green", "blue"))):
        data = reading(colours.format(name), quantity="brdf")
        assert (data.channels, data.values.tolist()) == (channels, [[1, 2, 3]])
        assert "vertical segments" in " ".join(data.source.notes)
    rows = "#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n{}\n0.2618 -0.2618 0.0 0.4\n0.2618 0.5236 0.0 0.1\n"
    factors = {"brdf": np.ones(2), "brdf_cos": 1.0 / np.cos([0.2618, 0.5236]), "reflectance_factor": np.ones(2) / np.pi}
    for quantity, factor in factors.items():
        np.testing.assert_allclose(reading(rows.format(""), quantity=quantity).values[:, 0], [0.4, 0.1] * factor)
    for output in ("", "#PARAM_OUT", "#PARAM_OUT UNKNOWN", "#PARAM_OUT ENERGY"):
        refuses("does not say what the values are: give quantity", reading, rows.format(output))


def block(kind="brdf", system="spherical", more="", colour="monochrome", mode="ascii", incidences="10 40"):
    said = {"kind": kind, "system": system, "more": more, "colour": colour, "mode": mode}
    return BLOCK.format(**said, incidences=incidences)


def test_spherical(reading):
    data = reading(f"VERSION 0.2\n\n{block()}# a comment\n{NUMBERS}")
    number = {float(value): row for row, value in enumerate(data.values[:, 0])}
    np.testing.assert_allclose(data.wi[number[1]], direction(40, 0), atol=1e-15)
    outgoing = [data.wo[number[value]] for value in (2, 8, 17)]
    np.testing.assert_allclose(outgoing, direction([20, 20, 60], [0, 90, 200]), atol=1e-15)


@pytest.mark.parametrize(
    ("system", "count"),
    [
        ("spherical", 9),  # of each of three directions of the light: the pole, and two azimuths
        ("specular", 10),  # light along the normal: its azimuth and the viewer's add up to 0, 90, 180
    ],
)
def test_directions_that_a_file_repeats_are_read_once(reading, system, count):
    lists = "PARAM0_LIST 0 30\nPARAM1_LIST 0 90 360\nPARAM2_LIST 0 20\nPARAM3_LIST 0 90 360\n"
    head = f"VERSION 0.3\nDATA_TYPE brdf\nCOLOR_MODEL monochrome\nPARAM_TYPE {system}_coordinate_system\n"
    data = reading(f"{head}{lists}DATA ascii\n" + "\n".join(map(str, range(36))))
    pairs = np.round(np.hstack([data.wi, data.wo]), 9) + 0.0
    assert len(np.unique(pairs, axis=0)) == len(data) == count
    assert data.values.max() < 24  # the first of them: none of the azimuth 360
    assert f"skipped: {36 - count} values at directions that the file holds already" in data.source.notes


@pytest.mark.parametrize("kind", ["brdf", "btdf"])
def test_around_the_mirror_direction(reading, kind):
    """Angles from the specular direction, and of a BTDF from where it bends by an offset."""
    bent = kind == "btdf"
    offsets = "PARAM4_LIST 0 -12.5\n" if bent else ""
    data = reading(f"VERSION 0.3\n{block(kind, 'specular', offsets)}{NUMBERS}")
    side, bend = np.array([1, 1, -1 if bent else 1]), 12.5 * bent
    for light, theta in ((10, 10), (40, 40 - bend)):
        here = abs(data.theta_i - light) < 1e-9
        away = np.degrees(np.arccos(np.clip(data.wo[here] @ (direction(theta, 180) * side), -1, 1)))
        place = data.values[here, 0].astype(int) // 2  # which of param 2 and 3
        np.testing.assert_allclose(away, np.tile([0.0, 20.0, 60.0], 3)[place], atol=1e-6)
    # azimuth 0 leads towards the normal, azimuth 90 to +y
    first = data.wo[data.values[:, 0] == 3][0]  # light at 40, 20 degrees away, azimuth 0
    np.testing.assert_allclose(first, direction(20 - bend, 180) * side, atol=1e-12)
    assert data.wo[data.values[:, 0] == 9][0, 1] == pytest.approx(np.sin(np.radians(20)))


def test_half_vectors(reading):
    data = reading(f"VERSION 0.3\n{block(system='half_difference')}{NUMBERS}")
    value = data.values[:, 0].astype(int)
    expected = np.take((10, 40), value % 2), np.take((0, 20, 60), value // 2 % 3), np.take((0, 90, 200), value // 6)
    theta_h, phi_h, theta_d, phi_d = np.degrees(half_angles(data.wi, data.wo))
    np.testing.assert_allclose(direction(theta_h, phi_h), direction(expected[0], 0), atol=1e-12)
    np.testing.assert_allclose(direction(theta_d, phi_d), direction(*expected[1:]), atol=1e-9)
    assert "skipped" in " ".join(data.source.notes)  # some lie below the horizon


def test_blocks_colours_and_binary(reading):
    numbers = np.random.default_rng(0).random((2, 18, 3)).astype("<f4")
    spectrum = {"colour": "spectrum", "more": "WAVELENGTH_LIST 400 500 600\n", "mode": "binary"}
    heads = [block(kind, **spectrum).encode() for kind in ("brdf", "btdf")]
    blocks = [head + part.tobytes() + b"\n" for head, part in zip(heads, numbers, strict=True)]
    mirror = b"DATA_TYPE specular_reflectance\nCOLOR_MODEL monochrome\nPARAM0_LIST 0 90\nDATA ascii\n0.05\n1\n"
    data = reading(b"VERSION 0.3\n\nAPI libbsdf\n" + blocks[0] + mirror + blocks[1])
    assert data.channels == ("400 nm", "500 nm", "600 nm")
    once = np.r_[0:6, 8:12, 14:18]  # at PARAM2 = 0 all azimuths are one direction
    np.testing.assert_array_equal(data.values, numbers[:, once].reshape(-1, 3).astype(float))
    np.testing.assert_array_equal(np.sign(data.wo[:, 2]), np.repeat([1, -1], 14))
    assert "skipped: specular_reflectance" in data.source.notes
    head = b"VERSION 0.3\n" + heads[0]
    refuses(r"line 9: 3 bytes of data, must be 216 \(truncated\?\)", reading, head + b"abc")
    refuses("line 9: the data hold nan, must be finite", reading, head + (numbers[0] * np.nan).tobytes())
