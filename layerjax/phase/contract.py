"""What every phase function offers, and what it may say of itself so that transports can make use of it."""

import abc
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._parameters import Parameter
from layerjax._repr import ReprModule
from layerjax.directions import Vector, add, combine, frame, scale
from layerjax.normals.sggx import Kind
from layerjax.quadrature import Rule, sphere_rule


class Flakes(NamedTuple):
    """An SGGX distribution of normals, see `layerjax.phase.sggx.SGGX` for what its parts are."""

    kind: Kind
    alpha: Parameter
    axis: Parameter


class PhaseFunction(ReprModule):
    """Base class of phase functions: p(wi, wo), which integrates to 1 over wo, and the extinction sigma(w).

    Directions are components that point away from the collision (see `layerjax.directions`): unscattered light has wo =
    -wi. The kernel sigma(wi) p(wi, wo) must be symmetric in wi and wo, and the same for -wi and -wo. A subclass has to
    define `pdf` and `sample`; also `cross_section` if sigma is not 1, and `is_axisymmetric` and `mirror` if p depends
    on azimuth. The other methods improve speed or accuracy, or are needed by further transports.

    Parameters are fields made by `layerjax._parameters.parameter`, which takes the range of a new one as `limits`.
    """

    uses_half_vector: ClassVar[bool] = False
    """Whether `kernel` is faster if it is given the half vector."""

    @abc.abstractmethod
    def pdf(self, wi: Vector, wo: Vector) -> Array:
        """p(wi, wo), 1/sr, which is also the density of `sample`."""

    @abc.abstractmethod
    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        """A direction wo drawn from p exactly, from two uniform numbers."""

    def cross_section(self, w: Vector) -> Array:
        """Extinction sigma(w) along w for a unit of thickness."""
        return jnp.ones_like(w[2])

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        """sigma(wi) p(wi, wo), 1/sr, before albedo and Fresnel term; h is the half vector, if it is known."""
        return self.cross_section(wi) * self.pdf(wi, wo)

    def deflection(self, u: Array) -> tuple[Array, Array] | None:
        """Cosine and sine of the angle by which a collision turns light, drawn from a uniform number.

        None: p depends on more than that angle.
        """
        return None

    def rule(self, wi: Vector, nodes: int) -> Rule:
        """Quadrature over both hemispheres (see `layerjax.quadrature`) that resolves p however narrow it is.

        Unless overridden, one for lobes that are not narrow.
        """
        return sphere_rule(wi, nodes)

    def moments(self, count: int) -> Array | np.ndarray | None:
        """Means over p of the first Legendre polynomials of the cosine of deflection, (count,).

        A numpy array is known while tracing. None: p depends on more than that angle, or is to be sampled as it is. A
        class whose p does not can return what `layerjax.phase.moments.moments_by_quadrature` finds: then any grid of
        directions carries its forward peak.
        """
        return None

    @property
    def width(self) -> Parameter:
        """Angle in radians, up to 1, over which p changes, and which a grid of directions has to resolve.

        Forward peaks of phase functions with `moments` are excluded, since the part that a grid misses is ballistic.
        """
        return 1.0

    @property
    def ballistic_width(self) -> Parameter:
        """Angle in radians, up to 1, over which the ballistic part of a forward peak falls off.

        It matters for transmission through the medium, beside `width`.
        """
        return 1.0

    @property
    def is_axisymmetric(self) -> bool:
        """Whether p and sigma are known (while tracing) not to change if all directions turn about the normal."""
        return True

    def simplify(self) -> "PhaseFunction":
        """This phase function without an axis that is known to be the normal, so that it stays known under tracing."""
        return self

    def mirror(self) -> "PhaseFunction":
        """The phase function upside down: its p(wi, wo) is this one's with the z of both directions turned round."""
        return self

    @property
    def forward_lobe(self) -> Parameter | None:
        """g of the Henyey-Greenstein lobe that may stand for p, where light is followed forward alone and sigma is 1.

        None: no such lobe may.
        """
        return None

    @property
    def flakes(self) -> Flakes | None:
        """Distribution of normals of specular flakes, or None."""
        return None


def deflect(wi: Vector, cosine: Array, sine: Array, phi: Array) -> Vector:
    """Light along wi, turned by an angle with that cosine and sine at the azimuth phi about where it was going."""
    axis = scale(-1.0, wi)
    tangent, bitangent = frame(axis)
    return add(combine(sine * jnp.cos(phi), tangent, sine * jnp.sin(phi), bitangent), scale(cosine, axis))
