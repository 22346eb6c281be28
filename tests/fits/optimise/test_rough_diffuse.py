"""Readings of sand, from the solution of light between its flakes: which rough diffuse surface explains them."""

from dataclasses import replace

import numpy as np
import pytest

import fits
import layerjax as lj
from layerjax.precompute.vmf_diffuse.half_space import all_orders, half_space

ALBEDO, ROUGHNESS, NOISE = (0.518, 0.331, 0.184), 0.5, 0.03
INCIDENCE, VIEWS, MODES = (10, 35, 60, 75), np.arange(-80, 81, 10), 5
COLOURS, WIDTH = fits.Free([0.4, 0.4, 0.4], 0.0, 1.0), fits.Free(0.4, 0.0, 1.0)


@pytest.fixture(scope="module")
def sand():
    """Values of the half-space itself, not of the table that is fitted, with 3 % noise."""
    geometry = fits.slices(incidence=INCIDENCE, outgoing=VIEWS, azimuth=(0, 90))
    cosines, places = np.unique(np.round([geometry.wi[:, 2], geometry.wo[:, 2]], 12), return_inverse=True)
    places = places.reshape(2, -1)
    space = half_space(-np.log1p(-np.sqrt(ROUGHNESS)), 24, MODES, tuple(cosines))
    i, o = places + 24
    turn = np.arctan2(geometry.wo[:, 1], geometry.wo[:, 0]) - np.arctan2(geometry.wi[:, 1], geometry.wi[:, 0])
    exact = np.stack(
        [sum((2 if m else 1) * all_orders(space, c, m)[i, o] * np.cos(m * turn) for m in range(MODES)) for c in ALBEDO],
        axis=-1,
    )
    data = fits.simulate(lj.Stack([], lj.Lambertian(ALBEDO)), geometry)
    noisy = exact * (1 + NOISE * np.random.default_rng(3).standard_normal(exact.shape))
    return replace(data, values=noisy, sigma=NOISE * exact)


@pytest.fixture(scope="module")
def found(sand):
    surfaces = {
        "transport": lj.VMFDiffuse(COLOURS, WIDTH, form="transport"),
        "Oren-Nayar": lj.OrenNayar(COLOURS, WIDTH),
        "Lambertian": lj.Lambertian(COLOURS),
    }
    noise = fits.Noise(discrepancy=False)  # else errors that readings share would take the place of the wrong shapes
    return {
        name: fits.fit(lj.Stack([], surface), sand, noise=noise, starts=4, seed=1) for name, surface in surfaces.items()
    }


def test_sand_is_recovered(found):
    fit = found["transport"]
    for name, truth in {f"base.albedo[{c}]": level for c, level in enumerate(ALBEDO)}.items():
        assert abs(fit.values[name] - truth) < 4 * fit.standard_errors[name]
    assert abs(fit.values["base.roughness"] - ROUGHNESS) < 4 * fit.standard_errors["base.roughness"]
    assert max(fit.standard_errors.values()) < 0.02  # the readings do determine them
    # 4 standard deviations of chi-square over its degrees of freedom
    assert abs(fit.reduced_chi_square - 1.0) < 4 * np.sqrt(2 / fit.degrees_of_freedom)


def test_the_data_prefer_it(found):
    comparison = fits.compare(found)
    assert comparison.rows[0].name == "transport"
    assert [row.name for row in comparison.rows[1:]] == ["Oren-Nayar", "Lambertian"]
    flakes, grooves, flat = (row.aic for row in comparison.rows)
    assert grooves - flakes > 100
    assert flat - grooves > 100
    assert all("prefer transport" in sentence for sentence in comparison.verdict)
