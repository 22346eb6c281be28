"""Conventions, and elementary geometry of directions.

Everything else in the package refers to these conventions:

- Local frame: z is the macroscopic normal and points out of the top of the stack.
- ``wi`` points towards the light, ``wo`` towards the viewer; both are unit vectors of shape ``(..., 3)`` that point
  *away* from the surface. Below-horizon ``wi`` (z < 0) lights the stack from below.
- Angles are in radians here, in degrees in files and on the command line. ``direction(theta, phi)`` has polar angle
  theta from +z and azimuth phi from +x; ``phi_o = phi_i + pi`` is the mirror direction.
- A BSDF value f is in 1/sr and does not contain the cosine. Channels are the last axis and always there.
- Transports compute radiance, not importance. Between media of different index, reciprocity holds for f / ior_o^2.

Inside the package a direction is a tuple ``(x, y, z)`` of arrays (`Vector`): separate components keep XLA from
shuffling an inner axis of three. Functions of components take any shapes that broadcast, and return their common shape.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from layerjax._checks import require_choice
from layerjax._numerics import horizon, safe_sqrt
from layerjax._parameters import as_floating

Vector = tuple[Array, Array, Array]
Factor = Array | float

ANGLE_SLACK = 1e-5
"""By which an angle may pass its limit: rounding in single precision, of degrees as well."""

MOST_AZIMUTH = 3.0 * np.pi
"""Size of an azimuth in radians: that of a mirror direction, half a turn from an azimuth of up to a whole one."""

IN_DEGREES = "of angles in degrees say direction(..., degrees=True)"

UNIT_SLACK = 2e-3
"""What the squared length of a direction may differ from 1: directions come rounded from files."""


def direction(theta: ArrayLike, phi: ArrayLike, *, degrees: bool = False) -> Array:
    """Unit vector with polar angle `theta` from +z and azimuth `phi` from +x, in radians.

    Args:
        theta: polar angle; beyond pi/2 it points below.
        phi: azimuth, which broadcasts against theta.
        degrees: both are in degrees.

    Returns:
        Shape ``broadcast(theta, phi) + (3,)``.

    Raises:
        ValueError: a polar angle that is known lies outside [-pi, pi], or an azimuth in radians outside
            [-3 pi, 3 pi], as those in degrees would.
    """
    require_choice("degrees", degrees, (True, False))
    with jax.ensure_compile_time_eval():  # known angles give known directions, under jit too
        polar, azimuth = as_floating("theta", theta), as_floating("phi", phi)
        if (size := _size(theta)) > (180.0 if degrees else np.pi) + ANGLE_SLACK:
            limit = " degrees is outside [-180, 180]" if degrees else f" is outside [-pi, pi]; {IN_DEGREES}"
            raise ValueError(f"theta: {size:g}{limit}")
        if not degrees and (size := _size(phi)) > MOST_AZIMUTH + ANGLE_SLACK:
            raise ValueError(f"phi: {size:g} is outside [-3 pi, 3 pi]; {IN_DEGREES}")
        if degrees:
            polar, azimuth = jnp.deg2rad(polar), jnp.deg2rad(azimuth)
        theta, phi = jnp.broadcast_arrays(polar, azimuth)
        sin_theta = jnp.sin(theta)
        return jnp.stack([sin_theta * jnp.cos(phi), sin_theta * jnp.sin(phi), jnp.cos(theta)], axis=-1)


def _size(angles: ArrayLike) -> float:
    """The largest absolute value; 0 for angles that are not known."""
    if any(isinstance(one, jax.core.Tracer) for one in jax.tree.leaves(angles)):
        return 0.0
    return float(np.max(np.abs(np.asarray(angles, float)), initial=0.0))


def angles(w: ArrayLike) -> tuple[Array, Array]:
    """Polar angle in [0, pi] and azimuth in (-pi, pi] of directions ``(..., 3)``, in radians, shape ``(...)`` each."""
    x, y, z = split(as_floating("w", w))
    planar = x * x + y * y
    at_pole = planar == 0  # the azimuth is undefined there: give 0, with gradient 0
    azimuth = jnp.where(at_pole, 0.0, jnp.arctan2(jnp.where(at_pole, 0.0, y), jnp.where(at_pole, 1.0, x)))
    return jnp.arctan2(safe_sqrt(planar), z), azimuth


def split(w: Array) -> Vector:
    """Components of directions of shape ``(..., 3)``."""
    return w[..., 0], w[..., 1], w[..., 2]


def join(w: Vector) -> Array:
    """Directions of shape ``(..., 3)`` from components."""
    return jnp.stack(jnp.broadcast_arrays(*w), axis=-1)


def dot(a: Vector, b: Vector) -> Array:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def select(chosen: Array, a: Vector, b: Vector) -> Vector:
    """a where chosen, else b."""
    return (jnp.where(chosen, a[0], b[0]), jnp.where(chosen, a[1], b[1]), jnp.where(chosen, a[2], b[2]))


def scale(factor: Factor, a: Vector) -> Vector:
    """The vector times a number."""
    return (factor * a[0], factor * a[1], factor * a[2])


def flip(a: Vector) -> Vector:
    """The vector as it is where the stack lies upside down: below for above, and the other way round."""
    return a[0], a[1], -a[2]


def combine(p: Factor, a: Vector, q: Factor, b: Vector) -> Vector:
    """p a + q b."""
    return (p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2])


def normalize(a: Vector) -> Vector:
    """The unit vector along a; a zero vector becomes +z, with gradient 0."""
    squared = dot(a, a)
    valid = squared > 0
    inverse = 1.0 / jnp.sqrt(jnp.where(valid, squared, 1.0))
    return (
        jnp.where(valid, a[0] * inverse, 0.0),
        jnp.where(valid, a[1] * inverse, 0.0),
        jnp.where(valid, a[2] * inverse, 1.0),
    )


def horizontal(a: Vector) -> Vector:
    """The unit vector in the tangent plane (z = 0) below or above a, +x if a has no azimuth."""
    squared = a[0] * a[0] + a[1] * a[1]
    tilted = squared > 0
    inverse = 1.0 / jnp.sqrt(jnp.where(tilted, squared, 1.0))
    return jnp.where(tilted, a[0] * inverse, 1.0), jnp.where(tilted, a[1] * inverse, 0.0), jnp.zeros_like(squared)


def is_above(w: Vector) -> Array:
    """Whether w is above the horizon (the tangent plane is not)."""
    return w[2] > horizon(w[2].dtype)


def sanitise(w: Vector, valid: Array | None = None) -> Vector:
    """w, with an interior stand-in for its cosine where it is not valid (not above the horizon, if not said).

    What is computed of the stand-in is finite, with finite derivatives, and is to be thrown away.
    """
    return w[0], w[1], jnp.where(is_above(w) if valid is None else valid, w[2], 0.5)


def half_vector(wi: Vector, wo: Vector, *, same_side: bool = False) -> tuple[Vector, Array]:
    """Half vector h of the unit vectors wi and wo, and the cosine |wi . h|, in [0, 1].

    At wo = -wi the half vector is undefined (any vector normal to wi is a limit): one fixed vector normal to wi
    stands in. `same_side` states that wi and wo lie on the same side of the surface, where that cannot happen, and
    skips the guard.
    """
    total = add(wi, wo)
    squared = dot(total, total)
    if same_side:
        inverse = 1.0 / jnp.sqrt(squared)
        return scale(inverse, total), 0.5 * squared * inverse  # wi . h = |wi + wo| / 2 for unit vectors
    defined = squared > 16.0 * jnp.finfo(squared.dtype).eps ** 2
    inverse = 1.0 / jnp.sqrt(jnp.where(defined, squared, 1.0))
    tangent, _ = frame(wi)
    h = (
        jnp.where(defined, total[0] * inverse, tangent[0]),
        jnp.where(defined, total[1] * inverse, tangent[1]),
        jnp.where(defined, total[2] * inverse, tangent[2]),
    )
    return h, jnp.where(defined, 0.5 * squared * inverse, 0.0)


def reflect(w: Vector, m: Vector) -> Vector:
    """Mirror image of w about the unit vector m (both pointing away from the surface)."""
    cosine = dot(w, m)
    return (2 * cosine * m[0] - w[0], 2 * cosine * m[1] - w[1], 2 * cosine * m[2] - w[2])


def mirror(w: Vector) -> Vector:
    """The mirror direction about the normal."""
    return -w[0], -w[1], w[2]


def bend(w: Vector, ior: Array) -> tuple[Vector, Array]:
    """Direction, on the same side, of a ray along w where the index is `ior` times as large, and whether it exists.

    What a path keeps as it crosses smooth interfaces; along the tangent plane where it does not exist.
    """
    squared = squared_cosine_of_refraction(w[2], ior)
    exists = squared > 0
    cosine = jnp.where(exists, jnp.sqrt(jnp.where(exists, squared, 1.0)), 0.0)
    return (w[0] / ior, w[1] / ior, jnp.where(w[2] < 0, -cosine, cosine)), exists


def squared_cosine_of_refraction(cosine: Array, ior: Array) -> Array:
    """Squared cosine of refraction by Snell's law, below 0 under total reflection; exactly cosine^2 where ior is 1.

    ior: index on the far side over index on the side of incidence.
    """
    return ((ior - 1.0) * (ior + 1.0) + cosine * cosine) / (ior * ior)


def refract(w: Vector, m: Vector, ior: Array) -> tuple[Vector, Array]:
    """Direction that w refracts into at a facet with unit normal m, and whether it exists.

    `ior` is the index on the far side of the facet over that on w's side. Both w and the result point away from the
    facet, to opposite sides of it. Under total internal reflection the flag is False and the vector has no meaning
    (it is finite, with finite gradient).
    """
    cosine = dot(w, m)
    squared = squared_cosine_of_refraction(cosine, ior)
    exists = squared > 0
    refracted = jnp.sqrt(jnp.where(exists, squared, 1.0))
    along = cosine / ior - jnp.sign(cosine) * refracted
    return combine(along, m, -1.0 / ior, w), exists


def frame(n: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors that complete the unit vector n to a right-handed frame (Duff et al. 2017, JCGT 6(1))."""
    sign = jnp.where(n[2] < 0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    tangent = (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    bitangent = (b, sign + n[1] * n[1] * a, -n[1])
    return tangent, bitangent


def read_directions(**named: ArrayLike) -> list[Array]:
    """Directions as arrays of one floating type; a ValueError that says what they are if they are none.

    Concrete ones must be of unit length (within 1e-3). Traced ones have no length yet: it is up to the caller.
    """
    with jax.ensure_compile_time_eval():  # what is known while a program is traced is looked at as well
        arrays = [as_floating(name, value) for name, value in named.items()]
        for name, array in zip(named, arrays, strict=True):
            if array.ndim < 1 or array.shape[-1] != 3:
                raise ValueError(f"{name}: shape {array.shape} given, (..., 3) needed")
        for name, array in zip(named, arrays, strict=True):
            if array.size and not isinstance(array, jax.core.Tracer):
                _require_unit(name, array)
        dtype = jnp.result_type(*arrays)
        return [array.astype(dtype) for array in arrays]


def _require_unit(name: str, array: Array) -> None:
    if not float(_farthest_from_unit(array)) < UNIT_SLACK:
        length = np.linalg.norm(np.asarray(array, float).reshape(-1, 3), axis=-1)
        first = int(np.argmax(~(np.abs(length - 1.0) < 0.5 * UNIT_SLACK)))
        where = f" ({name}.reshape(-1, 3)[{first}])" if array.ndim > 1 else ""
        raise ValueError(f"{name}: a direction has length {length[first]:g}{where}, must be 1")


@jax.jit
def _farthest_from_unit(directions: Array) -> Array:
    """Largest difference of a squared length from 1; NaN if there is one."""
    flat = directions.reshape(-1, 3)
    return jnp.max(jnp.abs((flat * flat) @ jnp.ones(3, flat.dtype) - 1.0))
