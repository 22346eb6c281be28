"""Stacks of more than two media as an equivalent pair, for SpongeCake's multiple scattering."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax.directions import Vector
from layerjax.phase import PhaseFunction
from layerjax.stack import Medium

MOST_MEDIA = 2
"""Media that a network is trained for, as in Sec. 5."""


def pair_of(media: tuple[Medium, ...]) -> tuple[Medium, ...]:
    """Neighbours are put together until two are left, those first whose weaker one scatters least.

    The medium that scatters more keeps its phase function and f0; its thickness grows by the other's extinction along
    the normal, and its albedo becomes the mean over both.
    """
    with jax.ensure_compile_time_eval():  # numbers that are known stay known while a program is traced
        while len(media) > MOST_MEDIA:
            strengths = [float(np.mean(_scattering(medium))) for medium in media]
            at = min(range(len(media) - 1), key=lambda k: min(strengths[k], strengths[k + 1]))
            media = (*media[:at], _merge(media[at], media[at + 1]), *media[at + 2 :])
    return media


def _merge(one: Medium, other: Medium) -> Medium:
    keeper, guest = sorted((one, other), key=lambda medium: -float(np.mean(_scattering(medium))))
    depths = [jnp.asarray(medium.thickness) * _area(medium.phase) for medium in (keeper, guest)]
    albedos = [jnp.asarray(medium.albedo) * _scattered_share(medium) for medium in (keeper, guest)]
    total = depths[0] + depths[1]
    albedo = (depths[0] * albedos[0] + depths[1] * albedos[1]) / total / _scattered_share(keeper)
    albedo = jnp.where(albedo < 1.0, albedo, 1.0)
    return eqx.tree_at(lambda m: (m.thickness, m.albedo), keeper, (total / _area(keeper.phase), albedo))


def _scattering(medium: Medium) -> Array:
    return jnp.asarray(medium.thickness) * _area(medium.phase) * jnp.asarray(medium.albedo) * _scattered_share(medium)


def _scattered_share(medium: Medium) -> Array:
    """Mean of the Schlick term over isotropic pairs of directions."""
    f0 = 1.0 if medium.f0 is None else medium.f0
    return jnp.asarray(f0 + (1.0 - f0) * 2.0 / 42.0)


def _area(phase: PhaseFunction) -> Array:
    """Extinction along the normal."""
    normal: Vector = (jnp.zeros(()), jnp.zeros(()), jnp.ones(()))
    return phase.cross_section(normal)
