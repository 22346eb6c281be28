"""Directions on the nodes of panels: weights sum to 1, move smoothly over the edges, and leave the mean as it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import layerjax as lj
from layerjax.transport.adding_doubling.grid import interpolation_weights, make_grid

NODES = 12
GRID = make_grid((1.0, 1.5, 1.3), (0, 2, 1), NODES, jnp.float64)
IOR = GRID.regions[1].ior


def weights(squared: np.ndarray, blur: float) -> np.ndarray:
    """Of directions in the region of index 1.5, told by s^2."""
    sine2 = jnp.asarray(squared) / IOR**2
    return np.asarray(interpolation_weights(GRID, IOR, jnp.sqrt(1.0 - sine2), sine2, blur * jnp.ones_like(GRID.edges)))


@pytest.mark.parametrize("blur", [0.0, 1e-6, 0.05])
def test_weights_sum_to_one(blur: float) -> None:
    squared = np.linspace(0.0, 2.2499, 4001)
    np.testing.assert_allclose(weights(squared, blur).sum(axis=-1), 1.0, rtol=1e-10)


@pytest.mark.parametrize("region", [0, 1, 2])
def test_nodes_go_to_nodes(region: int) -> None:
    """Where nothing is blurred, in every region; what does not exist there has no weight."""
    here = GRID.regions[region]
    found = np.asarray(interpolation_weights(GRID, here.ior, here.cosine, here.sine**2, jnp.zeros_like(GRID.edges)))
    exists = np.asarray(here.exists)
    np.testing.assert_allclose(found[exists], np.eye(GRID.size)[exists], atol=1e-9)
    assert not found[exists][:, ~exists].any()


@pytest.mark.slow
def test_weights_move_smoothly_over_edges() -> None:
    """Third differences fall with the third power of the step, as those of a jump or of a root do not."""
    for edge in (1.0, 1.69):
        most = [np.abs(np.diff(weights(edge + np.linspace(-0.06, 0.06, n), 0.05), 3, axis=0)).max() for n in (401, 801)]
        assert most[1] < most[0] / 6.0


@pytest.mark.parametrize("edge", [1.0, 1.69])
def test_what_ends_like_a_root_has_its_mean(edge: float) -> None:
    """Light of even density around an edge, and a function with a root there: by quadrature that knows of the edge."""
    blur = 0.05

    def function(squared: np.ndarray) -> np.ndarray:
        return 1.0 + np.sqrt(np.maximum(edge - squared, 0.0)) + 0.3 * squared

    at_nodes = function((np.asarray(GRID.regions[1].sine) * float(IOR)) ** 2)
    x, w = np.polynomial.legendre.leggauss(400)
    found = blur * w @ (weights(edge + blur * x, blur) @ at_nodes)
    exact, _ = integrate.quad(function, edge - blur, edge + blur, points=[edge])
    assert found == pytest.approx(exact, rel=2e-4)


@pytest.mark.slow
def test_tables_are_smooth_in_an_inner_interface() -> None:
    """Over metal, which does not make light diffuse: second differences 5e-5 apart, 1e-3 where rays jump over edges."""
    incidence, outgoing = np.radians([10.0, 60.0]), np.radians(np.linspace(-70.0, 70.0, 9))
    wi, wo = (
        jnp.asarray(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=-1).reshape(-1, 3))
        for angle in np.meshgrid(incidence, outgoing, indexing="ij")
    )
    haze = lj.Medium(0.3, 1.0, lj.HenyeyGreenstein(0.3))

    @jax.jit
    def values(ior: jax.Array, alpha: jax.Array) -> jax.Array:
        stack = lj.Stack([haze, lj.Interface(ior, alpha)], lj.Conductor(1.0, 3.0, 0.3))
        return lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=NODES, modes=12))[:, 0]

    steps = np.linspace(-1e-3, 1e-3, 41)
    for ior, alpha in ((1.5 + steps, 0.2 + 0.0 * steps), (1.5 + 0.0 * steps, 0.2 + steps)):
        found = np.stack([values(*pair) for pair in zip(ior, alpha, strict=True)])
        assert np.abs(np.diff(found, 2, axis=0) / found[0]).max() < 5e-6


@pytest.mark.slow
def test_what_is_far_from_a_mirrors_lobe_is_that_of_the_walk() -> None:
    """Under a rough interface, at 48 nodes: values of 2^17 paths, to 0.5 % at most; edges as wide as at 8 nodes had
    one 22 % beside."""
    wi = lj.direction(np.radians([50.0, 70.0, 85.0]), np.radians(25.0))
    wo = lj.direction(np.radians([80.0, 5.0, 40.0]), np.radians([25.0, 85.0, 25.0]))
    mirror = lj.Conductor(0.01, 20.0, 0.0014142, "vmf")
    stack = lj.Stack([lj.Interface(1.5, 0.447214, "vmf"), lj.Medium(0.4, 0.0)], mirror)
    found = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=48, modes=64))[:, 0]
    np.testing.assert_allclose(found, [4.621e-4, 8.081e-3, 7.072e-4], rtol=1e-2)
