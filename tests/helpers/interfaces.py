"""What tests of rough interfaces ask whatever the distribution of their normals: energies, and pairs of directions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from layerjax.directions import split
from layerjax.surfaces.interface import interface_reflection, interface_transmission

INDICES = [0.25, 0.67, 1 - 1e-6, 1.0, 1 + 1e-9, 1.001, 1.5, 4.0]


@partial(jax.jit, static_argnames=("distribution", "points"))
def integrated_energies(wi, ior, alpha, distribution="ggx", points=300):
    """Reflected and transmitted energy, by a fine product rule over both hemispheres, in cos(theta) and azimuth."""
    x, w = np.polynomial.legendre.leggauss(points)
    phi = np.pi * (np.arange(2 * points) + 0.5) / points
    z = jnp.asarray(0.5 * (x + 1))[:, None] + 0 * phi
    sine = jnp.sqrt(1 - z * z)
    above = (sine * np.cos(phi), sine * np.sin(phi), z)
    total = 0.5 * w[:, None] * z * (np.pi / points)
    reflected = interface_reflection(split(wi), above, ior, alpha, distribution)
    passed = interface_transmission(split(wi), (above[0], above[1], -z), ior, alpha, distribution)
    return jnp.sum(reflected * total), jnp.sum(passed * total)


def pairs(random, count, alphas, dtype=np.float64):
    """wi and wo above, indices, and widths out of `alphas`.

    Among them grazing, mirrored, equal and normal directions, and indices next to 1.
    """

    def hemisphere():
        z = random.choice([1.0, 1e-6, 1e-3, 0.3], count) * random.random(count)
        sine, phi = np.sqrt(1 - z * z), random.choice([0.0, 1.0], count) * random.uniform(-np.pi, np.pi, count)
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), z])

    wi, wo = hemisphere(), hemisphere()
    wo[:, ::7] = wi[:, ::7] * np.array([[-1], [-1], [1]])
    wo[:, 1::7] = wi[:, 1::7]
    wi[:, 2::31] = np.array([[0], [0], [1]])
    wo[:, 2::62] = np.array([[0], [0], [1]])
    ior, alpha = random.choice(INDICES, count), random.choice(alphas, count)
    return tuple(wi.astype(dtype)), tuple(wo.astype(dtype)), ior.astype(dtype), alpha.astype(dtype)
