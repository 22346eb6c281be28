"""Multiply scattered light on a rough dielectric interface: the walk of Heitz et al. 2016, past its first collision.

Under the Smith assumption a rough surface is a medium of facets in the coordinate height = -log C1(h) >= 0, C1 the
distribution of heights: a ray along w meets a facet at the rate A(w) / |w_z|, A(w) the projected area of those facing
it. Passing through a facet turns the surface over, C1 -> 1 - C1, and so are directions: z always points away from the
surface on the side that the ray is on.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax.directions import Vector, dot, reflect, refract, scale, select
from layerjax.normals.sggx import ggx_sample

EVENTS = 100
"""Collisions followed at most: near index 1 light goes through facet after facet."""

LEAST_LEFT = 1e-4
"""Part of the light left after the first collision at which a walk ends; what is left then is shared like the rest."""

STRATIFIED = 12
"""Random numbers of a path, from its first on, that are points of a lattice."""


@partial(jax.jit, static_argnums=3)
def shares(points: Array, keys: Array, taus: Array, paths: int) -> Array:
    """Where light ends up that a rough dielectric interface keeps at the first collision, with absorption on the way.

    Args:
        points: (points, 3) cosine of incidence, alpha, index on the far side over that on the near side.
        keys: (points,) random keys.
        taus: (absorptions,) transmittances along the normal of what the light leaves into; > 0, the last 1.
        paths: number of paths for each point.

    Returns:
        (points, 2, absorptions): shares that leave to the near and to the far side, times tau^(1/c) for leaving at a
        cosine c. Without absorption they add up to 1.
    """
    depths = -jnp.log(jnp.asarray(taus, jnp.float32))[:, None]
    return jax.lax.map(lambda x: _walk(x[0][0], x[0][1], x[0][2], x[1], depths, paths), (points, keys))


def _walk(cosine: Array, alpha: Array, ior: Array, key: Array, depths: Array, paths: int) -> Array:
    """Shares (way out, absorption) of one point.

    At every facet both reflection and refraction are followed out of the surface; the path goes on by one of them with
    what does not leave.
    """
    shift, rest = jax.random.split(key)
    lattice = jnp.asarray(_lattice(paths), jnp.float32) + jax.random.uniform(shift, (STRATIFIED, 1), jnp.float32)
    lattice = (lattice - jnp.floor(lattice)).reshape(-1, 4, paths)
    one = jnp.ones(paths, jnp.float32)
    sine = jnp.sqrt(1.0 - cosine * cosine)

    def event(state: tuple) -> tuple:
        number, travel, height, weight, far, energies, most = state
        first = number == 0
        random = jax.random.uniform(jax.random.fold_in(rest, number), (4, paths), jnp.float32)
        even = lattice[jnp.minimum(number, len(lattice) - 1)]
        u1, u2, u3, u4 = jnp.clip(jnp.where(number < len(lattice), even, random), 1e-7, 1.0 - 1e-7)
        staying = -jnp.expm1(-_free(travel, height, alpha))
        height = height + travel[2] * jnp.log1p(-u4 * staying) / _facing(travel, alpha)
        height = jnp.where(height > 1e-30, height, 1e-30)
        wi = scale(-1.0, travel)
        m = ggx_sample(wi, alpha, u1, u2)
        at_facet, n = jnp.clip(dot(wi, m), 0.0, 1.0), jnp.where(far, 1.0 / ior, ior)
        refracted, exists = refract(wi, m, n)
        reflectance = jnp.where(exists, fresnel.dielectric(at_facet, n), 1.0)
        ways: list[tuple[Vector, Array, Array]] = [
            (reflect(wi, m), height, weight * reflectance),
            ((refracted[0], refracted[1], -refracted[2]), _overturned(height), weight * (1.0 - reflectance)),
        ]
        kept, sums = [], []
        for w, h, energy in ways:
            free = _free(w, h, alpha)
            powers = jnp.exp(-depths / jnp.where(w[2] > 1e-6, w[2], 1e-6))
            out = jnp.where(first, 0.0, energy * jnp.exp(-free))
            sums.append((powers @ jnp.where(far, 0.0, out), powers @ jnp.where(far, out, 0.0)))
            kept.append(energy * -jnp.expm1(-free))
        weight = kept[0] + kept[1]
        crosses = u3 * weight > kept[0]
        travel = select(crosses, ways[1][0], ways[0][0])
        height = jnp.where(crosses, ways[1][1], height)
        (near_kept, far_kept), (near_crossed, far_crossed) = sums
        energies = energies + jnp.stack([near_kept + far_crossed, far_kept + near_crossed])
        most = jnp.where(first, jnp.sum(weight), most)
        return number + 1, travel, height, weight, far ^ crosses, energies, most

    def goes_on(state: tuple) -> Array:
        number, _, _, weight, _, _, most = state
        return (number < EVENTS) & (jnp.sum(weight) > LEAST_LEFT * most)

    travel = sine * one, 0.0 * one, -cosine * one
    nothing = jnp.zeros((2, len(depths)), jnp.float32)
    start = 0, travel, 0.0 * one, one, jnp.zeros(paths, bool), nothing, jnp.float32(0.0)
    energy = jax.lax.while_loop(goes_on, event, start)[5]
    straight = jnp.stack([jnp.zeros_like(depths), jnp.exp(-depths / cosine)])[..., 0]  # where all leaves at once
    total = jnp.sum(energy[:, -1])
    return jnp.where(total > 0, energy / total, straight)


def _free(w: Vector, height: Array, alpha: Array) -> Array:
    """Collisions, on average, on the way out of the surface: none of light that goes down escapes."""
    up = w[2] > 0
    return jnp.where(up, height * _facing(w, alpha) / jnp.where(up, w[2], 1.0), jnp.inf)


def _facing(w: Vector, alpha: Array) -> Array:
    """Projected area of the facets that face a ray along w, above 0."""
    spread = alpha * alpha * (w[0] * w[0] + w[1] * w[1])
    sigma = jnp.sqrt(spread + w[2] * w[2])
    return 0.5 * jnp.where(w[2] > 0, spread / (sigma + jnp.abs(w[2])), sigma - w[2]) + 1e-20


def _overturned(height: Array) -> Array:
    """Height counted from the other side of the surface, -log(1 - exp(-height))."""
    return -jnp.where(height < 0.6931, jnp.log(-jnp.expm1(-height)), jnp.log1p(-jnp.exp(-height)))


def _lattice(paths: int) -> np.ndarray:
    """Points (STRATIFIED, paths) spread evenly in the unit cube: multiples of powers of a generalised golden ratio."""
    ratio = 1.5
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (STRATIFIED + 1))
    return np.outer(ratio ** -np.arange(1.0, STRATIFIED + 1), np.arange(paths)) % 1.0
