"""What is asked of errors that readings share: see `fits.problem.process`."""

from dataclasses import dataclass, fields
from typing import Any

from fits.problem.parameters import Free, LogNormal
from fits.problem.process import Correlation, Process
from fits.problem.values import shown

SHORTEST_LENGTH = 1.5
"""Of a correlation, in distances of nodes."""

LEAST_LENGTH, LONGEST = 5.0, 30.0
"""Of a length whose prior is not given, in degrees."""

ANGLES = (0.1, 360.0)
AMPLITUDES = (1e-6, 1.0)


@dataclass(frozen=True)
class Correlated:
    """Errors of the model that neighbouring readings share, relative to its value.

    amplitude: their standard deviation, unitless, in [1e-6, 1]. angle, incidence, azimuth: how far they reach along
    a scan, between directions of the light, and between planes, in degrees in [0.1, 360]. channels: correlation of two
    channels, in [0, 1]. Each a number, `Free`, or None for a free one with a wide prior; those that the data cannot
    tell, of a single incidence, plane or channel, then have a fixed value.
    """

    amplitude: float | Free | None = None
    angle: float | Free | None = None
    incidence: float | Free | None = None
    azimuth: float | Free | None = None
    channels: float | Free | None = None

    def __post_init__(self) -> None:
        for entry in fields(self):
            low, high = {"amplitude": AMPLITUDES, "channels": (0.0, 1.0)}.get(entry.name, ANGLES)
            value = getattr(self, entry.name)
            if isinstance(value, Free):
                if value.shape != ():
                    raise ValueError(
                        f"Noise.correlated.{entry.name} has {value.shape[0]} channels; it must be a single number"
                    )
                ends = {f"{entry.name}.{end}": getattr(value, end) for end in ("low", "high")}
            else:
                ends = {} if value is None else {entry.name: value}
            for name, number in ends.items():
                if not (isinstance(number, int | float) and low <= number <= high):
                    raise ValueError(
                        f"Noise.correlated.{name} is {shown(number)}; it must be a number in [{low:g}, {high:g}]"
                    )


def numbers_of(given: Correlated, process: Process, channels: int) -> Correlation:
    """The numbers of a process, those that are left out filled in."""
    step = float(process.nodes[1] - process.nodes[0])
    shortest = SHORTEST_LENGTH * step
    return Correlation(
        amplitude=Free(0.1, 1e-3, 0.5, LogNormal(0.1, 0.5)) if given.amplitude is None else given.amplitude,
        angle=_length(15.0, shortest) if given.angle is None else given.angle,
        incidence=_or(given.incidence, _length(20.0, LEAST_LENGTH), process.several_incidences),
        azimuth=_or(given.azimuth, _length(20.0, LEAST_LENGTH), process.several_planes),
        channels=_or(given.channels, Free(0.8, 0.0, 0.99), channels > 1),
    )


def _length(median: float, low: float) -> Free:
    """What is alike farther than the longest is no error of a shape: it would take the place of the stack's level."""
    low = min(low, 0.5 * LONGEST)
    return Free(min(max(median, low), LONGEST), low, LONGEST, LogNormal(median, 0.4))


def _or(given: Any, free: Free, told: bool) -> Any:
    if given is not None:
        return given
    return free if told else free.start
