"""microsurface.npz: what rough GGX surfaces give back of light that meets more than one facet.

Coefficients of the polynomials of `layerjax.microsurface.multiple_bounces`, fitted by least squares to walks on the
microsurface (Heitz et al. 2016, "Multiple-scattering microfacet BSDFs with the Smith model") at low-discrepancy points
of the parameters. A walk starts with a given first event and is weighted with its Fresnel share; what leaves at each
facet is counted in full expectation, and where all of it is known by quadrature only its division is taken from walks.
Heights and directions are those of `layerjax.microsurface.heitz_walk`.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax.directions import Vector, normalize, reflect, scale, select
from layerjax.microsurface.directional_albedo import first_event, first_mirror
from layerjax.microsurface.heitz_walk import escape_probability, facing_area, meet_facet, next_height, pass_through
from layerjax.microsurface.multiple_bounces import conductor_basis, interface_bases

SEED = 2016
FACETS = 200
"""Facets that walks meet at most; between nearly equal indices light passes many."""
ENOUGH = 2e-4
"""Walks end when no more than this is left on any surface."""
BATCH_PATHS = 1 << 17
RIDGE = 0.1
"""Prior precision of a coefficient, in units of the inverse error of a walk's answer."""

First = Literal["reflected", "refracted", "mirror"]


