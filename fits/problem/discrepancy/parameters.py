"""The parameters of the model discrepancy, and their priors: see `fits.problem.discrepancy.process`."""

from dataclasses import dataclass, fields

from fits.problem.discrepancy.process import Process
from fits.problem.discrepancy.whitening import Correlation
from fits.problem.parameters import Free, LogNormal, Normal
from fits.problem.values import shown

LONGEST = 40.0
"""Of a length scale whose prior is not given, in degrees: what is correlated farther would take the place of the
stack's level."""

ANGLES = (0.1, 360.0)
RANGES = {"amplitude": (1e-6, 1.0), "grazing_exponent": (0.0, 2.0), "channel_correlation": (0.0, 1.0)}


@dataclass(frozen=True)
class Discrepancy:
    """Model discrepancy: a Gaussian process of the logarithm of the BSDF (Kennedy & O'Hagan 2001).

    amplitude: its standard deviation where light and viewer are along the normal, unitless, in [1e-6, 1]. length_half,
    length_difference: length scales of its Matern kernel, in degrees in [0.1, 360], in the angle of the half vector to
    the normal, and in that of light and viewer to the half vector. grazing_exponent: the standard deviation is that of
    the normal times (2 / (cos i + cos o)) to this power, in [0, 2]. channel_correlation: of two channels, in [0, 1].
    Each a number, `Free`, or None for a free one with a wide prior.
    """

    amplitude: float | Free | None = None
    length_half: float | Free | None = None
    length_difference: float | Free | None = None
    grazing_exponent: float | Free | None = None
    channel_correlation: float | Free | None = None

    def __post_init__(self) -> None:
        for entry in fields(self):
            low, high = RANGES.get(entry.name, ANGLES)
            value = getattr(self, entry.name)
            if isinstance(value, Free):
                if value.shape != ():
                    raise ValueError(
                        f"Noise.discrepancy.{entry.name} has {value.shape[0]} channels; it must be a single number"
                    )
                ends = {f"{entry.name}.{end}": getattr(value, end) for end in ("low", "high")}
            else:
                ends = {} if value is None else {entry.name: value}
            for name, number in ends.items():
                if not (isinstance(number, int | float) and low <= number <= high):
                    raise ValueError(
                        f"Noise.discrepancy.{name} is {shown(number)}; it must be a number in [{low:g}, {high:g}]"
                    )


def numbers_of(discrepancy: Discrepancy, process: Process, channels: int) -> Correlation:
    """The numbers of a process, with the default of each that is None."""
    half, difference = (_length(float(shortest)) for shortest in process.shortest)
    own = discrepancy.channel_correlation
    if own is None:
        own = Free(0.8, 0.0, 0.99) if channels > 1 else 0.0
    return Correlation(
        amplitude=Free(0.1, 1e-3, 0.5, LogNormal(0.1, 1.0)) if discrepancy.amplitude is None else discrepancy.amplitude,
        length_half=half if discrepancy.length_half is None else discrepancy.length_half,
        length_difference=difference if discrepancy.length_difference is None else discrepancy.length_difference,
        grazing_exponent=Free(0.5, *RANGES["grazing_exponent"], Normal(0.5, 0.5))
        if discrepancy.grazing_exponent is None
        else discrepancy.grazing_exponent,
        channel_correlation=own,
    )


def _length(low: float) -> Free:
    low, high = min(low, LONGEST), max(LONGEST, 1.4 * low)
    return Free(max(15.0, low), low, high, LogNormal(15.0, 0.5))
