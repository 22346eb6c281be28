"""What tests of rough interfaces ask whatever the distribution of their normals: energies, pairs, a rule of normals."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
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


def sphere(nodes):
    """A product rule on the sphere, crowded towards the z axis and the plane across it, where narrow lobes sit."""
    s, w = np.polynomial.legendre.leggauss(nodes)
    t, w = 0.5 * (s + 1.0), 0.5 * w
    # cos = t^4-like clustering from both ends of [0, 1]
    z = t**4 / (t**4 + (1 - t) ** 4)
    dz = 4 * t**3 * (1 - t) ** 3 / (t**4 + (1 - t) ** 4) ** 2
    z, w = np.concatenate([z, -z]), np.tile(w * dz, 2)
    phi = 2 * np.pi * (np.arange(nodes) + 0.5) / nodes
    m = np.asarray(lj.direction(np.arccos(z)[:, None], phi))
    return m, np.broadcast_to(w[:, None] * 2 * np.pi / nodes, m.shape[:-1])
