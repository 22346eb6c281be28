"""A transport's totals as a forward model: what a sphere takes in of a stack's light, measurement by measurement."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from fits.data.spheres import Shares, Spheres
from fits.data.totals import Kind, Totals
from layerjax._shapes import require_single
from layerjax.quadrature import gauss_legendre
from layerjax.stack import simplify

DIFFUSE = 12  # directions, on either side, that diffuse light comes from


class Totalling(eqx.Module):
    """(stack, wi, wo) -> shares of light (N, C), in the place of a transport's values.

    kinds: of the N measurements. solved_rows: those with different lights, which are solved for. light: the place among
    these of each measurement's. spheres: that read them; None: shares of the sample alone.
    """

    transport: Any = eqx.field(static=True)
    kinds: tuple[Kind, ...] = eqx.field(static=True)
    solved_rows: tuple[int, ...] = eqx.field(static=True)
    light: tuple[int, ...] = eqx.field(static=True)
    spheres: Spheres | None = eqx.field(static=True)

    @classmethod
    def of(cls, totals: Totals, transport: Any) -> "Totalling":
        """The totals of these measurements, by a transport that is no function of the user's own."""
        if not isinstance(transport, lj.Transport) and transport != "auto":
            raise ValueError(f"transport is {transport!r}; totals take a layerjax transport, or 'auto'")
        _, solved_rows, light = np.unique(totals.wi, axis=0, return_index=True, return_inverse=True)
        rows, places = (tuple(np.ravel(one).tolist()) for one in (solved_rows, light))
        return cls(transport, totals.kinds, rows, places, totals.spheres)

    def __call__(self, stack: lj.Stack | lj.Mixture, wi: Array, wo: Array) -> Array:
        require_single(stack, "inference")
        lights = jnp.asarray(wi)[np.array(self.solved_rows)]
        shares: dict[Kind, Array] = {}
        if not {"reflectance", "transmittance"}.isdisjoint(self.kinds):
            if self.spheres is None:
                near, far = _both(stack, lights, self.transport)
            else:  # which read diffuse light as well, from either side
                cosine, weight = gauss_legendre(DIFFUSE)
                upper = np.stack([np.sqrt(1.0 - cosine**2), 0.0 * cosine, cosine], axis=-1)
                near, far = _both(stack, jnp.concatenate([lights, upper, upper * (1, 1, -1)]), self.transport)
                share = jnp.asarray(2.0 * cosine * weight)
                above, below = slice(-2 * DIFFUSE, -DIFFUSE), slice(-DIFFUSE, None)
                mean = [jnp.tensordot(share, part[side], 1) for part in (near, far) for side in (above, below)]
                count = len(self.solved_rows)
                near, far = self.spheres.measured(Shares(near[:count], far[:count], *mean))
            shares = {"reflectance": near, "transmittance": far}
        if "unscattered" in self.kinds:
            shares["unscattered"] = _unscattered(stack, lights, self.transport)
        return jnp.stack([shares[kind][place] for kind, place in zip(self.kinds, self.light, strict=True)])


def _both(stack: lj.Stack | lj.Mixture, lights: Array, transport: Any) -> tuple[Array, Array]:
    """All that leaves on the side of each light, and on the other."""
    near, far = lj.albedo(stack, lights, transport)
    mirrored, passed = lj.specular(stack, lights)
    return near + mirrored, far + passed


def _unscattered(stack: lj.Stack | lj.Mixture, lights: Array, transport: Any) -> Array:
    """What leaves on the other side of stacks whose media only absorb: interfaces may turn it, media do not."""
    if isinstance(stack, lj.Mixture):
        return stack.mean(lambda part, _: _unscattered(part, lights, transport))
    _, passed = lj.specular(stack, lights)
    if stack.base is not None or all(layer.is_smooth for layer in stack.layers if isinstance(layer, lj.Interface)):
        return passed
    layers = simplify(stack).layers
    absorbing = [lj.Medium(one.thickness, 0.0) if isinstance(one, lj.Medium) else one for one in layers]
    return passed + lj.albedo(lj.Stack(absorbing), lights, transport)[1]
