"""A homogeneous medium on the grid: its phase function at the nodes, and its layer by eigenvectors or by doubling.

Symbols: K the kernel sigma p of a collision before albedo (Wang 2022, Eq. 4), tau the thickness, a = sigma / mu. The
thin slab that doubling begins with scatters once, in closed form in depth (Eqs. 12 and 16), K tau / (mu_i mu_o) exp(-m)
exprel(y), and what is caught on its way out scatters once more and leaves: right to the order tau^2, and a lossless
slab loses nothing.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import exprel, mean_decay, safe_div, safe_sqrt
from layerjax.channels import per_channel
from layerjax.directions import Vector, half_vector
from layerjax.phase import SGGX, PhaseFunction
from layerjax.stack import Medium, is_known
from layerjax.transport.adding_doubling.grid import Region
from layerjax.transport.adding_doubling.moments import MomentCounts, kernel_of_moments, truncate
from layerjax.transport.adding_doubling.operators import Layer, Operator, Parts, double, matmul, rotate
from layerjax.transport.adding_doubling.sampling import balance, ballistic_share, modes_at_nodes
from layerjax.transport.adding_doubling.slab import slab

Pair = tuple[Array, Array]
"""Reflection and transmission, light from above."""

THIN = 0.7e-4
"""Largest thickness of the slab that doubling starts from: a relative error of 1e-6.

