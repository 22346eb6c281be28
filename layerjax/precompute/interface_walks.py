"""Multiply scattered light on a rough dielectric interface: the walk of Heitz et al. 2016, past its first collision.

Heights and directions are those of `layerjax.microsurface.heitz_walk`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax.directions import Vector, reflect, scale, select
from layerjax.microsurface.heitz_walk import meet_facet, next_height, optical_depth, pass_through

EVENTS = 100
"""Collisions followed at most: near index 1 light goes through facet after facet."""

LEAST_LEFT = 1e-4
"""Part of the light left after the first collision at which a walk ends; what is left then is shared like the rest."""

STRATIFIED = 12
"""Random numbers of a path, from its first on, that are points of a lattice."""


@partial(jax.jit, static_argnums=3)
def multiple_scattering(points: Array, keys: Array, taus: Array, paths: int) -> Array:
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

    At every facet both reflection and refraction are followed out of the surface; the path continues by one of them
    with what does not leave.
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
        staying = -jnp.expm1(-optical_depth(travel, height, alpha))
        height = next_height(travel, height, alpha, -jnp.log1p(-u4 * staying))
        height = jnp.where(height > 1e-30, height, 1e-30)
        wi = scale(-1.0, travel)
        m, at_facet = meet_facet(wi, alpha, u1, u2)
        n = jnp.where(far, 1.0 / ior, ior)
        refracted, below, exists = pass_through(wi, m, n, height)
        reflectance = jnp.where(exists, fresnel.dielectric(at_facet, n), 1.0)
        ways: list[tuple[Vector, Array, Array]] = [
            (reflect(wi, m), height, weight * reflectance),
            (refracted, below, weight * (1.0 - reflectance)),
        ]
        blocked, sums = [], []
        for w, h, energy in ways:
            free = optical_depth(w, h, alpha)
            powers = jnp.exp(-depths / jnp.where(w[2] > 1e-6, w[2], 1e-6))
            out = jnp.where(first, 0.0, energy * jnp.exp(-free))
            sums.append((powers @ jnp.where(far, 0.0, out), powers @ jnp.where(far, out, 0.0)))
            blocked.append(energy * -jnp.expm1(-free))
        weight = blocked[0] + blocked[1]
        crosses = u3 * weight > blocked[0]
        travel = select(crosses, ways[1][0], ways[0][0])
        height = jnp.where(crosses, ways[1][1], height)
        (near_reflected, far_reflected), (near_crossed, far_crossed) = sums
        energies = energies + jnp.stack([near_reflected + far_crossed, far_reflected + near_crossed])
        most = jnp.where(first, jnp.sum(weight), most)
        return number + 1, travel, height, weight, far ^ crosses, energies, most

    def goes_on(state: tuple) -> Array:
        number, _, _, weight, _, _, most = state
        return (number < EVENTS) & (jnp.sum(weight) > LEAST_LEFT * most)

    travel = sine * one, 0.0 * one, -cosine * one
    nothing = jnp.zeros((2, len(depths)), jnp.float32)
    start = 0, travel, 0.0 * one, one, jnp.zeros(paths, bool), nothing, jnp.float32(0.0)
    energy = jax.lax.while_loop(goes_on, event, start)[5]
    ballistic = jnp.stack([jnp.zeros_like(depths), jnp.exp(-depths / cosine)])[..., 0]  # where all leaves at once
    total = jnp.sum(energy[:, -1])
    return jnp.where(total > 0, energy / total, ballistic)


def _lattice(paths: int) -> np.ndarray:
    """Points (STRATIFIED, paths) spread evenly in the unit cube: multiples of powers of a generalised golden ratio."""
    ratio = 1.5
    for _ in range(64):
        ratio = (1.0 + ratio) ** (1.0 / (STRATIFIED + 1))
    return np.outer(ratio ** -np.arange(1.0, STRATIFIED + 1), np.arange(paths)) % 1.0