def make(coarse: bool = False, report: Callable[[str], Any] = print) -> dict[str, np.ndarray]:
    """The table: coefficients for dielectrics with ior < 1 and > 1 ("below", "above"), and for conductors."""
    table = {"seed": np.array(SEED)}
    shrink = 32 if coarse else 1
    begin = time.perf_counter()
    plan: list[tuple[First, str, int, int]] = [
        ("reflected", "below", 32768, 512),
        ("refracted", "below", 32768, 512),
        ("reflected", "above", 8192, 256),
        ("refracted", "above", 8192, 256),
    ]
    for number, (first, side, points, paths) in enumerate(plan):
        u = _spread(points // shrink, 3)
        u = u[:, np.argsort(u[2])]  # walks of like length together
        cosine, alpha = np.maximum(u[0] ** 1.5, 1e-3), np.maximum(u[1] ** 0.7, 0.01)
        ior = np.sqrt(1.0 - (15.0 / 16.0) * u[2] ** 2)  # evenly in the cosine of the critical angle
        arguments = [cosine, alpha, ior if side == "below" else 1.0 / ior, np.zeros_like(ior)]
        coefficients, error = _fit(_dielectric, arguments, first, paths, number)
        table[f"{first}_{side}"] = coefficients
        report(f"{first}_{side}: rms residual {error:.1e}, {time.perf_counter() - begin:.0f} s")
    u = _spread(16384 // shrink, 4)
    metals = [np.exp(np.log(0.02) + np.log(500.0) * u[2]), 20.0 * u[3] ** 1.5]
    arguments = [np.maximum(u[0] ** 1.3, 1e-3), np.maximum(u[1] ** 0.7, 0.01), *metals]
    table["conductor"], error = _fit(_conductor, arguments, "mirror", 512, 4)
    report(f"conductor: rms residual {error:.1e}, {time.perf_counter() - begin:.0f} s")
    return table


def _fit(
    equations: Callable[..., tuple[Array, Array, Array]],
    arguments: list[np.ndarray],
    first: First,
    paths: int,
    number: int,
) -> tuple[np.ndarray, float]:
    """Coefficients, and the residual of the energies that they give."""
    key = jax.random.fold_in(jax.random.key(SEED), number)
    batch = BATCH_PATHS // paths
    rows = []
    for start in range(0, arguments[0].size, batch):
        few = [jnp.asarray(argument[start : start + batch]) for argument in arguments]
        near, far = _estimate(jax.random.fold_in(key, start), *few, first=first, paths=paths)
        rows.append([np.asarray(part) for part in equations(*few, near, far, first)])
    design, target, amount = (np.concatenate(part) for part in zip(*rows, strict=True))
    weight = 1.0 / np.sqrt(0.3 * amount / paths + 1e-8)
    prior = RIDGE * np.eye(design.shape[1])
    left_side = np.concatenate([design * weight[:, None], prior])
    right_side = np.concatenate([target * weight, np.zeros(len(prior))])
    coefficients = np.linalg.lstsq(left_side, right_side)[0]
    return coefficients, float(np.std(design @ coefficients - target))


@functools.partial(jax.jit, static_argnames="first")
def _dielectric(
    cosine: Array, alpha: Array, ior: Array, k: Array, near: Array, far: Array, first: First
) -> tuple[Array, Array, Array]:
    _, reflected_on, refracted_on = first_event(cosine, alpha, ior)
    basis = interface_bases(cosine, alpha, ior)[first]
    if first == "reflected":
        away = near + far
        return reflected_on[:, None] * basis, reflected_on * near / jnp.where(away > 0, away, 1.0), reflected_on
    return refracted_on[:, None] * basis, near, refracted_on


@functools.partial(jax.jit, static_argnames="first")
def _conductor(
    cosine: Array, alpha: Array, ior: Array, k: Array, near: Array, far: Array, first: First
) -> tuple[Array, Array, Array]:
    _, reflected_on = first_mirror(cosine, alpha, ior, k)
    _, all_reflected_on = first_mirror(cosine, alpha, 1e-9 * jnp.ones_like(ior), jnp.zeros_like(k))
    basis, mean = conductor_basis(cosine, alpha, ior, k)
    return (
        reflected_on[:, None] * basis,
        all_reflected_on * near / jnp.where(far > 0, far, 1.0) - reflected_on * mean,
        reflected_on,
    )


def _spread(count: int, dimensions: int) -> np.ndarray:
    """Points spread evenly over the unit cube, (dimensions, count), by powers of a generalised golden ratio."""
    ratio = 1.5
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    return (0.5 + np.arange(1, count + 1) * ratio ** -np.arange(1.0, dimensions + 1)[:, None]) % 1.0


@functools.partial(jax.jit, static_argnames=("first", "paths"))
def _estimate(
    key: Array, cosine: Array, alpha: Array, ior: Array, k: Array, *, first: First, paths: int
) -> tuple[Array, Array]:
    """Means over paths of what leaves after the first facet to the near and to the far side.

    Instead of a far side conductors have what perfect mirrors would have sent to the near side.
    """
    shape = (cosine.shape[0], paths)
    cosine, alpha, ior, k = (jnp.broadcast_to(x[:, None], shape).astype(jnp.float32) for x in (cosine, alpha, ior, k))
    zero, up = jnp.zeros_like(cosine), jnp.zeros(shape, bool)
    height_key, walk_key = jax.random.split(key)
    travel: Vector = (jnp.sqrt((1.0 - cosine) * (1.0 + cosine)), zero, -cosine)
    height = -jnp.log1p(-jax.random.uniform(height_key, shape, jnp.float32)) * cosine / facing_area(travel, alpha)

    def goes_on(state: tuple[Any, ...]) -> Array:
        return (state[0] < FACETS) & (jnp.max(jnp.mean(state[3] * state[4], axis=1)) > ENOUGH)

    def step(state: tuple[Any, ...]) -> tuple[Any, ...]:
        facet, travel, height, weight, level, ior, beyond, near, far = state
        begins = facet == 0
        u = jax.random.uniform(jax.random.fold_in(walk_key, facet), (4, *shape), jnp.float32)
        wi = scale(-1.0, travel)
        m, c = meet_facet(wi, alpha, u[0], u[1])
        wo = reflect(wi, m)
        if first == "mirror":
            level = level * fresnel.conductor(c, ior, k)
        else:
            refracted, below, exists = pass_through(wi, m, ior, height)
            reflectance = fresnel.dielectric(c, ior)
            crosses = exists & jnp.where(begins, first == "refracted", u[2] >= reflectance)
            share = reflectance if first == "reflected" else jnp.where(exists, 1.0 - reflectance, 0.0)
            level = jnp.where(begins, share, level)
            wo = select(crosses, refracted, wo)
            height = jnp.where(crosses, below, height)
            ior, beyond = jnp.where(crosses, 1.0 / ior, ior), beyond ^ crosses
        escape = escape_probability(wo, height, alpha)
        leaves = jnp.where(begins, 0.0, weight * escape)
        near = near + jnp.where(beyond, 0.0, level * leaves)
        far = far + (leaves if first == "mirror" else jnp.where(beyond, level * leaves, 0.0))
        path = -jnp.log1p(-u[3] * (1.0 - escape))  # to the next facet, given that there is one
        height = jnp.maximum(next_height(wo, height, alpha, path), 1e-6)
        return facet + 1, normalize(wo), height, weight * (1.0 - escape), level, ior, beyond, near, far

    one = jnp.ones_like(zero)
    start = (jnp.int32(0), travel, height, one, one, ior, up, zero, zero)
    end = jax.lax.while_loop(goes_on, step, start)
    near, far = (x.astype(float).mean(axis=1) for x in end[-2:])
    return near, far
