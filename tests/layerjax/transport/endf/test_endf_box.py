"""ENDF over the whole box of concentrations, indices and directions: finite values and gradients, and right ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.derivatives import with_slopes
from tests.helpers.endf import OUTSIDE, PAPER, RECIPROCAL

POINTS = 10_000
CLEAR = lj.Medium(1.0, 0.0)  # made outside jit, where the albedo stays a known 0


def glaze(thickness):
    return eqx.tree_at(lambda medium: medium.thickness, CLEAR, thickness)


BOX = {
    "coat": lambda p: lj.Stack(
        [lj.Interface(p["ior"], p["alpha"]), glaze(p["thickness"])], lj.Conductor(p["n"], p["k"], p["rough"])
    ),
    "slab": lambda p: lj.Stack(
        [
            lj.Interface(p["ior"], p["alpha"]),
            glaze(p["thickness"]),
            eqx.tree_at(lambda face: face.alpha, OUTSIDE, p["rough"]),
        ]
    ),
    "interface": lambda p: lj.Stack([lj.Interface(p["ior"], p["alpha"])]),
}


def draw(seed):
    """Parameters and directions over the box: kappa from 1e-2 to 1e8."""
    random = np.random.default_rng(seed)

    def mixed(low, high, *exact, log=False):
        values = np.exp(random.uniform(np.log(max(low, 1e-8)), np.log(high), POINTS))
        values = values if log else random.uniform(low, high, POINTS)
        return np.where(random.random(POINTS) < 0.25, random.choice([low, high, *exact], POINTS), values)

    ranges = {name: mixed(np.sqrt(2e-8), np.sqrt(200), 1.0, log=True) for name in ("alpha", "rough")}
    ranges |= {"ior": mixed(0.25, 4.0, 1.0, 1.5, 1 - 1e-6, 1 + 1e-6, log=True)}
    ranges |= {"thickness": mixed(0.0, 1e4, 1e-6, 1.0, log=True)}
    ranges |= {"n": mixed(0.01, 10.0, 1.0, log=True), "k": mixed(0.0, 20.0, 1e-8)}

    def towards():
        cosine, phi = mixed(-1.0, 1.0, 1e-6, -1e-6, 0.0, 1e-3, -1e-3), random.uniform(-np.pi, np.pi, POINTS)
        sine = np.sqrt(1.0 - cosine**2)
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)

    wi, wo = towards(), towards()
    wi[::2, 2], wo[::4, 2] = np.abs(wi[::2, 2]), np.abs(wo[::4, 2])
    for kind, signs in enumerate(([1, 1, 1], [-1, -1, 1], [1, 1, -1], [-1, -1, -1])):
        wo[kind::10] = wi[kind::10] * signs  # retro, mirror, straight down, straight on
    wo[4::40], wi[14::40] = [0, 0, 1], [0, 0, 1]
    return ranges, wi, wo


def values_and_gradients_are_finite(name, transport, dtype, mode):
    make = BOX[name]
    parameters, wi, wo = jax.tree.map(lambda x: x.astype(dtype), draw(11))

    def total(parameters, wi, wo):
        return jnp.sum(lj.evaluate(make(parameters), wi, wo, transport))

    value, gradients = jax.jit(jax.vmap(with_slopes(total, (0, 1, 2), mode)))(parameters, wi, wo)
    assert value.dtype == dtype
    assert (value >= 0).all()
    for leaf in jax.tree.leaves((value, gradients)):
        assert np.isfinite(leaf).all()
    both = (wi[:, 2] > 1e-3) & (wo[:, 2] > 1e-3) & (parameters["alpha"] > 0.1) & (np.abs(parameters["ior"] - 1) > 1e-3)
    assert (value[both] > 0).mean() > 0.95  # finite because it is computed, not because it is 0


@pytest.mark.slow
def test_values_and_gradients_are_finite():
    values_and_gradients_are_finite("coat", RECIPROCAL, np.float32, "reverse")


@pytest.mark.slow
@pytest.mark.parametrize("name", BOX)
@pytest.mark.parametrize("transport", [RECIPROCAL, lj.ENDF(2), PAPER, lj.ENDF(2, "paper", "paper")])
@pytest.mark.parametrize(("dtype", "mode"), [(np.float32, "reverse"), (np.float64, "reverse"), (np.float32, "forward")])
def test_values_and_gradients_are_finite_everywhere(name, transport, dtype, mode):
    values_and_gradients_are_finite(name, transport, dtype, mode)


@pytest.mark.slow
@pytest.mark.parametrize("transport", [lj.ENDF(2), lj.ENDF(2, "paper", "paper")])
def test_gradients_agree_with_central_differences(transport):
    def value(p):
        coat = lj.Stack([lj.Interface(p[0], p[1]), glaze(p[2])], lj.Conductor(p[3], p[4], p[5]))
        slab = BOX["slab"]({"ior": p[0], "alpha": p[1], "thickness": p[2], "rough": p[5]})
        up, down = lj.direction(p[7], 2.9), lj.direction(jnp.pi - p[7], 2.9)
        return sum(lj.evaluate(s, lj.direction(p[6], 0.2), wo, transport)[0] for s, wo in ((coat, up), (slab, down)))

    p = jnp.array([1.5, 0.3, 0.4, 0.9, 2.5, 0.35, 0.6, 0.9])
    step = 1e-5
    at = jax.jit(jax.vmap(value))
    numeric = (at(p + step * jnp.eye(p.size)) - at(p - step * jnp.eye(p.size))) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(value))(p), numeric, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(p), numeric, rtol=1e-6, atol=1e-8)
