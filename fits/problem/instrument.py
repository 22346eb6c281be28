"""What stands between a BSDF and its readings: apertures, a sample that leans, gains, a floor.

A reading is the mean of the BSDF over the cones of source and detector, weighted by the cosines of both. For small
cones that takes four pairs of directions: on rings that have the second moments of the discs, the detector's a quarter
of a turn behind the source's. Second derivatives by either direction, and by both in functions of the half vector or
in the plane of incidence of what is its own mirror image, are exact then.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.data.geometry import AT_NORMAL, LIGHT_AZIMUTH, polar
from fits.data.scans import SAME_ANGLE
from fits.problem.narrowness import needs_cone
from fits.problem.parameters import Free, LogNormal
from fits.problem.values import shown
from layerjax.transport.known_directions import KnownDirections, known_directions

Floats = NDArray[np.float64]

WIDEST, LEANS_MOST, GAIN_SPREADS = 30.0, 10.0, (1e-4, 1.0)
"""Degrees of a cone, degrees that a sample may lean, and relative standard deviations of gains."""

GAINS_END = 6.0
"""Standard deviations of their logarithm at which gains are bounded."""

POINTS = 4
"""Pairs of directions that stand for cones."""


@dataclass(frozen=True)
class Instrument:
    """An instrument by which readings were taken. Angles in degrees.

    source, detector: full angles of the cones, in [0, 30]; a reading is the mean over them, which costs four times as
    much where a lobe may be narrow, and nothing elsewhere.
    offset: how far the sample's normal leans towards the mirror side of the plane of incidence, in [-10, 10]; a number,
    `Free`, or None for 0.
    gain_per_incidence: relative standard deviation, in [1e-4, 1], of a factor of its own that every polar angle of the
    light has, at all azimuths, beside the common scale, with a log-normal prior about 1 that they share; None: none.
    floor: of the noise, in 1/sr: as `Noise.floor`, in whose place it stands.
    """

    source: float = 0.0
    detector: float = 0.0
    offset: float | Free | None = None
    gain_per_incidence: float | None = None
    floor: float | Free | None = None

    def __post_init__(self) -> None:
        for name in ("source", "detector"):
            _require(name, getattr(self, name), 0.0, WIDEST)
        if isinstance(self.offset, Free):
            if self.offset.shape != ():
                raise ValueError("Instrument.offset has channels; it must be a single number")
            for end in ("low", "high"):
                _require(f"offset.{end}", getattr(self.offset, end), -LEANS_MOST, LEANS_MOST)
        elif self.offset is not None:
            _require("offset", self.offset, -LEANS_MOST, LEANS_MOST)
        if self.gain_per_incidence is not None:
            _require("gain_per_incidence", self.gain_per_incidence, *GAIN_SPREADS)

    @property
    def has_cones(self) -> bool:
        """Whether there is anything to take the mean over."""
        return self.source > 0.0 or self.detector > 0.0


class Setting(NamedTuple):
    """The numbers of an instrument that may be free: offset in degrees, gains (K,); None where there are none."""

    offset: Any
    gains: Any


class Optics(eqx.Module):
    """Pairs of directions that stand for N readings: K of them, each a share of a reading.

    wi, wo: (K, 3). row: (K,), the reading; share: (K,), of it; None where each is one of its own. forward: (K, 2), the
    horizontal unit vector towards the mirror side; None where it is known how the sample leans. incidence: (N,), whose
    gain it has; None where there are none.
    """

    wi: Array
    wo: Array
    row: Array | None
    share: Array | None
    forward: Array | None
    incidence: Array | None
    known: KnownDirections | None

    def seen(self, values: Any, setting: Setting, count: int) -> Array:
        """Readings (N, C), where values(wi, wo, known) is the BSDF (K, C)."""
        wi, wo = self.wi, self.wo
        if self.forward is not None:
            wi, wo = (_leaning(w, self.forward, setting.offset) for w in (wi, wo))
        found = values(wi, wo, self.known)
        if self.row is not None:
            assert self.share is not None
            found = jnp.zeros((count, found.shape[-1]), found.dtype).at[self.row].add(found * self.share[:, None])
        if self.incidence is not None:
            gains = jnp.concatenate([setting.gains, jnp.ones(1)])  # the last: of an incidence that was not fitted
            found = found * gains[self.incidence][:, None]
        return found


def setting_of(instrument: Instrument, incidences: Floats) -> Setting:
    """Its free numbers and those that are known, for readings with these K polar angles of the light."""
    gains = None
    if instrument.gain_per_incidence is not None:
        spread = instrument.gain_per_incidence
        ends = math.exp(-GAINS_END * spread), math.exp(GAINS_END * spread)
        gains = Free((1.0,) * len(incidences), *ends, LogNormal(1.0, spread))
    return Setting(instrument.offset if isinstance(instrument.offset, Free) else None, gains)


def optics_of(instrument: Instrument, stack: Any, wi: Floats, wo: Floats, incidences: Floats, follow: bool) -> Optics:
    """What stands for readings along these directions, (N, 3) each, of a stack, `Free` or not.

    incidences: polar angles of the light, (K,), that have a gain. follow: known directions are of use.
    """
    gain = None if instrument.gain_per_incidence is None else _which(wi, incidences)
    free, lean = isinstance(instrument.offset, Free), 0.0
    forward = _forward(wi) if instrument.offset else None
    if isinstance(instrument.offset, Free):
        lean = float(np.max(np.abs(instrument.offset.arrays()[1:])))
    elif forward is not None:
        wi, wo = (np.asarray(_leaning(w, forward, instrument.offset), float) for w in (wi, wo))
        forward = None
    row = share = None
    pairs, widths = (wi, wo), (instrument.source, instrument.detector)
    if instrument.has_cones and (narrow := needs_cone(*widths, stack, wi, wo, lean)).any():
        pairs, row, share = _cones(instrument, wi, wo, narrow)
        forward = None if forward is None else forward[row]  # a sample leans one way, whichever ray of a cone it meets
    return Optics(
        wi=jnp.asarray(pairs[0]),
        wo=jnp.asarray(pairs[1]),
        row=None if row is None else jnp.asarray(row),
        share=None if share is None else jnp.asarray(share),
        forward=None if forward is None else jnp.asarray(forward),
        incidence=None if gain is None else jnp.asarray(gain),
        known=known_directions(*pairs) if follow and not free else None,
    )


def gain_unknown(instrument: Instrument | None, wi: Floats, incidences: Floats) -> Floats:
    """Relative standard deviation, (M, 1), of the gain of light along wi (M, 3), beside incidences that have one."""
    if instrument is None or instrument.gain_per_incidence is None:
        return np.zeros((len(wi), 1))
    return np.where(_which(wi, incidences) == len(incidences), instrument.gain_per_incidence, 0.0)[:, None]


def _which(wi: Floats, incidences: Floats) -> NDArray[np.int64]:
    """Place (M,) among polar angles of the light, (K,), that wi (M, 3) has; K if it is at none of them."""
    apart = np.abs(polar(wi)[:, None] - incidences)
    return np.where(apart.min(axis=1) <= SAME_ANGLE, apart.argmin(axis=1), len(incidences))


def _cones(
    instrument: Instrument, wi: Floats, wo: Floats, narrow: NDArray[np.bool_]
) -> tuple[tuple[Floats, Floats], NDArray[np.int64], Floats]:
    """Pairs (K, 3) each, the rows they belong to, (K,), and their shares, (K,)."""
    parts = []
    turns = 0.5 * np.pi * np.arange(POINTS)
    for w, width, late in ((wi, instrument.source, 0.0), (wo, instrument.detector, 0.5 * np.pi)):
        ring = math.radians(0.5 * width) / math.sqrt(2.0)
        first, second = _across(w[narrow])
        side = np.cos(turns + late)[:, None, None] * first + np.sin(turns + late)[:, None, None] * second
        parts.append(math.cos(ring) * w[narrow] + math.sin(ring) * side)
    # light that would come or go below the horizon is not there
    cosines = [np.maximum(w[..., 2] * np.sign(v[narrow][:, 2]), 0.0) for w, v in zip(parts, (wi, wo), strict=True)]
    share = cosines[0] * cosines[1] / (POINTS * np.abs(wi[narrow][:, 2] * wo[narrow][:, 2]))
    parts = [np.where(share[..., None] > 0.0, w, v[narrow]) for w, v in zip(parts, (wi, wo), strict=True)]
    rows = np.flatnonzero(narrow)
    wide = np.flatnonzero(~narrow)
    pairs = tuple(np.concatenate([v[wide], w.reshape(-1, 3)]) for w, v in zip(parts, (wi, wo), strict=True))
    row = np.concatenate([wide, np.tile(rows, POINTS)])
    return (pairs[0], pairs[1]), row, np.concatenate([np.ones(len(wide)), share.ravel()])


def _across(w: Floats) -> tuple[Floats, Floats]:
    """Unit vectors across w (M, 3): in its plane with the normal, and along the horizon; both turn with the azimuth."""
    forward = _horizontal(w)
    along = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(w))], axis=-1)
    return np.cross(along, w), along


def _horizontal(w: Floats) -> Floats:
    """Unit vectors (M, 2) of azimuths; along x at the normal."""
    length = np.hypot(w[:, 0], w[:, 1])[:, None]
    away = length > np.sin(np.radians(AT_NORMAL))
    return np.where(away, w[:, :2] / np.where(away, length, 1.0), [1.0, 0.0])


def _forward(wi: Floats) -> Floats:
    """Towards the mirror side of light along wi (M, 3), horizontal, (M, 2); at the normal light comes as files say."""
    away = np.hypot(wi[:, 0], wi[:, 1])[:, None] > np.sin(np.radians(AT_NORMAL))
    turn = math.radians(LIGHT_AZIMUTH)
    return -np.where(away, _horizontal(wi), [math.cos(turn), math.sin(turn)])


def _leaning(w: Any, forward: Any, offset: Any) -> Array:
    """Directions (K, 3) as a sample sees them whose normal leans forward by so many degrees."""
    angle = jnp.radians(offset)
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    along = jnp.sum(w[:, :2] * forward, axis=-1)
    turned = along * cosine - w[:, 2] * sine
    flat = w[:, :2] + (turned - along)[:, None] * forward
    return jnp.concatenate([flat, (along * sine + w[:, 2] * cosine)[:, None]], axis=-1)


def _require(name: str, value: Any, low: float, high: float) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and low <= value <= high):
        raise ValueError(f"Instrument.{name} is {shown(value)}; it must be a number in [{low:g}, {high:g}]")
