"""What stands between a BSDF and its measurements: apertures, a tilted sample, gains, a floor.

A measurement is the mean of the BSDF over the cones of source and detector, weighted by the cosines of both. How many
pairs of directions that takes follows from how wide the cones are beside the lobes of the stack: see `apertures`.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.data.geometry import AT_NORMAL, LIGHT_AZIMUTH, Floats, polar
from fits.data.scans import SAME_ANGLE
from fits.problem.apertures import MOST_OF_TWO, MOST_RINGS, rays, ring_counts
from fits.problem.noise import require_floor
from fits.problem.parameters import Free, LogNormal, require_number_or_free
from layerjax._checks import require_count, require_number
from layerjax.transport.known_directions import KnownDirections, known_directions

WIDEST, MOST_TILT = 30.0, 10.0  # degrees of a cone, and of a sample's tilt
GAIN_SPREADS, GAINS_END = (1e-4, 1.0), 6.0  # relative standard deviations of gains; so many of them bound a gain


@dataclass(frozen=True)
class Instrument:
    """How an instrument maps the BSDF to measurements. Angles are in degrees.

    Args:
        source_aperture: full angle of the cone of the source, in [0, 30]; a measurement is the mean over the cones.
        detector_aperture: full angle of the cone of the detector, in [0, 30].
        tilt: tilt of the sample's normal towards the mirror side of the plane of incidence, in [-10, 10], or `Free`;
            None is 0.
        gain_sd: relative standard deviation, in [1e-4, 1], of one factor per polar angle of the light, with a
            log-normal prior about 1; None is no such factor.
        floor: noise floor in 1/sr, in place of `Noise.floor`.
        rings: largest number of rings of rays for a cone, in [1, 8]. n rings have an error below a thousandth of the
            peak where the cones together are as wide as 0.64 n - 0.25 lobes at half maximum (with two cones a sixth
            less, and at most 4 rings). None: as many as the narrowest lobe within the bounds, or that of the fit,
            needs.
    """

    source_aperture: float = 0.0
    detector_aperture: float = 0.0
    tilt: float | Free | None = None
    gain_sd: float | None = None
    floor: float | Free | None = None
    rings: int | None = None

    def __post_init__(self) -> None:
        require_number("Instrument.source_aperture", self.source_aperture, 0.0, WIDEST)
        require_number("Instrument.detector_aperture", self.detector_aperture, 0.0, WIDEST)
        if self.tilt is not None:
            require_number_or_free("Instrument.tilt", self.tilt, -MOST_TILT, MOST_TILT)
        if self.gain_sd is not None:
            require_number("Instrument.gain_sd", self.gain_sd, *GAIN_SPREADS)
        require_floor("Instrument.floor", self.floor)
        if self.rings is not None:
            require_count("Instrument.rings", self.rings, 1, MOST_RINGS)


class Setting(NamedTuple):
    """The numbers of an instrument that may be free: tilt in degrees, gains (K,); None where there are none."""

    tilt: Any
    gains: Any


class Optics(eqx.Module):
    """K pairs of directions, each a share of one of N measurements.

    wi, wo: (K, 3). row: (K,), the measurement; share: (K,), of it; None where each is one of its own. forward: (K, 2),
    the horizontal unit vector towards the mirror side; None where the tilt is known. incidence: (N,), whose gain a
    measurement has; None without gains.
    """

    wi: Array
    wo: Array
    row: Array | None
    share: Array | None
    forward: Array | None
    incidence: Array | None
    known: KnownDirections | None

    def measured(self, values: Any, setting: Setting, count: int) -> Array:
        """Measurements (N, C), where values(wi, wo, known) is the BSDF (K, C)."""
        wi, wo = self.wi, self.wo
        if self.forward is not None:
            wi, wo = (_tilted(w, self.forward, setting.tilt) for w in (wi, wo))
        found = values(wi, wo, self.known)
        if self.row is not None:
            assert self.share is not None
            found = jnp.zeros((count, found.shape[-1]), found.dtype).at[self.row].add(found * self.share[:, None])
        if self.incidence is not None:
            gains = jnp.concatenate([setting.gains, jnp.ones(1)])  # the last: of an incidence that was not fitted
            found = found * gains[self.incidence][:, None]
        return found


def setting_of(instrument: Instrument, incidences: Floats) -> Setting:
    """Its free numbers and those that are known, for measurements with these K polar angles of the light."""
    gains = None
    if instrument.gain_sd is not None:
        spread = instrument.gain_sd
        ends = math.exp(-GAINS_END * spread), math.exp(GAINS_END * spread)
        gains = Free((1.0,) * len(incidences), *ends, LogNormal(1.0, spread))
    return Setting(instrument.tilt if isinstance(instrument.tilt, Free) else None, gains)


def optics_of(
    instrument: Instrument, stack: Any, wi: Floats, wo: Floats, incidences: Floats, follow: bool, other: bool = False
) -> Optics:
    """What stands for measurements along these directions, (N, 3) each, of a stack, `Free` or not.

    incidences: polar angles of the light, (K,), that have a gain. follow: known directions are of use. other: with a
    ring more or less for each cone: the difference tells the error.
    """
    incidence = None if instrument.gain_sd is None else _which(wi, incidences)
    tilt = instrument.tilt
    forward = _forward(wi) if isinstance(tilt, Free) else None
    if forward is None and tilt:  # it is known: directions are turned once
        wi, wo = (np.asarray(_tilted(w, _forward(wi), tilt), float) for w in (wi, wo))
    most = float(np.max(np.abs(tilt.arrays()[1:]))) if isinstance(tilt, Free) else 0.0
    pairs, row, share = (wi, wo), None, None
    widths = instrument.source_aperture, instrument.detector_aperture
    counts = ring_counts(*widths, stack, wi, wo, most, instrument.rings) if any(widths) else np.zeros(len(wi), int)
    if counts.any():
        if other:
            finest = MOST_OF_TWO if all(widths) else MOST_RINGS
            counts = np.where(counts == finest, finest - 1, counts + (counts > 0))
        pairs, row, share = _cones(widths, wi, wo, counts)
        if forward is not None:
            forward = forward[row]  # the sample is tilted one way, whichever ray of a cone it meets
    known = known_directions(*pairs) if follow and forward is None else None
    arrays: tuple[Any, Any, Any, Any, Any, Any] = jax.tree.map(jnp.asarray, (*pairs, row, share, forward, incidence))
    return Optics(*arrays, known)


def gain_unknown(instrument: Instrument | None, wi: Floats, incidences: Floats) -> Floats:
    """Relative standard deviation, (M, 1), of the gain of light along wi (M, 3), beside incidences that have one."""
    if instrument is None or instrument.gain_sd is None:
        return np.zeros((len(wi), 1))
    return np.where(_which(wi, incidences) == len(incidences), instrument.gain_sd, 0.0)[:, None]


def _which(wi: Floats, incidences: Floats) -> NDArray[np.int64]:
    """Place (M,) among polar angles of the light, (K,), that wi (M, 3) has; K if it is at none of them."""
    apart = np.abs(polar(wi)[:, None] - incidences)
    return np.where(apart.min(axis=1) <= SAME_ANGLE, apart.argmin(axis=1), len(incidences))


def _cones(
    widths: tuple[float, float], wi: Floats, wo: Floats, counts: NDArray[np.int64]
) -> tuple[tuple[Floats, Floats], NDArray[np.int64], Floats]:
    """Pairs (K, 3) each, the rows that they belong to and their shares, (K,), by so many rings a measurement, (N,)."""
    alone = np.flatnonzero(counts == 0)
    lights, views, row, share = [wi[alone]], [wo[alone]], [alone], [np.ones(len(alone))]
    for rings in np.unique(counts[counts > 0]):
        rows = np.flatnonzero(counts == rings)
        discs = rays(int(rings), *(width > 0.0 for width in widths))
        weights, parts = discs.weights[:, None], []
        for w, width, disc in zip((wi[rows], wo[rows]), widths, discs[:2], strict=True):
            # places on the unit disc become directions (K, M, 3) of the cone about w, areas solid angles
            square = np.sum(disc**2, axis=-1)
            cosine = 1.0 - (1.0 - math.cos(math.radians(0.5 * width))) * square
            sine = np.sqrt((1.0 - cosine) * (1.0 + cosine))
            across = disc * (sine / np.where(square > 0.0, np.sqrt(square), 1.0))[:, None]
            # unit vectors across w, along the horizon and in its plane with the normal: both turn with the azimuth
            forward = _horizontal(w)
            along = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(w))], axis=-1)
            sideways = across[:, :1, None] * np.cross(along, w) + across[:, 1:, None] * along
            parts.append(cosine[:, None, None] * w + sideways)
            # light that would come or go below the horizon is not there
            weights = weights * np.maximum(parts[-1][..., 2] * np.sign(w[:, 2]), 0.0) / np.abs(w[:, 2])
        for found, part, w in ((lights, parts[0], wi[rows]), (views, parts[1], wo[rows])):
            found.append(np.where(weights[..., None] > 0.0, part, w).reshape(-1, 3))
        row.append(np.tile(rows, len(weights)))
        share.append(weights.ravel())
    return (np.concatenate(lights), np.concatenate(views)), np.concatenate(row), np.concatenate(share)


def _horizontal(w: Floats, normal: float = 0.0) -> Floats:
    """Unit vectors (M, 2) of azimuths; normal: the azimuth at the normal, in degrees."""
    length, turn = np.hypot(w[:, 0], w[:, 1])[:, None], math.radians(normal)
    away = length > np.sin(np.radians(AT_NORMAL))
    return np.where(away, w[:, :2] / np.where(away, length, 1.0), [math.cos(turn), math.sin(turn)])


def _forward(wi: Floats) -> Floats:
    """Towards the mirror side of light along wi (M, 3), horizontal, (M, 2); at the normal light comes as files say."""
    return -_horizontal(wi, LIGHT_AZIMUTH)


def _tilted(w: Any, forward: Any, offset: Any) -> Array:
    """Directions (K, 3) in the frame of a sample whose normal is tilted forward by so many degrees."""
    angle = jnp.radians(offset)
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    along = jnp.sum(w[:, :2] * forward, axis=-1)
    turned = along * cosine - w[:, 2] * sine
    flat = w[:, :2] + (turned - along)[:, None] * forward
    return jnp.concatenate([flat, (along * sine + w[:, 2] * cosine)[:, None]], axis=-1)