It is no power of two times a round number, so that derivatives by differences do not straddle a change of the number of
steps.
"""

MOST_STEPS = 28
"""Doublings that reach the thickest medium of the box, 1e4."""


class Kernel(eqx.Module):
    """Kernel K of a collision at the nodes, for light from above, in reflection and transmission: (modes, out, in).

    `schlick`: the same times (1 - |wi . h|)^5, if the medium has a Fresnel term. `solid` is the weight of dmu dphi over
    2 pi, `turn` takes azimuths by half a turn (modes: nothing).

    ballistic: share of a collision that is ballistic, in neither, (nodes,); the same of `schlick`.
    """

    plain: Pair
    schlick: Pair | None
    area: Array
    """sigma for light going down at the nodes."""
    cosine: Array
    solid: Array
    azimuths: int | None = eqx.field(static=True)
    ballistic: tuple[Array, Array] | None = None

    def turn(self, operator: Operator) -> Operator:
        """An operator lit from above to the same lit from below: the medium is its own image under inversion."""
        return rotate(operator, self.azimuths)

    def turn_rows(self, operator: Array) -> Array:
        """An operator whose outgoing directions are turned by half a turn about the normal."""
        return jnp.swapaxes(self.turn_row(jnp.swapaxes(operator, -1, -2)), -1, -2)

    def turn_row(self, values: Array) -> Array:
        """Values for light going down at the nodes to those for light going up."""
        if self.azimuths is None:
            return values
        split = values.reshape(*values.shape[:-1], -1, self.azimuths)
        return jnp.roll(split, self.azimuths // 2, axis=-1).reshape(values.shape)


def kernel_modes(
    phase: PhaseFunction,
    with_schlick: bool,
    region: Region,
    modes: int,
    carried: MomentCounts,
    *,
    grazing: bool = False,
) -> Kernel:
    """Kernel of a medium that is symmetric about the normal, as Fourier modes cos(m phi) in the azimuth of travel.

    carried: moments, if the phase function has any; grazing: of flakes, see `modes_at_nodes`.
    """
    area = phase.cross_section((region.sine, jnp.zeros_like(region.sine), region.cosine))
    if phase.moments(1) is not None:
        return _kernel_by_moments(phase, with_schlick, region, modes, carried, area)
    values = partial(_kernel_values, phase, with_schlick)
    truncated_kernel = modes_at_nodes(values, region, region, modes, grazing=grazing and isinstance(phase, SGGX))
    plain, schlick = (
        (truncated_kernel[0], truncated_kernel[1]),
        (truncated_kernel[2], truncated_kernel[3]) if with_schlick else None,
    )
    return _balance(Kernel(plain, schlick, area, region.cosine, region.solid, None))


def _kernel_by_moments(
    phase: PhaseFunction, with_schlick: bool, region: Region, modes: int, carried: MomentCounts, area: Array
) -> Kernel:
    """What quadrature misses, where there is more than one panel, counts as ballistic as well."""
    weight = 2.0 * jnp.pi * region.solid
    turned_round = jnp.asarray((-1.0) ** np.arange(modes), weight.dtype)[:, None, None]

    def truncated_kernel(is_schlick: bool) -> tuple[Pair, Array]:
        chi, onward, back = truncate(phase, is_schlick, carried, weight.dtype)
        reflect, transmit = kernel_of_moments(chi, region.cosine, region.sine, modes)
        return (reflect + turned_round * ballistic_share(back * jnp.ones_like(weight), weight), transmit), onward

    plain, onward = truncated_kernel(False)
    missing = area - onward - weight @ (plain[0][0] + plain[1][0])
    schlick, fifth = truncated_kernel(True) if with_schlick else (None, onward)
    shares = onward + missing, fifth + jnp.zeros_like(missing)
    return Kernel(plain, schlick, area, region.cosine, region.solid, None, shares)


def kernel_ordinates(phase: PhaseFunction, with_schlick: bool, region: Region, azimuths: int) -> Kernel:
    """Kernel of any medium, between all directions of the nodes and equally spaced azimuths."""
    phi = jnp.asarray(2.0 * np.pi * np.arange(azimuths) / azimuths, region.cosine.dtype)
    cosine, sine = (jnp.repeat(array, azimuths) for array in (region.cosine, region.sine))
    azimuth = jnp.tile(phi, region.cosine.shape[0])
    travel = (sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine)
    wi = (-travel[0][None], -travel[1][None], travel[2][None])
    wo = (travel[0][:, None], travel[1][:, None], travel[2][:, None])
    found = [value[None] for value in _kernel_values(phase, with_schlick, wi, wo)]
    plain, schlick = (found[0], found[1]), (found[2], found[3]) if with_schlick else None
    area = phase.cross_section((-travel[0], -travel[1], travel[2]))
    solid = jnp.repeat(region.solid, azimuths) / azimuths
    return _balance(Kernel(plain, schlick, area, cosine, solid, azimuths))


def _kernel_values(phase: PhaseFunction, with_schlick: bool, wi: Vector, wo: Vector) -> list[Array]:
    """Kernel in reflection and transmission, and if there is a Fresnel term both times (1 - |wi . h|)^5."""
    plain, schlick = [], []
    for side in (1.0, -1.0):
        out = (wo[0], wo[1], side * wo[2])
        h, cosine = half_vector(wi, out)
        value = phase.kernel(wi, out, h)
        plain.append(value)
        if with_schlick:
            schlick.append(value * fresnel.schlick(cosine, 0.0))
    return plain + schlick


def _balance(kernel: Kernel) -> Kernel:
    """The kernel scaled so that a collision scatters exactly sigma; what is left is ballistic."""
    weight = 2.0 * jnp.pi * kernel.solid
    reflect, transmit = kernel.plain[0][0], kernel.plain[1][0]
    area = kernel.area * jnp.ones_like(weight)
    scale, missing = balance([(reflect, kernel.turn_row), (transmit, lambda d: d)], weight, area)
    forward = ballistic_share(missing, weight)
    back, through = kernel.turn_row(scale)[:, None] * scale, scale[:, None] * scale

    def balanced(pair: Pair) -> Pair:
        return pair[0] * back, pair[1] * through + forward  # towards exact forward Schlick's term is 1

    schlick = None if kernel.schlick is None else balanced(kernel.schlick)
    return Kernel(balanced(kernel.plain), schlick, kernel.area, kernel.cosine, kernel.solid, kernel.azimuths)


def medium_layer(medium: Medium, kernel: Kernel, doubled: bool | None = None) -> Layer:
    """The medium as a layer: by eigenvectors, or (if None: in single precision) by doublings."""
    thickness = _column(medium.thickness, kernel)
    kernel = _separate_ballistic(medium, kernel)
    direct = _direct(kernel, thickness)
    if is_known(medium.albedo, 0.0):
        return Layer(Parts(None), direct_down=direct, direct_up=kernel.turn_row(direct))
    strength = _strength(medium, kernel)
    if thickness.dtype != jnp.float64 if doubled is None else doubled:
        return _double_slab(kernel, strength, thickness, direct)
    return _eigen_slab(kernel, strength, thickness, direct)


def _separate_ballistic(medium: Medium, kernel: Kernel) -> Kernel:
    """The kernel with an extinction, (channels or 1, 1, nodes), without the ballistic part."""
    if kernel.ballistic is None or is_known(medium.albedo, 0.0):
        return kernel
    onward, fifth = kernel.ballistic
    if kernel.schlick is not None:
        f0 = _column(medium.f0, kernel)
        onward = f0 * onward + (1.0 - f0) * fifth
    return eqx.tree_at(lambda k: k.area, kernel, kernel.area - _column(medium.albedo, kernel) * onward)


def _double_slab(kernel: Kernel, strength: Pair, thickness: Array, direct: Array) -> Layer:
    """The medium doubled up from a thin slab.

    How often is decided as it runs: one program does for every thickness.
    """

    @jax.checkpoint
    def doubled(rest: Pair, part: Array) -> Pair:
        once, passed = _single_scattering(kernel, strength, part), _direct(kernel, part)
        parts = Parts(once[0], rest[0]), Parts(once[1], rest[1])
        reflect, transmit = double(*parts, (passed, kernel.turn_row(passed)), kernel.turn)
        assert reflect is not None
        assert transmit is not None
        return reflect, transmit

    def step(rest: Pair, depth: Array) -> tuple[Pair, None]:
        return jax.lax.cond(depth >= first, doubled, lambda rest, _: rest, rest, thickness * depth), None

    depths = jnp.asarray(2.0 ** np.arange(-MOST_STEPS, 0), thickness.dtype)
    # thin slabs are passed over, down to the one that the thickness asks for; no derivative is in that
    largest = jax.lax.stop_gradient(jnp.max(thickness))
    passed_over = MOST_STEPS - jnp.ceil(jnp.log2(largest / THIN + 1e-30))
    first = depths[jnp.clip(passed_over, 0, MOST_STEPS - 1).astype(jnp.int32)]
    start = _repeated_scattering(kernel, strength, thickness * first)
    rest, _ = jax.lax.scan(step, start, depths)
    return _layer(kernel, _single_scattering(kernel, strength, thickness), rest, direct)


def _eigen_slab(kernel: Kernel, strength: Pair, thickness: Array, direct: Array) -> Layer:
    """The medium by `slab`, in double precision: single precision would lose conservative media in rounding."""
    root = safe_sqrt(kernel.solid * kernel.cosine)  # 0 for nodes that do not exist in this region
    into = safe_div(jnp.ones_like(root), root)
    rate = safe_sqrt(2.0 * jnp.pi * kernel.solid / kernel.cosine)
    turn = kernel.turn_rows if kernel.azimuths is not None else lambda operator: operator
    back, onward = (rate[:, None] * part * rate for part in (turn(strength[0]), strength[1]))
    removed = (kernel.area / kernel.cosine)[..., None] * jnp.eye(root.size, dtype=root.dtype)
    half = jnp.broadcast_to(0.5 * thickness[..., 0], jnp.broadcast_shapes(thickness.shape[:-1], back.shape[:-2]))
    reflect, transmit = slab(*jnp.broadcast_arrays(removed - onward + back, removed - onward - back), half)
    once = _single_scattering(kernel, strength, thickness)
    scale = root[:, None] * into
    rest = (
        turn(scale * reflect) - once[0],
        scale * (transmit - jnp.eye(root.size, dtype=root.dtype) * direct[..., None, :]) - once[1],
    )
    return _layer(kernel, once, rest, direct)


def _layer(kernel: Kernel, once: Pair, rest: Pair, direct: Array) -> Layer:
    reflect, transmit = Parts(once[0], rest[0]), Parts(once[1], rest[1])

    def turned_parts(parts: Parts) -> Parts:
        return Parts(kernel.turn(parts.first), kernel.turn(parts.rest))

    return Layer(reflect, turned_parts(reflect), transmit, turned_parts(transmit), direct, kernel.turn_row(direct))


def _direct(kernel: Kernel, thickness: Array) -> Array:
    return jnp.exp(-thickness * (kernel.area / kernel.cosine))


def _single_scattering(kernel: Kernel, strength: Pair, thickness: Array) -> Pair:
    """Flux scattered exactly once by a slab: reflection and transmission."""
    gain, depth = _depths(kernel, thickness)
    into, down, up = depth[..., None, :], depth[..., :, None], kernel.turn_row(depth)[..., :, None]
    reflect = gain * exprel(up + into)
    transmit = gain * mean_decay(down, into)
    return strength[0] * reflect, strength[1] * transmit


def _repeated_scattering(kernel: Kernel, strength: Pair, thickness: Array) -> Pair:
    """Flux that a thin slab scatters more than once: what is caught again on its way out scatters and then leaves."""
    gain, depth = _depths(kernel, thickness)
    started = gain * exprel(depth)[..., None, :]
    up, down = (
        started * part - once
        for part, once in zip(strength, _single_scattering(kernel, strength, thickness), strict=True)
    )
    again = 2.0 * jnp.pi * kernel.solid[:, None] / kernel.area[..., None, :]
    back, onward = strength[0] * again, strength[1] * again
    risen, turned_down = matmul(kernel.turn(onward), up), matmul(kernel.turn(back), up)  # for what travels upward
    assert risen is not None
    assert turned_down is not None
    return risen + back @ down, turned_down + onward @ down


def _depths(kernel: Kernel, thickness: Array) -> tuple[Array, Array]:
    """Collisions per unit of what falls in and of K, and the optical depth of light going down."""
    gain = 2.0 * jnp.pi * kernel.solid[:, None] * (thickness / kernel.cosine)[..., None, :]
    return gain, thickness * (kernel.area / kernel.cosine)


def _strength(medium: Medium, kernel: Kernel) -> tuple[Array, Array]:
    """Kernel times albedo and Schlick's term, (channels or 1, modes, out, in)."""
    reflect, transmit = (part[None] for part in kernel.plain)
    if kernel.schlick is not None:
        f0 = _column(medium.f0, kernel)[..., None]
        reflect, transmit = (
            f0 * part + (1.0 - f0) * fifth for part, fifth in zip((reflect, transmit), kernel.schlick, strict=True)
        )
    if is_known(medium.albedo, 1.0):
        return reflect, transmit
    albedo = _column(medium.albedo, kernel)[..., None]
    return albedo * reflect, albedo * transmit


def _column(value: Any, kernel: Kernel) -> Array:
    """A parameter along the axis of channels, (channels or 1, 1, 1)."""
    values = per_channel(jnp.asarray(value, kernel.area.dtype))
    return jnp.stack(values)[:, None, None]
