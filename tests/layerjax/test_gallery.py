"""The gallery: metals, and the numbers of Wang et al. 2022, Table 2, as the text puts its rows right."""

import numpy as np
import pytest

import layerjax as lj
from layerjax import gallery

# kind, albedo, roughness, f0, thickness of every layer from the top
TABLE = {
    "window_shade": [("fiber", (0.9, 0.9, 0.7), 0.1, 1.0, 1.0), ("fiber", (0.9, 0.9, 0.7), 1.0, 1.0, 1.0)],
    "fabric": [("fiber", (0.7, 0.1, 0.1), 0.1, 1.0, 1.0), ("surface", (0.7, 0.1, 0.1), 0.8, 1.0, 5.0)],
    "fabric_as_in_the_text": [("fiber", (0.7, 0.1, 0.1), 0.5, 1.0, 1.0), ("surface", (0.7, 0.1, 0.1), 0.8, 1.0, 5.0)],
    "plant": [("surface", 1.0, 0.05, 0.1, 0.05), (None, 1.0, 0.7, 1.0, None), ("surface", 1.0, 0.05, 1.0, 0.002)],
    "walnut": [("surface", 1.0, 0.05, 0.1, 0.1), ("fiber", None, 0.2, 1.0, 1.0), ("surface", 1.0, 0.8, 1.0, 5.0)],
}


@pytest.mark.parametrize("name", TABLE)
def test_numbers_of_the_table(name):
    for layer, (kind, albedo, alpha, f0, thickness) in zip(gallery.stack(name).layers, TABLE[name], strict=True):
        if kind is None:
            assert isinstance(layer.phase, lj.HenyeyGreenstein)
            np.testing.assert_allclose(layer.phase.g, alpha)
        else:
            assert layer.phase.kind == kind
            np.testing.assert_allclose(layer.phase.alpha, alpha)
        np.testing.assert_allclose(1.0 if layer.f0 is None else layer.f0, f0)
        if thickness is not None:  # a map in the paper
            np.testing.assert_allclose(layer.thickness, thickness)
        if albedo is not None:
            np.testing.assert_allclose(layer.albedo, albedo)


def test_every_material_has_a_stack_and_a_source():
    for name in gallery.names():
        found = gallery.material(name)
        assert found.source
        assert found.remark
        assert isinstance(gallery.stack(name), lj.Stack)


def test_a_name_that_is_none():
    with pytest.raises(ValueError, match=r"gallery: 'fabrik' is not one of brushed_aluminium, lacquered_copper"):
        gallery.stack("fabrik")
