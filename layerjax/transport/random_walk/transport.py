"""Monte Carlo reference: unbiased random walks through anything that a `Stack` holds.

See `layerjax.transport.random_walk.walk` for the path of light, `layerjax.transport.random_walk.next_event` for what it
adds to a BSDF value, `layerjax.transport.random_walk.batches` for how paths share a batch, and
`layerjax.transport.random_walk.random_numbers` for the random numbers.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._checks import require_choice, require_count
from layerjax._numerics import horizon
from layerjax.channels import Channels
from layerjax.directions import Vector, flip, half_vector, reflect, sanitise, select
from layerjax.normals.facets import reflection_pdf, sample
from layerjax.stack import Interface, Stack
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.transport.contract import RandomTransport, Side, refuse_interface_film, refuse_smooth, require_ggx
from layerjax.transport.random_walk.batches import average, replace_invalid
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.state import Step
from layerjax.transport.random_walk.walk import Orders, Walk
from layerjax.transport.specular import density_with_deltas, sample_with_deltas, specular_draws


class RandomWalk(RandomTransport):
    """Monte Carlo random walk: all orders of scattering, unbiased, with a standard error; needs a key.

    Supports every layer and base; von Mises-Fisher normals only with ``facet_multiple_scattering=False``. Narrow lobes
    are importance-sampled: that of the interface on the side of wo and, without multiple scattering between facets,
    that of the metal or interface opposite. The same key and the same shapes give the same numbers, bit for bit.

    Args:
        paths: number of paths for each pair of directions (for each direction of an albedo), >= 2.
        facet_multiple_scattering: whether light is followed on a rough surface until it leaves (Heitz et al. 2016);
            otherwise it is reflected or refracted once (Walter et al. 2007), and what is masked is lost.
        orders: ``"all"``; ``"first"``, only paths with one event; ``"multiple"``, only paths with more. An event is a
            collision, a reflection or refraction at an interface, or a reflection at the base.
        batch_size: number of paths that are computed at a time.
    """

    paths: int = eqx.field(static=True, default=16384)
    facet_multiple_scattering: bool = eqx.field(static=True, default=False)
    orders: Orders = eqx.field(static=True, default="all")
    batch_size: int = eqx.field(static=True, default=4096)

    def __check_init__(self) -> None:
        require_count("RandomWalk.paths", self.paths, 2)  # one gives no standard error
        require_count("RandomWalk.batch_size", self.batch_size, 1)
        require_choice("RandomWalk.facet_multiple_scattering", self.facet_multiple_scattering, (False, True))
        require_choice("RandomWalk.orders", self.orders, ("all", "first", "multiple"))

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        if self.orders != "all":
            refuse_smooth(stack, names, f'RandomWalk(orders="{self.orders}")')
        if self.facet_multiple_scattering:
            require_ggx(stack, names, "RandomWalk(facet_multiple_scattering=True)")
            refuse_interface_film(stack, names, "RandomWalk(facet_multiple_scattering=True)", rough_only=True)

    def prepare(self, stack: Stack) -> Stack:
        return stack

    def estimate(
        self, state: Stack, wi: Vector, wo: Vector, side: Side, channels: int, key: Array
    ) -> tuple[Array, Array]:
        """BSDF values of n pairs and their standard errors, shape (n, channels) each."""
        scene = Scene(state, channels, wi[2].dtype)
        edge = horizon(wi[2].dtype)
        valid = (jnp.abs(wi[2]) > edge) & (jnp.abs(wo[2]) > edge)
        if state.base is not None or side == "reflection":
            valid = valid & (wi[2] > 0) & (wo[2] > 0)
        if side == "transmission":
            valid = valid & (wi[2] * wo[2] < 0)
        wi, wo = replace_invalid(wi, valid), replace_invalid(wo, valid)

        def walk(wi: Vector, wo: Vector) -> Walk:
            return Walk(scene, wi, wo, self.facet_multiple_scattering, self.orders)

        def tally(step: Step) -> Channels:
            return step.contribution

        return average(walk, tally, channels, (wi, wo), valid, self.paths, self.batch_size, key)

    def estimate_albedo(self, state: Stack, wi: Vector, channels: int, key: Array) -> tuple[Array, Array]:
        """Shares scattered to wi's side, then to the other, and standard errors, shape (n, 2 channels) each."""
        scene = Scene(state, channels, wi[2].dtype)
        valid = jnp.abs(wi[2]) > horizon(wi[2].dtype)
        valid = valid & (wi[2] > 0) if state.base is not None else valid

        def walk(wi: Vector) -> Walk:
            return Walk(scene, wi, None, self.facet_multiple_scattering, self.orders, count_orders=True)

        def tally(step: Step) -> Channels:
            assert step.order is not None
            counted = step.escapes & (step.order >= (2 if self.orders == "multiple" else 1))
            above = step.direction[2] > 0
            upwards = tuple(jnp.where(counted & above, w, 0.0) for w in step.weight)
            downwards = tuple(jnp.where(counted & ~above, w, 0.0) for w in step.weight)
            return (*upwards, *downwards)

        value, error = average(
            walk, tally, 2 * channels, (replace_invalid(wi, valid),), valid, self.paths, self.batch_size, key
        )
        above = (wi[2] > 0)[:, None]

        def near_first(x: Array) -> Array:
            return jnp.where(above, x, jnp.roll(x, channels, axis=1))

        return near_first(value), near_first(error)

    def sample(self, state: Stack, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return sample_with_deltas(state, wi, uniforms, partial(_sample, state, wi))

    def pdf(self, state: Stack, wi: Vector, wo: Vector) -> Array:
        return density_with_deltas(state, wi, _density(state, wi, wo))

    def specular_draws(
        self, state: Stack, wi: Vector, uniforms: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Channels] | None:
        return specular_draws(state, wi, uniforms[0])


def _sample(state: Stack, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """Directions from cosine lobes and the visible normals of the top interface."""
    u, u1, u2 = uniforms
    side = jnp.where(wi[2] < 0, -1.0, 1.0)
    local = sanitise((wi[0], wi[1], wi[2] * side))
    near, far = _diffuse_shares(state)
    cosine = sample_cosine(u1, u2)
    wo = select(u < near, cosine, flip(cosine))
    facets = _facets(state)
    if facets is not None:
        m = sample(local, facets.width, u1, u2, facets.distribution)
        wo = select(u < near + far, wo, reflect(local, m))
    return wo[0], wo[1], wo[2] * side


def _density(state: Stack, wi: Vector, wo: Vector) -> Array:
    """Density of `_sample` in solid angle, 1/sr."""
    side = jnp.where(wi[2] < 0, -1.0, 1.0)
    local, towards = sanitise((wi[0], wi[1], wi[2] * side)), (wo[0], wo[1], wo[2] * side)
    near, far = _diffuse_shares(state)
    density = jnp.where(towards[2] > 0, near, far) * jnp.abs(towards[2]) / jnp.pi
    facets = _facets(state)
    if facets is not None:
        h, _ = half_vector(local, towards)
        mirrored = reflection_pdf(h, local, facets.width, facets.distribution)
        density = density + (1.0 - near - far) * jnp.where(h[2] > 0, mirrored, 0.0)
    return density


def _diffuse_shares(state: Stack) -> tuple[float, float]:
    """Shares of cosine lobes on wi's side and on the other; visible normals of the top interface take the rest."""
    lobes = 1.0 if _facets(state) is None else 0.5
    return (lobes, 0.0) if state.base is not None else (0.5 * lobes, 0.5 * lobes)


def _facets(state: Stack) -> Interface | None:
    return next((layer for layer in state.layers if isinstance(layer, Interface) and not layer.is_smooth), None)
