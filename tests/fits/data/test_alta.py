"""ALTA's texts: all coordinates against angles measured on the directions they give, and what values are."""

import numpy as np
import pytest

from fits.data.geometry import direction
from tests.helpers.merl import half_angles

RANDOM = np.random.default_rng(1)
LIGHT, VIEW = (direction(RANDOM.uniform(1, 80, 40), RANDOM.uniform(-180, 180, 40)) for _ in range(2))


def alta(coordinates, numbers, output="INV_STERADIAN"):
    """A text of one column of values, after those of coordinates."""
    head = f"#ALTA HEADER\n#DIM {numbers.shape[1] - 1} 1\n#PARAM_IN  {coordinates}\n#PARAM_OUT {output}\n"
    return head + "\n".join("\t".join(f"{number:.12g}" for number in row) for row in numbers)


def relative(light, view):
    """What does not change if all turns about the normal: cosines and the product, (N, 4)."""
    return np.stack([light[:, 2], view[:, 2], np.sum(light * view, axis=1), np.cross(light, view)[:, 2]], axis=1)


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
    with pytest.raises(ValueError, match="quantity is 'brdf', this alta file says 'brdf_cos'"):
        reading(cosine, quantity="brdf")
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
        with pytest.raises(ValueError, match="does not say what the values are: give quantity"):
            reading(rows.format(output))
