"""A stack as a MERL table (see `fits.data.formats.merl`), which Falcor, ALTA and BRDF Explorer read."""

import numpy as np

from fits.data.formats.merl import CHANNELS, CONVENTION, SCALE, SHAPE, centre, corners_around, half_difference, index_of
from fits.data.geometry import Floats
from fits.exports.contents import Contents, agreement
from fits.exports.material import VALUES, Material

LIFTED = np.sin(np.radians(0.5))
"""Cosine that directions below the horizon are raised to, in bins that extend across it."""

WIDE = np.sin(np.radians(2.5))
"""Bins whose centre is further below the horizon than this do not extend above it."""

UNMEASURED = -1.0
SLABS = 10


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: reflection above the surface, in red, green and blue."""
    if not material.isotropic:
        raise ValueError("a MERL table is of isotropic materials: axes are the normal, and facets have one width")
    if material.channels not in (1, len(CHANNELS)):
        raise ValueError(f"a MERL table has red, green and blue, this stack has {material.channels} channels")
    table = np.full((len(CHANNELS), *SHAPE), UNMEASURED)
    for slab, index in enumerate(np.array_split(np.arange(np.prod(SHAPE)), SLABS)):
        material.progress(VALUES, slab, SLABS)
        wi, wo = centre(np.stack(np.unravel_index(index, SHAPE), axis=-1))
        reached = np.minimum(wi[:, 2], wo[:, 2]) > -WIDE
        values = material.values(_lifted(wi[reached]), _lifted(wo[reached]))
        table.reshape(len(CHANNELS), -1)[:, index[reached]] = values.T / SCALE[:, None]

    def look_up(wi: Floats, wo: Floats) -> Floats:
        corners, weights = corners_around(index_of(*half_difference(wi, wo)))
        return (weights * table[:, corners[..., 0], corners[..., 1], corners[..., 2]]).sum(axis=1).T * SCALE

    notes = [CONVENTION, agreement(material, look_up)]
    if material.channels == 1:
        notes.append("one channel, written as grey")
    if not material.opaque:
        notes.append("transmission is omitted: the format holds reflection only")
    return Contents(np.array(SHAPE, "<i4").tobytes() + table.astype("<f8").tobytes(), tuple(notes))


def _lifted(w: Floats) -> Floats:
    """Unit vectors raised to `LIFTED` where they are lower."""
    lifted = np.where(w[:, 2] < LIFTED, LIFTED, w[:, 2])
    length = np.sqrt((1.0 - lifted**2) / np.maximum(1.0 - w[:, 2] ** 2, 1e-12))
    return np.where((w[:, 2] < LIFTED)[:, None], np.stack([w[:, 0] * length, w[:, 1] * length, lifted], axis=-1), w)
