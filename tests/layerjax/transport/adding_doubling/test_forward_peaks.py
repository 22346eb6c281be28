"""Media with forward peaks: their moments, what is sent straight on, and values that a Monte Carlo walk gives.

The walk shares no code with the library: collisions drawn in numpy, each of them seen in all directions asked for
(next-event estimation), 2e7 paths a row (3e6 of g 0.8 to 0.95); values and standard errors of these are the tables
below.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.phase.moments import moments_by_quadrature
from layerjax.transport.adding_doubling.grid import make_grid
from layerjax.transport.adding_doubling.media import kernel_modes
from layerjax.transport.adding_doubling.moments import MomentCounts

WI = lj.direction(np.deg2rad(20.0), 0.0)
THROUGH = lj.direction(np.pi - np.deg2rad([3.0, 60.0, 75.0]), np.pi)
BACK = lj.direction(np.deg2rad([3.0, 25.0, 60.0]), 0.0)

WALKED = {
    0.8: (THROUGH, [0.46338, 0.19355, 0.13370], [0.00028, 0.00028, 0.00033]),
    0.9: (THROUGH, [0.54455, 0.15080, 0.10077], [0.00061, 0.00047, 0.00055]),
    0.95: (THROUGH, [0.43787, 0.08832, 0.05926], [0.00104, 0.00070, 0.00082]),
    0.97: (THROUGH, [0.31019, 0.05412, 0.03702], [0.00058, 0.00035, 0.00040]),
    0.99: (THROUGH, [0.11406, 0.01814, 0.01224], [0.00099, 0.00066, 0.00062]),
    -0.97: (BACK, [0.18133, 4.19237, 0.03145], [0.00028, 0.00131, 0.00018]),
}
"""By g: thickness 2, albedo 0.95, light at 20 degrees."""


def slab(g, thickness=2.0, albedo=0.95):
    return lj.Stack([lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g))])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("g", "resolution", "rtol"),
    [
        (0.97, (48, 64), 8e-3),
        *((g, (None, None), 1e-3) for g in (0.8, 0.9)),  # what is chosen
        (0.95, (48, 64), 4e-3),
        *((g, (96, 128), 1e-3) for g in (0.97, -0.97)),
        (0.99, (96, 128), 4e-3),
    ],
)
def test_values_of_a_walk(g, resolution, rtol):
    wo, expected, error = WALKED[g]
    nodes, modes = resolution
    prepared = lj.prepare(slab(g), lj.AddingDoubling(nodes=nodes, modes=modes))
    found = np.asarray(lj.evaluate(prepared, WI, wo))[:, 0]
    assert np.all(np.abs(found - expected) < rtol * np.array(expected) + 3.0 * np.array(error))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("g", "expected", "error"),
    [(0.9, [0.115908, 0.035790, 0.031283], 1.7e-4), (-0.7, [0.315262, 0.248141, 0.258980], 4.6e-4)],
)
def test_peaks_within_a_coat_seen_straight_back(g, expected, error):
    """The default's own resolution, where the series of few moments is farthest off; values of `RandomWalk`."""
    coat = [lj.Interface(1.5, 0.15), lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(g))]
    wi = lj.direction(np.deg2rad([5.0, 30.0, 55.0]), 0.0)
    found = lj.evaluate(lj.Stack(coat, lj.Lambertian(0.3)), wi, wi)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=3.0 * error)


@pytest.mark.parametrize("g", [-0.97, -0.3, 0.0, 0.6, 0.97, 0.999])
def test_moments_by_quadrature_are_powers_of_g(g):
    found = moments_by_quadrature(lj.HenyeyGreenstein(g).pdf, 64, jnp.float64)
    np.testing.assert_allclose(found, g ** np.arange(64.0), rtol=0, atol=1e-11)


@pytest.mark.parametrize(("dtype", "rounding"), [(jnp.float32, 3e-6), (jnp.float64, 1e-12)])
def test_the_kernel_is_the_phase_function_at_the_nodes(dtype, rounding):
    """By the trapezoidal rule in azimuth, which converges like g^points; many orders in single precision too.

    With Schlick's factor there is a cusp straight on, of which 240 moments lack what such a rule lacks as well.
    """
    region = make_grid([1.0], (0,), 4, dtype).regions[0]
    kernel = jax.jit(lambda g: kernel_modes(lj.HenyeyGreenstein(g), True, region, 200, MomentCounts(240, 240)))(
        dtype(0.6)
    )
    phi = 2.0 * np.pi * np.arange(600) / 600
    mu, sine = (np.asarray(part, float) for part in (region.cosine, region.sine))
    for side, plain, fifth in zip((-1.0, 1.0), kernel.plain, kernel.schlick, strict=True):
        cosine = side * mu[:, None, None] * mu[:, None] + sine[:, None, None] * sine[:, None] * np.cos(phi)
        p = (1.0 - 0.6**2) / (4.0 * np.pi * (1.0 + 0.6**2 - 1.2 * cosine) ** 1.5)
        schlick = (1.0 - np.sqrt(np.maximum(0.5 - 0.5 * cosine, 0.0))) ** 5
        for values, found, atol in ((p, plain, rounding), (p * schlick, fifth, 1e-4)):
            modes = np.fft.rfft(values)[..., :200].real / 600
            np.testing.assert_allclose(found, np.moveaxis(modes, -1, 0), rtol=0, atol=atol)


@pytest.mark.parametrize("g", [0.97, -0.97])
def test_no_light_is_lost(g):
    """What goes straight on by a collision counts among the light that is scattered through."""
    wi = lj.direction(np.deg2rad(np.array([10.0, 60.0, 85.0])), 0.0)
    stack = slab(g, albedo=1.0)
    parts = jax.tree.leaves(lj.albedo(stack, wi, lj.AddingDoubling(nodes=6, modes=4)))
    np.testing.assert_allclose(sum(parts) + lj.unscattered(stack, wi), 1.0, rtol=0, atol=1e-9)


def test_orders_are_those_of_the_medium_itself():
    """Not of the one that the grid has: first is single scattering, and multiple what is left of all."""
    values = {
        orders: lj.evaluate(slab(0.9), WI, THROUGH, lj.AddingDoubling(nodes=6, modes=4, orders=orders))
        for orders in ("all", "first", "multiple")
    }
    np.testing.assert_allclose(values["first"], lj.evaluate(slab(0.9), WI, THROUGH, lj.SingleScattering()), rtol=1e-12)
    np.testing.assert_allclose(values["multiple"], values["all"] - values["first"], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    """By g, thickness and albedo, at narrow peaks either way and at g = 0, where forward meets backward."""

    @jax.jit
    def value(numbers):
        return lj.evaluate(slab(*numbers), WI, THROUGH, lj.AddingDoubling(nodes=6, modes=4))[:, 0]

    slope = jax.jit(jax.jacfwd(value))
    for g in (-0.97, 0.0, 1e-3, 0.5, 0.97, 0.99):
        numbers = jnp.array([g, 2.0, 0.9])
        found = slope(numbers)
        for column, step in enumerate(1e-6 * np.eye(3)):
            difference = (value(numbers + step) - value(numbers - step)) / 2e-6
            np.testing.assert_allclose(found[:, column], difference, rtol=2e-6, atol=1e-8)
