"""The whole documented box, edges included: finite values and gradients, reciprocity, energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from tests.helpers.box import POINTS, draw
from tests.helpers.derivatives import with_slopes

SINGLE = lj.SingleScattering()


def flakes(kind, tilted, fresnel):
    def make(p):
        axis = p["axis"] if tilted else None
        phase = lj.SGGX(kind, p["alpha"], axis)
        return [lj.Medium(p["thickness"], p["albedo"], phase, p["f0"] if fresnel else None)]

    return make


def haze(p):
    return [lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))]


def three(p):
    q = {name: jnp.roll(value, 1) if name == "axis" else value for name, value in p.items()}
    return flakes("surface", True, True)(p) + haze(q) + flakes("fiber", True, False)(q)


STRUCTURES = {
    "surface flakes": lambda p: lj.Stack(flakes("surface", False, True)(p)),
    "tilted fibers": lambda p: lj.Stack(flakes("fiber", True, True)(p)),
    "haze": lambda p: lj.Stack(haze(p)),
    "three layers": lambda p: lj.Stack(three(p)),
    "conductor": lambda p: lj.Stack([], lj.Conductor(p["ior"], p["k"], p["alpha"])),
    "haze on rough diffuse": lambda p: lj.Stack(haze(p), lj.OrenNayar(p["albedo"], p["roughness"])),
}


QUICK = {
    (np.float32, "reverse"): tuple(name for name in STRUCTURES if name != "three layers"),
    (np.float64, "reverse"): ("tilted fibers", "conductor"),
    (np.float32, "forward"): ("surface flakes", "haze on rough diffuse"),
}
"""What every run of the tests goes through; the other pairs take as long to compile and are marked slow."""

CASES = [
    pytest.param(name, *how, marks=() if name in quick else pytest.mark.slow)
    for how, quick in QUICK.items()
    for name in STRUCTURES
]


@pytest.mark.parametrize(("name", "dtype", "mode"), CASES)
def test_values_and_gradients_are_finite(name, dtype, mode):
    make = STRUCTURES[name]
    parameters, wi, wo = jax.tree.map(lambda x: x.astype(dtype), draw(11))

    def total(parameters, wi, wo):
        return jnp.sum(lj.evaluate(make(parameters), wi, wo, SINGLE))

    value, gradients = jax.jit(jax.vmap(with_slopes(total, (0, 1, 2), mode)))(parameters, wi, wo)
    assert value.dtype == dtype
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    for leaf in jax.tree.leaves(gradients):
        assert np.isfinite(leaf).all()
    both = (wi[:, 2] > 1e-3) & (wo[:, 2] > 1e-3) & (parameters["thickness"] > 1e-3) & (parameters["albedo"] > 0)
    assert (value[both] > 0).mean() > 0.95  # finite because it is computed, not because it is 0


@pytest.mark.parametrize("name", STRUCTURES)
def test_reciprocity_to_rounding(name):
    make = STRUCTURES[name]
    parameters, wi, wo = draw(12)
    apart = np.linalg.norm(wi + wo, axis=1) > 1e-6  # straight on, the value depends on how -wi is approached
    both_ways = jax.jit(
        jax.vmap(lambda p, a, b: (lj.evaluate(make(p), a, b, SINGLE), lj.evaluate(make(p), b, a, SINGLE)))
    )
    forward, backward = both_ways(parameters, wi, wo)
    # depths up to 1e4 / 1e-6 are exponentiated: their rounding is what may differ, relative to values that count
    np.testing.assert_allclose(forward[apart], backward[apart], rtol=1e-11, atol=1e-290)


@pytest.mark.slow
@pytest.mark.parametrize("name", STRUCTURES)
def test_no_draw_gains_energy(name):
    """f |cos| / pdf <= 1 - unscattered for every draw: with exact sampling, energy and delta cannot exceed 1."""
    make = STRUCTURES[name]
    parameters, wi, _ = draw(13)
    wi[:, 2] = np.where(np.abs(wi[:, 2]) < 1e-6, 1e-6, wi[:, 2])
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)

    @jax.jit
    @jax.vmap
    def weigh(parameters, wi, key):
        stack = make(parameters)
        _, density, weight = lj.sample(stack, wi, key, SINGLE)
        return density, weight, lj.unscattered(stack, wi)

    density, weight, straight = weigh(parameters, wi, jax.random.split(jax.random.key(0), POINTS))
    assert np.isfinite(density).all()
    assert np.isfinite(weight).all()
    assert (density >= 0).all()
    # the rough diffuse base is not sampled exactly: 4 bounds its weight (its energy has a test of its own)
    bound = 4.0 if "diffuse" in name else 1.0 + 1e-9
    assert (weight + straight <= bound).all()
    assert (weight > 0).mean() > 0.1


@pytest.mark.slow
def test_tangent_and_unnormalised_directions_give_no_nan():
    """Traced directions cannot be refused."""
    layers = three({k: v[0] for k, v in draw(1)[0].items()})  # each in a stack of its own, over another base
    odd = jnp.array([[1.0, 0, 0], [0, 0, 0], [2, 2, 2], [1, 0, 1e-30], [0, 0, 1e-8], [0, 0, -3], [1e-20, 0, 1e-20]])
    bases = (None, lj.Conductor(0.2, 3.0, 0.1), lj.OrenNayar(0.5, 0.5))
    for base, layer, dtype in zip(bases, layers, (jnp.float32, jnp.float64, jnp.float32), strict=True):
        wi, wo = odd[:, None].astype(dtype), odd[None].astype(dtype)
        whole = lj.Stack([layer], base)

        def values(stack, a, b):
            return lj.evaluate(stack, a, b, SINGLE), lj.pdf(stack, a, b, SINGLE)

        @jax.jit
        def all_of(stack, a, b):
            found, back = jax.vjp(values, stack, a, b)
            drawn = lj.sample(stack, a, jax.random.key(0), SINGLE)
            return found, back(jax.tree.map(jnp.ones_like, found)), drawn

        assert all(np.isfinite(array).all() for array in jax.tree.leaves(all_of(whole, wi, wo)))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "three layers")) for name in STRUCTURES]
)
def test_albedo_and_what_passes_straight_through_stay_below_one(name):
    make, some = STRUCTURES[name], slice(0, POINTS, 100)
    parameters, wi, _ = jax.tree.map(lambda x: x[some], draw(14))

    @jax.jit
    @jax.vmap
    def energies(parameters, wi):
        stack = make(parameters)
        reflected, transmitted = lj.albedo(stack, wi, SINGLE, nodes=16)
        return reflected, transmitted, lj.unscattered(stack, wi)

    reflected, transmitted, straight = energies(parameters, wi)
    assert (reflected >= 0).all()
    assert (transmitted >= 0).all()
    # against 64 nodes, 16 err by up to 3e-2 where light grazes lobes of alpha 1e-4, and by 1e-4 as a rule
    total = reflected + transmitted + straight
    assert (total <= 1.0 + 3e-2).all()
    assert np.quantile(total, 0.95) <= 1.0 + 1e-4
