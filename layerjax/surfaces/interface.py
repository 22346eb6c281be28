"""Rough dielectric interfaces of microfacets: single scattering, separable Smith masking (Walter et al. 2007).

Plain functions of directions, seen from either side by turning z round; an `Interface` is a layer of a stack, and no
surface by itself.
"""

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import safe_div
from layerjax.channels import Channels, mean
from layerjax.directions import Vector, add, combine, dot, half_vector, normalize, reflect, refract, scale, select
from layerjax.normals import facets
from layerjax.normals.facets import Distribution
from layerjax.normals.widths import StudentWidth, Width, Widths
from layerjax.surfaces.microfacet import mirror_lobe, visibility
from layerjax.surfaces.thin_film import BARE, Films

MATCHED = 64.0
"""Times the rounding of a ratio of indices: its difference from 1 up to which light passes unrefracted."""


def interface_reflection(wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution = "ggx") -> Array:
    """BRDF of a rough dielectric interface, 1/sr, without the cosine (Walter 2007, Eq. 20).

    Args:
        wi, wo: unit directions on the +z side.
        ior: index on the far side over index on the side of wi, > 0.
        alpha, distribution: of the normals.
    """
    (value,) = reflected_channels(wi, wo, ior, alpha, distribution, BARE)
    return value


def reflected_channels(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution, films: Films
) -> Channels:
    """`interface_reflection` under films, as seen from the side of wi."""
    h, cosine = half_vector(wi, wo, same_side=True)
    lobe = mirror_lobe(h, wi, wo, alpha, distribution)
    return tuple(fresnel.dielectric(cosine, ior, film=film) * lobe for film in films)


def interface_transmission(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution = "ggx"
) -> Array:
    """BTDF of a rough dielectric interface, 1/sr, without the cosine (Walter 2007, Eq. 21, with its eta_o^2).

    Radiance is carried: f / ior_o^2 is symmetric, and the integral of f |cos_o| over wo is the energy that passes.

    Args:
        wi: unit directions on the +z side.
        wo: unit directions on the -z side.
        ior: index on the far side over index on the side of wi, > 0. At 1 the BTDF is a delta, and 0 is returned.
        alpha, distribution: of the normals.
    """
    (value,) = transmitted_channels(wi, wo, ior, alpha, distribution, BARE)
    return value


def transmitted_channels(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution, films: Films
) -> Channels:
    """`interface_transmission` through films, as seen from the side of wi."""
    values, height = continued_transmission(wi, wo, ior, alpha, distribution, films)
    return tuple(jnp.where(height > 0, value, 0.0) for value in values)


def continued_transmission(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution, films: Films = BARE
) -> tuple[Channels, Array]:
    """`interface_transmission` with facets that face down as well, and their height: see `continued_lobe`."""
    lobe, transmitted, height = continued_lobe(wi, wo, ior, alpha, distribution, films)
    visible = 4.0 * visibility(wi[2], wi, -wo[2], wo, alpha, distribution) * lobe
    return tuple(visible * share for share in transmitted), height


def refraction_lobe(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution = "ggx", films: Films = BARE
) -> tuple[Array, Channels]:
    """Facets that refract wi to wo: D <wi, m> <wo, m> ior^2 / (<wi, m> + ior <wo, m>)^2, and their transmittance 1 - F.

    The first is 0 where no facet whose normal lies on the +z side does; wo.z < 0 is not checked.
    """
    lobe, transmitted, height = continued_lobe(wi, wo, ior, alpha, distribution, films)
    return jnp.where(height > 0, lobe, 0.0), transmitted


