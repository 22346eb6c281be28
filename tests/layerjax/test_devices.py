"""Large batches over several devices: the same values and gradients, and the user's own devices are left alone."""

import subprocess
import sys

import pytest

SCRIPT = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import layerjax as lj

first, second = jax.devices()
turns = np.linspace(0.1, 1.4, 12_000)
wi = np.stack([np.sin(turns), 0.0 * turns, np.cos(turns)], axis=-1)
wo = wi[::-1] * [-1.0, 1.0, 1.0]
metal = lambda alpha, k: lj.Stack([], lj.Conductor(jnp.array([0.2, 0.9, 1.5]), k, alpha))
over = lj.SingleScattering()
k = jnp.array([3.0, 2.5, 2.0])


def everything(alpha, k, wi, wo):
    found = lj.evaluate(metal(alpha, k), wi, wo, over)
    squares = lambda a, k: jnp.sum(lj.evaluate(metal(a, k), wi, wo, over) ** 2)
    slopes = jax.jit(jax.grad(squares, argnums=(0, 1)))(alpha, k)
    alphas = jnp.linspace(0.1, 0.5, 12_000)
    texels = lj.evaluate(metal(alphas, k), wi[:1], wo[:1], over)
    of_texels = jax.jit(jax.grad(lambda a: jnp.sum(lj.evaluate(metal(a, k), wi[:1], wo[:1], over) ** 2)))(alphas)
    drawn = lj.sample(metal(alpha, k), wi, jax.random.key(0), over)
    density = lj.pdf(metal(alpha, k), wi, wo, over)
    odd = lj.evaluate(metal(alphas[1:], k), wi[:1], wo[:1], over)
    return found, slopes, texels, of_texels, drawn, density, odd


split = everything(0.3, k, wi, wo)
assert all(len(part.sharding.device_set) == 2 for part in (split[0], split[2], *split[4], split[5], split[6]))
with jax.default_device(second):
    whole = everything(0.3, k, wi, wo)
assert all(len(part.sharding.device_set) == 1 for part in jax.tree.leaves(whole))
for one, other in zip(jax.tree.leaves(split), jax.tree.leaves(whole), strict=True):
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14 * np.max(np.abs(other)))

kept = lj.evaluate(metal(0.3, k), jax.device_put(wi, second), jax.device_put(wo, second), over)
assert kept.sharding.device_set == {second}
few = lj.evaluate(metal(0.3, k), wi[:10_000], wo[:10_000], over)
assert len(few.sharding.device_set) == 2
assert len(lj.evaluate(metal(0.3, k), wi[:11_999], wo[:11_999], over).sharding.device_set) == 1
assert len(lj.evaluate(metal(0.3, k), wi[:4_000], wo[:4_000], over).sharding.device_set) == 1
mesh = jax.make_mesh((2,), ("own",), axis_types=(jax.sharding.AxisType.Auto,))
rows = jax.sharding.PartitionSpec("own")
own = jax.shard_map(lambda wi, wo: lj.evaluate(metal(0.3, k), wi, wo, over), mesh=mesh, in_specs=rows, out_specs=rows)
np.testing.assert_allclose(jax.jit(own)(np.tile(wi, (2, 1)), np.tile(wo, (2, 1)))[:12_000], whole[0], rtol=1e-12)
"""


@pytest.mark.slow
def test_two_devices_give_what_one_does() -> None:
    """In a process of its own: devices are made before anything else."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
