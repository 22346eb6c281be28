"""Measurements from RGL's measured materials (see `rgl_table`): at the nodes of their grids, or along slices.

The database was measured at the nodes. A file holds f cos(theta_o); near the horizon the
quotient is of two small numbers, and it is skipped there.
"""

from pathlib import Path
from typing import Literal

import numpy as np

from fits.data.formats import merl_bins
from fits.data.formats._tensor_file import MAGIC
from fits.data.formats._text import plural
from fits.data.formats.rgl_table import Table, look_up, read_table, unit
from fits.data.geometry import LIGHT_AZIMUTH, Floats, Geometry
from fits.data.measurements import Measurements, Source

MOST = 20_000
"""Measurements that are read of twice as many nodes or more, by default."""

LOWEST = 0.01
"""Least cosine of the viewer of measurements that are read."""


def recognises(head: bytes) -> bool:
    """Whether a file starts as one of tensors."""
    return head.startswith(MAGIC)


def read(
    path: Path, geometry: Geometry | None = None, bins: int | Literal["all"] | None = None, seed: int = 0
) -> Measurements:
    """Read such a file; of an isotropic material the light stands at azimuth 180 degrees.

    geometry: directions above the surface, to look up as renderers do; None: the nodes of the file themselves.
    bins: so many nodes from all over the file, at most 100,000, or "all"; None: all, or 20,000 of 40,000 and more.
    seed: of a choice.
    """
    if bins is not None:
        merl_bins.check(bins, "bins", seed)
        if geometry is not None:
            raise ValueError("bins stands beside geometry: whole nodes are read")
    if geometry is not None and (np.minimum(geometry.wi[:, 2], geometry.wo[:, 2]) <= 0).any():
        raise ValueError("geometry holds directions at or below the horizon, an RGL file has only reflection above it")
    table = read_table(path)
    kind = f"{'isotropic' if table.isotropic else 'anisotropic'}: {table.description}"
    if geometry is None:
        wi, wo, values, note = _at_nodes(path, table, bins, seed)
    else:
        wi, wo = geometry.wi, geometry.wo
        values = look_up(table, wi, wo) / wo[:, 2:]
        note = "linear between the nodes of the file, as renderers look it up"
    used = (wo[:, 2] >= LOWEST) & (wi[:, 2] > 0)
    source = Source(str(path), "rgl", "brdf_cos", (" ".join(kind.split()), note))
    return Measurements(wi, wo, values, None, used, table.channels, source)


def _at_nodes(
    path: Path, table: Table, bins: int | Literal["all"] | None, seed: int
) -> tuple[Floats, Floats, Floats, str]:
    """wi and wo (N, 3), BSDF (N, C), and a note."""
    phi_i, theta_i, theta_m, phi_m = table.nodes()
    turn = 0.0
    if table.isotropic:
        turn = np.radians(LIGHT_AZIMUTH)
        phi_i = np.full_like(phi_i, turn)
    wi, half = unit(theta_i, phi_i)[:, None, None], unit(theta_m, phi_m + turn)
    facing = np.sum(wi * half, axis=-1)
    wo = 2.0 * facing[..., None] * half - wi
    readable = (wo[..., 2] >= LOWEST) & (wi[..., 2] > 0) & (facing > 0)
    readable[:, 1:, 0] = False  # the normal, whatever the azimuth
    readable[:, -1] &= abs(phi_m[:, -1] - phi_m[:, 0] - 2.0 * np.pi) > 1e-9  # the azimuth of the first row again
    if not readable.any():
        raise ValueError(f"{path}: no node has light and viewer above the horizon")
    count = int(readable.sum())
    if bins == "all" or (bins is None and count < 2 * MOST):
        place = np.argwhere(readable)
        note = f"measurements at all {plural(count, 'node')} above the horizon"
    else:
        wanted = MOST if bins is None else bins
        place, _ = merl_bins.choice(readable, np.ones(readable.shape), wanted, "bins", seed)
        note = f"measurements at {wanted:,} of {count:,} nodes above the horizon, from all over the file (seed {seed})"
    light, row, column = place.T
    values = table.values.reshape(len(wi), *table.values.shape[2:])[light, :, row, column]
    at = (light, row, column)
    phi_of_light = np.zeros(len(light)) if table.isotropic else phi_i[light]
    factor = table.factor(theta_m[at], phi_m[at], theta_i[light], phi_of_light)
    wo = wo[at]
    wo /= np.linalg.norm(wo, axis=-1, keepdims=True)
    return wi[light, 0, 0], wo, values * (factor / wo[:, 2])[:, None], note
