"""Phase functions of media: Henyey-Greenstein, and SGGX flakes of any orientation.

Each offers the same few functions of directions as components (see `layerjax.directions`):

- ``cross_section(w)``: extinction along w per unit of thickness, sigma(w);
- ``kernel(wi, wo, h)``: sigma(wi) p(wi, wo), symmetric, 1/sr, before albedo and Fresnel; h is the half vector if known;
- ``sample(wi, u1, u2)`` and ``pdf(wi, wo)``: exact sampling of p, and p itself;
- ``rule(wi, nodes)``: quadrature nodes that resolve the lobe (see `layerjax.quadrature`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import safe_div
from layerjax._parameters import Parameter, floating, is_placeholder, parameter
from layerjax.directions import Vector, add, combine, dot, frame, half_vector, normalize, reflect, scale, split
from layerjax.normals.sggx import Kind, radii, sggx_area, sggx_density, sggx_sample
from layerjax.quadrature import Rule, flake_rule, henyey_greenstein_inverse, henyey_greenstein_rule


class HenyeyGreenstein(eqx.Module):
    """Henyey-Greenstein phase function (Henyey & Greenstein 1941).

    ========= ====== ================ ======= ============================================
    parameter symbol range            default meaning
    ========= ====== ================ ======= ============================================
    g         g      [-0.999, 0.999]          mean cosine of deflection; > 0 scatters onward
    ========= ====== ================ ======= ============================================
    """

    g: Parameter = parameter("HenyeyGreenstein.g")

    def cross_section(self, w: Vector) -> Array:
        return jnp.ones_like(w[2])

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        return self.pdf(wi, wo)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        g = self.g
        # 1 + g^2 + 2 g wi.wo with both vectors outward, as a sum of positive terms
        total = add(wi, wo)
        difference = combine(1.0, wi, -1.0, wo)
        forward = (1.0 - g) ** 2 + g * dot(total, total)
        backward = (1.0 + g) ** 2 - g * dot(difference, difference)
        denominator = jnp.where(g > 0, forward, backward)
        return (1.0 - g * g) / (4.0 * jnp.pi * denominator * jnp.sqrt(denominator))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        cosine, sine = henyey_greenstein_inverse(self.g, 2.0 * u1 - 1.0)
        axis = scale(-1.0, wi)
        tangent, bitangent = frame(axis)
        phi = 2.0 * jnp.pi * u2
        return add(combine(sine * jnp.cos(phi), tangent, sine * jnp.sin(phi), bitangent), scale(cosine, axis))

    def rule(self, wi: Vector, nodes: int) -> Rule:
        return henyey_greenstein_rule(wi, self.g, nodes)


class SGGX(eqx.Module):
    """Flakes with an SGGX distribution of normals (Heitz et al. 2015; Wang 2022, Sec. 4), as small mirrors.

    ========= ====== ===================== ======== ===========================================================
    parameter symbol range                 default  meaning
    ========= ====== ===================== ======== ===========================================================
    kind             "surface" | "fiber"            normals along the axis (flakes) or across it (fibers)
    alpha     alpha  [1e-4, 1]                      roughness; 1 is isotropic
    axis      omega  any vector, not 0     None     symmetry axis, of any length; None is the normal z,
                                                    and costs less than a given axis
    ========= ====== ===================== ======== ===========================================================
    """

    kind: Kind = eqx.field(static=True)
    alpha: Parameter = parameter("SGGX.alpha")
    axis: Parameter = eqx.field(converter=lambda axis: _axis(axis), default=None)

    def __check_init__(self) -> None:
        if self.kind not in ("surface", "fiber"):
            raise ValueError(f'SGGX.kind: {self.kind!r} is not one of "surface", "fiber"')

    def cross_section(self, w: Vector) -> Array:
        return sggx_area(w, self.kind, self.alpha, self._axis())

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        if h is None:
            h, _ = half_vector(wi, wo)
        return 0.25 * sggx_density(h, self.kind, self.alpha, self._axis())  # Eq. (4) times sigma(wi)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        return self.kernel(wi, wo, None) / self.cross_section(wi)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return reflect(wi, sggx_sample(wi, self.kind, self.alpha, self._axis(), u1, u2))

    def rule(self, wi: Vector, nodes: int) -> Rule:
        return flake_rule(wi, *radii(self.kind, self.alpha), self._axis(), nodes)

    def _axis(self) -> Vector | None:
        if self.axis is None:
            return None
        # its square must neither overflow nor vanish
        longest = jax.lax.stop_gradient(jnp.max(jnp.abs(self.axis)))
        return normalize(split(safe_div(self.axis, longest)))


PhaseFunction = HenyeyGreenstein | SGGX


def _axis(axis: Any) -> Any:
    if axis is None or is_placeholder(axis):
        return axis
    array = axis if isinstance(axis, jax.Array) else np.asarray(axis)
    if array.shape != (3,):
        raise ValueError(f"SGGX.axis: shape {array.shape} given, (3,) needed")
    if array.dtype.kind not in "iuf" or isinstance(array, jax.core.Tracer):
        return floating("SGGX.axis", axis)
    concrete = np.asarray(array, float)
    longest = np.abs(concrete).max()
    if not (np.isfinite(longest) and longest > 0):
        raise ValueError(f"SGGX.axis: {concrete.tolist()} is not a finite vector other than zero")
    # whatever its length, it may be asked for in single precision
    return floating("SGGX.axis", axis if 1e-6 < longest < 1e6 else concrete / longest)
