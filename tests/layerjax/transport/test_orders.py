"""Energies order by order: what a walk counts against what the solver gives for every albedo."""

import jax
import numpy as np
import pytest

import layerjax as lj

ORDERS = 24  # and all higher ones together, of which less than a thousandth is left at the largest share
SHARES = np.array([0.25, 0.5, 0.75])
COSINES = np.array([1.0, 0.5, 0.15])
WI = lj.direction(np.arccos(COSINES), 0.4)
PHASES = {"haze": lj.HenyeyGreenstein(0.6), "flakes": lj.SGGX("surface", 0.5)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["haze", "flakes"])
def test_a_power_series_in_the_albedo(name):
    # where every event is a collision, order k of a slab of albedo eps is eps^k times that of a lossless one. Energies
    # need the first mode alone; against 48 nodes and 72 modes the solver errs by 4e-5, the walk by up to 2e-3
    phase = PHASES[name]
    seen = lj.goniophotometer(
        lj.Stack([lj.Medium(1.5, 1.0, phase)]),
        WI,
        key=jax.random.key(5),
        paths=1 << 16,
        polar=1,
        azimuth=1,
        orders=ORDERS,
    )
    powers = SHARES[:, None] ** np.arange(1, ORDERS + 1)  # (share, order)
    energy, error = np.asarray(seen.orders)[..., 0], np.asarray(seen.orders_error)[..., 0]  # (wi, side, order)
    expected = np.einsum("wsk,ek->wse", energy, powers)
    # a path ends in one order: their covariances are negative, and the sum of variances bounds the variance
    spread = np.sqrt(np.einsum("wsk,ek->wse", error**2, powers**2))
    assert (expected > 100 * spread).any()

    grey = lj.Stack([lj.Medium(1.5, SHARES, phase)])
    found = np.stack(lj.albedo(grey, WI, lj.AddingDoubling(modes=2)), axis=1)
    np.testing.assert_array_less(np.abs(found - expected), 4 * spread)

    first = np.stack(lj.albedo(grey, WI, lj.AddingDoubling(modes=2, orders="first")), axis=1)
    once = energy[:, :, :1] * SHARES
    np.testing.assert_array_less(np.abs(first - once), 4 * error[:, :, :1] * SHARES)
    rest = np.stack(lj.albedo(grey, WI, lj.AddingDoubling(modes=2, orders="multiple")), axis=1)
    np.testing.assert_allclose(first + rest, found, rtol=1e-9)
