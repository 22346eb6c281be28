"""Directional statistics of ten lossless interfaces, or three over white: finite values and gradients over the box."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.lobes.statistics import Options, statistics
from tests.helpers.derivatives import with_slopes

INTERFACES, COUNT = 10, 24
BASES = {
    "through": lambda p: None,
    "over a mirror": lambda p: lj.Conductor(p["n"], p["k"], p["beta"]),
    "over white": lambda p: lj.Lambertian(1.0),
}


def draw(dtype):
    """Parameters, half of them at an edge of the box or at equal indices, and the first few stacks all of one kind."""
    rng = np.random.default_rng(21)

    def mixed(low, high, shape, *others):
        values = rng.uniform(low, high, shape)
        return np.where(rng.random(shape) < 0.5, rng.choice([low, high, *others], shape), values)

    p = {
        "ior": mixed(0.25, 4.0, (COUNT, INTERFACES), 1.0),
        "alpha": mixed(1e-4, 1.0, (COUNT, INTERFACES)),
        "n": mixed(0.01, 10.0, COUNT),
        "k": mixed(0.0, 20.0, COUNT),
        "beta": mixed(1e-4, 1.0, COUNT),
    }
    steps = np.resize([1.5, 1.0], INTERFACES)  # a step up and a step down
    for row, (ior, alpha) in enumerate(
        [(1.0, 0.2), (1.5, 0.2), (steps, 1e-4), (steps, 1.0), (1 / steps, 1e-4), (1 / steps, 1.0), (4.0, 1e-4)]
    ):
        p["ior"][row], p["alpha"][row] = ior, alpha
    p["n"][:7], p["k"][:7] = 0.01, 20.0
    cosine = np.array([1.0, 0.6, 1e-3, 1e-6])
    wi = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1)
    wo = np.concatenate([wi * [-1, 1, 1], wi[::-1], wi * [-1, 1, -1]])
    return (
        {key: jnp.asarray(value, dtype) for key, value in p.items()},
        jnp.asarray(np.tile(wi, (3, 1)), dtype),
        (jnp.asarray(wo, dtype)),
    )


def total(p, wi, wo, name, count=INTERFACES):
    faces = [lj.Interface(p["ior"][i], p["alpha"][i]) for i in range(count)]
    f = lj.evaluate(lj.Stack(faces, BASES[name](p)), wi, wo, lj.Statistical())
    return jnp.sum(f), f


@pytest.mark.slow
def test_values():
    p, wi, wo = draw(jnp.float32)
    f = jax.jit(lambda p: jax.lax.map(lambda q: total(q, wi, wo, "through")[1], p))(p)
    assert f.dtype == jnp.float32
    assert jnp.all(jnp.isfinite(f))
    assert jnp.all(f >= 0)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_energies_of_smooth_interfaces(dtype):
    """Known to be smooth: Fresnel's formulas, at equal indices and at critical angles too."""
    cosine, alpha = jnp.asarray([1.0, 0.8, 0.6, 1e-3, 1e-6], dtype), jnp.asarray(1e-4, dtype)

    def energies(p):
        faces = [lj.Interface(ior, alpha) for ior in p[:2]]
        stack = lj.Stack(faces, lj.Conductor(p[2], p[3], alpha))
        lobes = statistics(stack, cosine, Options(True, "orders", angles=False, own_side=False)).reflected
        return jnp.stack([entry.lobe.energy[0][0] for entry in lobes])

    axes = np.meshgrid([0.25, 0.8, 1.0, 4.0], [0.25, 1.0, 1.5], [0.01, 1.0], [0.0, 20.0])
    p = jnp.asarray(np.stack(axes, -1).reshape(-1, 4), dtype)
    values, slopes = jax.jit(jax.vmap(with_slopes(energies, 0, "forward")))(p)
    assert values.dtype == dtype
    assert jnp.all(jnp.isfinite(values) & (values >= 0) & (values <= 1 + 1e-6))
    assert jnp.all(jnp.isfinite(slopes))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", BASES)
def test_values_and_gradients(name, dtype):
    p, wi, wo = draw(dtype)
    count = 3 if name == "over white" else INTERFACES  # gradients of the solver compile for long, see below

    @jax.jit
    def run(p):
        return jax.lax.map(lambda q: jax.grad(total, argnums=(0, 1, 2), has_aux=True)(q, wi, wo, name, count), p)

    (by_parameter, by_wi, by_wo), f = run(p)
    assert f.dtype == dtype
    for found in (f, by_wi, by_wo, *by_parameter.values()):
        assert jnp.all(jnp.isfinite(found))
    assert jnp.all(f >= 0)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_values_and_slopes_of_ten_over_white(dtype):
    """The derivative along all parameters together."""
    p, wi, wo = draw(dtype)

    @jax.jit
    def run(p):
        def one(q):
            return jax.jvp(lambda q: total(q, wi, wo, "over white")[1], (q,), (jax.tree.map(jnp.ones_like, q),))

        return jax.lax.map(one, p)

    values, slopes = run(p)
    assert values.dtype == dtype
    assert jnp.all(jnp.isfinite(values) & (values >= 0))
    assert jnp.all(jnp.isfinite(slopes))
