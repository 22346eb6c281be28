"""Flakes and fibers of any orientation, as small mirrors (Heitz et al. 2015; Wang et al. 2022)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._checks import require_choice
from layerjax._numerics import safe_div
from layerjax._parameters import Parameter, as_floating, is_placeholder, parameter
from layerjax.directions import Vector, half_vector, normalize, reflect, split
from layerjax.normals.sggx import Kind, radii, sggx_area, sggx_density, sggx_sample
from layerjax.phase.contract import Flakes, PhaseFunction
from layerjax.quadrature import Rule, flake_rule


class SGGX(PhaseFunction):
    """Specular flakes with an SGGX distribution of normals (Heitz et al. 2015; Wang et al. 2022).

    p = D(h) / (4 sigma(wi)), with D(h) = 1 / (pi sqrt(det S) (h' S^-1 h)^2) and sigma(w) = sqrt(w' S w). Along the
    axis and across it, S has the eigenvalues 1 and alpha^2 for surfaces, alpha^2 and 1 for fibers.

    ========= ====== ===== ==== ================== ======== ============== =============================================
    parameter symbol shape unit range              default  differentiable meaning
    ========= ====== ===== ==== ================== ======== ============== =============================================
    kind                        "surface", "fiber" required no             normals along the axis (flakes), or across it
                                                                           (fibers)
    alpha     alpha  ()    1    [1e-4, 1]          required yes            roughness; 1 is isotropic
    axis      omega  (3,)  1    not 0              None     yes            symmetry axis, of any length; None: the
                                                                           normal z, which takes less time
    ========= ====== ===== ==== ================== ======== ============== =============================================
    """

    uses_half_vector: ClassVar[bool] = True

    kind: Kind = eqx.field(static=True)
    alpha: Parameter = parameter("SGGX.alpha")
    axis: Parameter = eqx.field(converter=lambda axis: _axis(axis), default=None)

    def __check_init__(self) -> None:
        require_choice("SGGX.kind", self.kind, ("surface", "fiber"))

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

    @property
    def width(self) -> Parameter:
        return self.alpha

    @property
    def is_axisymmetric(self) -> bool:
        if self.axis is None:
            return True
        return not isinstance(self.axis, jax.core.Tracer) and not np.any(np.asarray(self.axis)[..., :2] != 0.0)

    def simplify(self) -> "SGGX":
        if self.axis is None or not self.is_axisymmetric:
            return self
        return eqx.tree_at(lambda phase: phase.axis, self, None)

    def mirror(self) -> "SGGX":
        if self.axis is None:
            return self
        flip = jnp.asarray([1.0, 1.0, -1.0], jnp.asarray(self.axis).dtype)
        return eqx.tree_at(lambda phase: phase.axis, self, self.axis * flip)

    @property
    def flakes(self) -> Flakes:
        return Flakes(self.kind, self.alpha, self.axis)

    def _axis(self) -> Vector | None:
        if self.axis is None:
            return None
        # its square must neither overflow nor vanish
        longest = jax.lax.stop_gradient(jnp.max(jnp.abs(self.axis)))
        return normalize(split(safe_div(self.axis, longest)))


def _axis(axis: Any) -> Any:
    if axis is None or is_placeholder(axis):
        return axis
    array = axis if isinstance(axis, jax.Array) else np.asarray(axis)
    if array.shape[-1:] != (3,):
        raise ValueError(f"SGGX.axis: shape {array.shape} given, (3,) needed (or (..., 3) in a map of stacks)")
    if array.dtype.kind not in "iuf" or isinstance(array, jax.core.Tracer):
        return as_floating("SGGX.axis", axis)
    concrete = np.asarray(array, float)
    longest = np.abs(concrete).max(axis=-1, keepdims=True)
    bad = ~(np.isfinite(longest) & (longest > 0))[..., 0]
    if bad.any():
        raise ValueError(f"SGGX.axis: {concrete[bad][0].tolist()} is not a finite vector other than zero")
    # whatever its length, it may be needed in single precision
    return as_floating("SGGX.axis", axis if np.all((longest > 1e-6) & (longest < 1e6)) else concrete / longest)
