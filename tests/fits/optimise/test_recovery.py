"""Stacks recovered from simulated measurements: rough diffuse surfaces, and what cannot be told apart.

Of all orders of scattering: `test_resolution`."""

from dataclasses import replace

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.reports import verdicts
from layerjax.precompute.vmf_diffuse.half_space import all_orders, half_space


def assert_recovered(fit, truth, errors=3.0):
    """Within so many standard errors, with a fixed seed: for good; chi-square has standard deviation sqrt(2 n)."""
    assert fit.converged
    assert fit.at_bound == ()
    for name, value in truth.items():
        assert abs(fit.values[name] - value) < errors * fit.standard_errors[name], name
    assert abs(fit.chi_square - fit.degrees_of_freedom) < errors * np.sqrt(2.0 * fit.degrees_of_freedom)


ALBEDO, ROUGHNESS, MODES = (0.518, 0.331, 0.184), 0.5, 5
COLOURS, WIDTH = fits.Free([0.4, 0.4, 0.4], 0.0, 1.0), fits.Free(0.4, 0.0, 1.0)


def sand():
    """Of values of the half-space itself, not of the table that is fitted, with 3 % noise."""
    geometry = fits.slices(incidence=(10, 35, 60, 75), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    cosines, places = np.unique(np.round([geometry.wi[:, 2], geometry.wo[:, 2]], 12), return_inverse=True)
    space = half_space(-np.log1p(-np.sqrt(ROUGHNESS)), 24, MODES, tuple(cosines))
    i, o = places.reshape(2, -1) + 24
    turn = np.arctan2(geometry.wo[:, 1], geometry.wo[:, 0]) - np.arctan2(geometry.wi[:, 1], geometry.wi[:, 0])
    exact = np.stack(
        [sum((2 if m else 1) * all_orders(space, c, m)[i, o] * np.cos(m * turn) for m in range(MODES)) for c in ALBEDO],
        axis=-1,
    )
    data = fits.simulate(lj.Stack([], lj.Lambertian(ALBEDO)), geometry)
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


METAL = {
    "layers[0].ior": 1.5,
    "layers[0].alpha": 0.1,
    "layers[1].thickness": 0.3,
    "base.ior": 0.95,  # copper at 550 nm
    "base.k": 2.6,
    "base.alpha": 0.3,
}


def coat(ior, alpha, thickness, base_ior, base_k, base_alpha):
    return lj.Stack(
        [lj.Interface(ior=ior, alpha=alpha), lj.Medium(thickness=thickness, albedo=0.0)],
        base=lj.Conductor(ior=base_ior, k=base_k, alpha=base_alpha),
    )


def coated_copper():
    """All six numbers free; of the metal a handbook's median with a factor of 1.6 either way is known beforehand."""
    transport = lj.Statistical(facet_multiple_scattering=False)
    geometry = fits.slices(incidence=(10, 35, 60), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    data = fits.simulate(coat(*METAL.values()), geometry, transport=transport, noise=0.03, seed=1)
    free = coat(
        fits.Free(1.4, 1.2, 2.2),
        fits.Free(0.2, 0.02, 0.6),
        fits.Free(0.5, 0.01, 3.0),
        fits.Free(1.0, 0.05, 6.0, fits.LogNormal(1.0, 0.5)),
        fits.Free(3.0, 0.5, 10.0, fits.LogNormal(3.0, 0.5)),
        fits.Free(0.2, 0.02, 0.8),
    )
    fit = fits.fit(free, data, transport=transport, starts=2, seed=0)
    assert_recovered(fit, METAL)
    for name, within in (("layers[0].ior", 0.01), ("layers[0].alpha", 0.02), ("base.alpha", 0.02)):
        assert fit.standard_errors[name] < within * METAL[name], name

    (direction,) = fit.unidentified
    assert set(direction.weights) == {"base.ior", "base.k", "layers[1].thickness"}
    assert direction.unconstrained
    for name, conditional in direction.conditional_errors.items():
        assert conditional < 0.05 * fit.standard_errors[name], name
    sentence = verdicts.verdict(fit).sentences[2]
    assert "are not identified separately" in sentence
    assert all(name in sentence for name in direction.weights)


@pytest.mark.slow  # the derivatives of the copper compile for more than a minute
def test_sand_and_coated_copper_are_recovered():
    sand()
    coated_copper()
