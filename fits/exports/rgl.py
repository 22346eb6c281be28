"""A stack as an RGL tensor file (see `fits.data.formats.rgl_table`), which Mitsuba and pbrt read.

The table holds f cos(theta_o) 4 sigma / D, for a chosen D whose lobes are those of the surfaces and flakes of the
stack, the widest one, and some between: so the quotient is smooth and finite. Nodes are at the same
half vectors for every direction of the light, so that between these the table is linear in the quotient and nothing
moves, and evenly around the normal in polar coordinates, in which the quotient is smooth there. Beyond the horizon it
has the opposite sign: f cos(theta_o) is linear where it passes through 0.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fits.data.formats._text import plural
from fits.data.formats.rgl_table import RGB, Table, from_u, look_up, table_as_bytes, unit
from fits.data.geometry import Floats
from fits.exports.contents import Contents, agreement
from fits.exports.material import VALUES, Material

DARK = 1e-3
"""Least light that directions are sampled by, relative to its median."""

WIDEST = 1.0
CROWDED = 1.6
"""Exponent by which nodes are denser towards grazing."""

GRAZING = np.radians(89.9)
"""Polar angle of the light for the last node, in place of 90 degrees."""


@dataclass(frozen=True)
class Resolution:
    """Nodes: polar angles and azimuths of the light (of half a turn), and the side of the grid of values."""

    theta_i: int
    phi_i: int
    values: int


ISOTROPIC = Resolution(theta_i=64, phi_i=1, values=96)
ANISOTROPIC = Resolution(theta_i=20, phi_i=24, values=64)
_FINE, _HALF = 1024, 256
"""Nodes over polar angles of `ndf` and `sigma`, and of `vndf`."""

WIDER = 5.0
"""Largest ratio of the widths of neighbouring lobes of D."""


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: reflection; spectral if wavelengths are given, otherwise red, green and blue."""
    if wavelengths is None and material.channels not in (1, len(RGB)):
        raise ValueError(
            f"an RGL file without wavelengths has red, green and blue, this stack has {material.channels} channels: "
            "give their wavelengths"
        )
    full = table(material, wavelengths)
    if wavelengths is None and material.channels == 1:
        full = replace(full, values=np.repeat(full.values, len(RGB), axis=2))
    sides = "isotropic" if full.isotropic else f"{len(full.phi_i)} azimuths of the light"
    grid = full.values.shape[-1]

    def look_up_bsdf(wi: Floats, wo: Floats) -> Floats:
        return look_up(full, wi, wo)[:, : material.channels] / wo[:, 2:]

    notes = (
        f"{sides}, {len(full.theta_i)} polar angles, grids of {grid} x {grid}, {plural(material.channels, 'channel')}",
        agreement(material, look_up_bsdf),
        *([] if material.opaque else ["transmission is omitted: the format holds reflection only"]),
        *(["one channel, written as grey"] if full.values.shape[2] != material.channels else []),
    )
    return Contents(table_as_bytes(full), notes)


def table(material: Material, wavelengths: Floats | None = None, resolution: Resolution | None = None) -> Table:
    """The table of a stack's reflection.

    wavelengths: (C,) nm, ascending, of its channels; None: red, green and blue, or one grey.
    """
    chosen = resolution or (ISOTROPIC if material.isotropic else ANISOTROPIC)
    theta_i = GRAZING * (1.0 - np.linspace(1.0, 0.0, chosen.theta_i) ** CROWDED)
    if material.isotropic:
        phi_i = np.zeros(1)
    elif material.turns_by_half:
        phi_i = np.linspace(-np.pi, 0.0, chosen.phi_i + 1)
    else:
        phi_i = np.linspace(-np.pi, np.pi, 2 * chosen.phi_i + 1)
    lobes = _lobes(material.widths)
    fine = from_u(np.linspace(0.0, 1.0, _FINE))
    ndf = np.mean([density(fine, alpha) for alpha in lobes], axis=0)
    sigma = np.mean([area(fine, alpha) for alpha in lobes], axis=0)
    u = np.linspace(0.0, 1.0, _HALF)
    warp = np.broadcast_to(u * crowding(from_u(u), lobes), (len(phi_i), len(theta_i), 2, _HALF))
    shape = (len(phi_i), len(theta_i), material.channels, chosen.values, chosen.values)
    empty = Table(
        theta_i,
        phi_i,
        np.broadcast_to(ndf, (2, _FINE)),
        np.broadcast_to(sigma, (2, _FINE)),
        warp,
        np.ones((*shape[:2], *shape[3:])),
        np.empty(shape),
        wavelengths,
        material.name,
    )
    return _filled(material, empty, lobes)


