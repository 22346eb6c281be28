"""Stacks recovered from simulated measurements: rough diffuse surfaces, and what cannot be told apart.

Of all orders of scattering: `test_resolution`."""

from dataclasses import replace

import numpy as np

import fits
import layerjax as lj
from fits.problem.parameters import Free
from fits.problem.simulate import simulate, slices
from layerjax.precompute.vmf_diffuse.half_space import all_orders, half_space


def assert_recovered(fit, truth, errors=3.0):
    """Within so many standard errors, with a fixed seed: for good; chi-square has standard deviation sqrt(2 n)."""
    assert fit.converged
    assert fit.at_bound == ()
    for name, value in truth.items():
        assert abs(fit.values[name] - value) < errors * fit.standard_errors[name], name
    assert abs(fit.chi_square - fit.degrees_of_freedom) < errors * np.sqrt(2.0 * fit.degrees_of_freedom)


# ---- sand, from the solution of light between its flakes: which rough diffuse surface explains it ----

ALBEDO, ROUGHNESS, MODES = (0.518, 0.331, 0.184), 0.5, 5
COLOURS, WIDTH = Free([0.4, 0.4, 0.4], 0.0, 1.0), Free(0.4, 0.0, 1.0)


def test_sand_is_recovered_and_the_data_prefer_its_surface():
    """Of values of the half-space itself, not of the table that is fitted, with 3 % noise."""
    geometry = slices(incidence=(10, 35, 60, 75), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    cosines, places = np.unique(np.round([geometry.wi[:, 2], geometry.wo[:, 2]], 12), return_inverse=True)
    space = half_space(-np.log1p(-np.sqrt(ROUGHNESS)), 24, MODES, tuple(cosines))
    i, o = places.reshape(2, -1) + 24
    turn = np.arctan2(geometry.wo[:, 1], geometry.wo[:, 0]) - np.arctan2(geometry.wi[:, 1], geometry.wi[:, 0])
    exact = np.stack(
        [sum((2 if m else 1) * all_orders(space, c, m)[i, o] * np.cos(m * turn) for m in range(MODES)) for c in ALBEDO],
        axis=-1,
    )
    data = simulate(lj.Stack([], lj.Lambertian(ALBEDO)), geometry)
    noisy = exact * (1 + 0.03 * np.random.default_rng(3).standard_normal(exact.shape))
    sand = replace(data, values=noisy, sigma=0.03 * exact)
    surfaces = {
        "transport": lj.VMFDiffuse(COLOURS, WIDTH, form="all_orders"),
        "Oren-Nayar": lj.OrenNayar(COLOURS, WIDTH),
        "Lambertian": lj.Lambertian(COLOURS),
    }
    noise = fits.Noise(discrepancy=False)  # else it would take the place of the wrong shapes
    found = {
        name: fits.fit(lj.Stack([], surface), sand, noise=noise, starts=4, seed=1) for name, surface in surfaces.items()
    }
    fit = found["transport"]
    truth = {f"base.albedo[{c}]": level for c, level in enumerate(ALBEDO)} | {"base.roughness": ROUGHNESS}
    assert_recovered(fit, truth, errors=4.0)
    assert max(fit.standard_errors.values()) < 0.02  # the measurements do determine them
    comparison = fits.compare(found)
    assert [row.name for row in comparison.rows] == ["transport", "Oren-Nayar", "Lambertian"]
    assert np.all(np.diff([row.aic for row in comparison.rows]) > 100)
    assert all("prefer transport" in sentence for sentence in comparison.verdict)