def continued_lobe(
    wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution, films: Films = BARE
) -> tuple[Array, Channels, Array]:
    """`refraction_lobe` with facets that face down as well, D being even; and z of wi + ior wo, signed as the normal's.

    Where z passes through 0, at facets that stand upright, the lobe itself ends with a step.
    """
    v = combine(1.0, wi, ior, wo)  # along the facet normal; its length cancels from the result
    total = add(wi, wo)
    squared = dot(total, total)
    step = ior - 1.0
    # (wi.v, wo.v) as sums that keep their digits where wo is near -wi
    towards_i, towards_o = 0.5 * ior * squared - step, 0.5 * squared + step
    exists = (towards_i * towards_o < 0) & ~is_index_matched(ior)
    a = jnp.where(exists, jnp.abs(towards_i), 1.0)
    b = jnp.where(exists, jnp.abs(towards_o), 1.0)
    x, y, z = jnp.where(exists, v[0], 0.0), jnp.where(exists, v[1], 0.0), jnp.where(exists, v[2], 1.0)
    # 1 - F with both cosines known: no difference, and no angle of total reflection
    cosines = a, b
    if films[0] is not None:
        unit = 1.0 / jnp.sqrt(x * x + y * y + z * z)
        cosines = unit * a, unit * b
    transmitted = tuple(fresnel.dielectric_transmittance(cosines[0], ior, cosines[1], film) for film in films)
    if distribution == "ggx" and not isinstance(alpha, Widths | StudentWidth):
        q = x * x + y * y + (alpha * z) ** 2
        lobe = (ior * alpha * a / q) * (ior * alpha * b / q) / jnp.pi
    else:
        inverse = 1.0 / jnp.sqrt(x * x + y * y + z * z)
        gain = (ior * a * inverse) * inverse * (ior * b * inverse) * inverse
        lobe = facets.density((x * inverse, y * inverse, jnp.abs(z) * inverse), alpha, distribution) * gain
    return jnp.where(exists, lobe, 0.0), transmitted, jnp.where(towards_i > 0, v[2], -v[2])


def is_index_matched(ior: Array) -> Array:
    """Whether the indices are so nearly equal that light passes unrefracted, and the BTDF is a delta."""
    return jnp.abs(ior - 1.0) <= MATCHED * jnp.finfo(jnp.result_type(ior)).eps


def interface_sample(
    wi: Vector, ior: Array, alpha: Width, u1: Array, u2: Array, u3: Array, distribution: Distribution = "ggx"
) -> tuple[Vector, Array]:
    """Direction that a facet seen from wi reflects or refracts to, chosen by its Fresnel reflectance.

    Returns the direction and whether it leaves on the side that its kind allows (reflection: above); one that does not
    is masked light, and is lost. For the density of those that do see `interface_pdf`.
    """
    wo, leaves, _, _ = interface_event(wi, ior, alpha, u1, u2, u3, distribution)
    return wo, leaves


def interface_event(
    wi: Vector,
    ior: Array,
    alpha: Width,
    u1: Array,
    u2: Array,
    u3: Array,
    distribution: Distribution,
    films: Films = BARE,
) -> tuple[Vector, Array, Vector, Channels]:
    """`interface_sample`, with the normal of the facet, and `event_weights`; chosen by the mean of the channels."""
    m = facets.sample(wi, alpha, u1, u2, distribution)
    refracted, exists = refract(wi, m, ior)
    cosine = dot(wi, m)
    levels = tuple(fresnel.dielectric(cosine, ior, film=film) for film in films)
    reflects = (u3 < mean(levels)) | ~exists
    wo = select(reflects, reflect(wi, m), refracted)
    return wo, (wo[2] > 0) == reflects, m, event_weights(levels, reflects)


def event_weights(levels: Channels, reflects: Array) -> Channels:
    """What a draw by the mean of the channels' reflectances weighs: the share of each over its probability; of one
    reflectance for all nothing, which stands for 1."""
    if len(levels) == 1:
        return ()
    chosen = mean(levels)
    reflected = (safe_div(level, chosen) for level in levels)
    passed = (safe_div(1.0 - level, 1.0 - chosen) for level in levels)
    return tuple(jnp.where(reflects, one, other) for one, other in zip(reflected, passed, strict=True))


def interface_pdf(
    f: Array, wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution = "ggx"
) -> Array:
    """Density of `interface_sample`, 1/sr, from the BSDF f of the pair: f |cos_o| / G1(wo), less what draws weigh."""
    density = 0.5 * f * facets.twice_projected_area(jnp.abs(wo[2]), wo, alpha, distribution)
    if distribution != "vmf":
        return density
    assert not isinstance(alpha, Widths | StudentWidth)
    return density / facets.draw_weight(wi, facet_normal(wi, wo, ior), alpha)


def facet_normal(wi: Vector, wo: Vector, ior: Array) -> Vector:
    """Normal of the facet that reflects (wo above) or refracts wi to wo, on the +z side."""
    total = combine(1.0, wi, jnp.where(wo[2] > 0, 1.0, ior), wo)
    return normalize(scale(jnp.where(total[2] < 0, -1.0, 1.0), total))