def _lobes(widths: tuple[float, ...]) -> list[float]:
    """Roughness of the lobes of D: those of the stack, the widest, and some between where ratios are large."""
    lobes: list[float] = []
    for alpha, wider in pairwise((*(width for width in widths if width < WIDEST), WIDEST)):
        steps = int(np.ceil(np.log(wider / alpha) / np.log(WIDER)))
        lobes += list(np.geomspace(alpha, wider, steps + 1)[:-1])
    return [*lobes, WIDEST]


def crowding(theta: Floats, lobes: list[float]) -> Floats:
    """Density of nodes along polar angles, up to a factor: half of them even, half around narrower lobes."""
    narrow = [alpha / (alpha**2 + theta**2) for alpha in lobes[:-1]]
    return np.full_like(theta, 1.0) if not narrow else 1.0 + np.mean(narrow, axis=0)


def density(theta: Floats, alpha: float) -> Floats:
    """GGX (Walter et al. 2007, Eq. 33), 1/sr."""
    cosine, sine = np.cos(theta), np.sin(theta)
    return alpha**2 / (np.pi * (alpha**2 * cosine**2 + sine**2) ** 2)


def area(theta: Floats, alpha: float) -> Floats:
    """Projected area of visible facets of GGX."""
    cosine = np.cos(theta)
    return 0.5 * (cosine + np.sqrt(cosine**2 + alpha**2 * np.sin(theta) ** 2))


def _filled(material: Material, empty: Table, lobes: list[float]) -> Table:
    """The table with its values, and a luminance that samples directions as light is scattered."""
    values = np.empty((len(empty.phi_i) * len(empty.theta_i), *empty.values.shape[2:]))
    luminance = np.empty((len(values), *values.shape[2:]))
    for place in range(len(values)):
        material.progress(VALUES, place, len(values))
        phi_i, theta_i, theta_m, phi_m = (one[0] for one in empty.nodes(slice(place, place + 1)))
        wi, half = unit(theta_i, phi_i), unit(theta_m, phi_m + phi_i if empty.isotropic else phi_m)
        facing = half @ wi
        wo = 2.0 * facing[..., None] * half - wi
        cosine = wo[..., 2].copy()
        wo[..., 2] = np.abs(cosine)
        factor = empty.factor(
            theta_m.ravel(), phi_m.ravel(), np.full(facing.size, theta_i), np.full(facing.size, phi_i)
        )
        bsdf = material.values(np.broadcast_to(wi, (facing.size, 3)), wo.reshape(-1, 3))
        scaled = bsdf * (cosine.ravel() / factor)[:, None]
        values[place] = np.moveaxis(scaled.reshape(*facing.shape, -1), -1, 0)
        # so that half vectors sampled by it, and by the warp, lead where the light is scattered
        light = np.maximum(scaled.mean(axis=1) * factor, 0.0).reshape(facing.shape)
        light = np.maximum(light, DARK * np.median(light) or 1.0) * np.maximum(facing, DARK)
        luminance[place] = light * np.sin(theta_m) / crowding(theta_m, lobes)
    shape = (len(empty.phi_i), len(empty.theta_i))
    return Table(
        **{name: getattr(empty, name) for name in ("theta_i", "phi_i", "ndf", "sigma", "vndf")},
        luminance=luminance.reshape(*shape, *luminance.shape[1:]),
        values=values.reshape(*shape, *values.shape[1:]),
        wavelengths=empty.wavelengths,
        description=empty.description,
    )
