"""How a map is fitted, and what decides a flag or a verdict: one documented number a line, all of them in the store."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from fits._files import require_switch
from fits.names import Objective
from fits.problem.instrument import Instrument
from fits.problem.parameters import Free
from fits.progress import Progress, given_progress, silent
from layerjax._checks import require_choice, require_count, require_kind, require_number

Kind = Literal["gaussian", "total_variation"]
SCALES = 1e-6, 1e6  # scales of a spatial prior, as shares of a parameter's bounds


@dataclass(frozen=True)
class SpatialPrior:
    """A prior of the differences between neighbouring texels, see `MapOptions.spatial_prior`.

    Args:
        kind: "gaussian": a difference d between neighbours adds d² / (2 scale²) to minus the log-posterior, a Gaussian
            Markov random field; changes are gradual. "total_variation": it adds abs(d) / scale, or
            d² / (2 eps scale) + eps / (2 scale) where abs(d) < eps = scale / 10; areas are even and edges stay.
        scale: of the difference between neighbours, as a share of the bounds of a parameter (of their logarithms, for
            `LogUniform` and `LogNormal`): its standard deviation, or for a total variation its mean absolute value. A
            number for all parameters, or numbers by name, such as ``{"base.albedo": 0.02}`` (of all channels); others
            are not smoothed. From 1e-6 to 1e6.
        rounds: at most so many, in each of which every texel is fitted again.

    Raises:
        ValueError: a field is not what it must be.
    """

    kind: Kind
    scale: float | Mapping[str, float]
    rounds: int = 10

    def __post_init__(self) -> None:
        require_choice("SpatialPrior.kind", self.kind, get_args(Kind))
        require_count("SpatialPrior.rounds", self.rounds, 1)
        if not isinstance(self.scale, Mapping):
            require_number("SpatialPrior.scale", self.scale, *SCALES)
        elif not self.scale:
            raise ValueError("SpatialPrior.scale is empty; it must name a parameter, or be a number")
        else:
            for name, scale in self.scale.items():
                require_number(f"SpatialPrior.scale[{name!r}]", scale, *SCALES)

    def scales(self, names: Sequence[str]) -> dict[str, float]:
        """Scales of those of these parameters that are smoothed. ValueError: a scale is of none of them."""
        if not isinstance(self.scale, Mapping):
            return dict.fromkeys(names, float(self.scale))
        whole = {name: re.sub(r"\[\d+\]$", "", name) for name in names}  # without the channel
        for name in self.scale:
            if name not in whole.values():
                known = ", ".join(dict.fromkeys(whole.values()))
                raise ValueError(f"SpatialPrior.scale names {name!r}; it must be one of {known}")
        return {name: float(self.scale[whole[name]]) for name in names if whole[name] in self.scale}


@dataclass(frozen=True)
class MapOptions:
    """Options of a map: model beyond stack and transport, computation, and thresholds of flags and verdicts."""

    scale: float | Free | None = None
    """Factor on all measurements, as in `fits.fit`."""
    objective: Objective = "likelihood"
    """Objective, as in `fits.fit`."""
    instrument: Instrument | None = None
    """Instrument, as in `fits.fit`; not allowed where texels have directions of their own."""

    starts: int = 8
    """Starts of each of the first few pilot texels."""
    seed: int = 0
    """Random seed of these starts."""
    pilot_texels: int = 64
    """Number of texels that are fitted first, from which starts, resolution and common parameters are determined."""
    chunk_size: int = 1024
    """Number of texels that are fitted and written together."""
    restarts: int = 3
    """Number of further starts for a texel whose fit is poor."""
    emulator: bool | None = None
    """Whether an emulator replaces an exact transport; with None it does where it is accurate and the map has
    `emulator_min_texels`."""
    emulator_min_texels: int = 1_000
    """Number of texels from which on an emulator is used by default."""
    emulator_max_solves: int = 30_000
    """Largest number of solutions of the transport for an emulator."""
    emulator_error: float = 0.1
    """Largest error of an emulator at new points, in standard deviations of the data."""
    spatial_prior: SpatialPrior | None = None
    """Spatial prior, applied after the fit without it (`FittedMap.smoothed`). Changing it does not repeat that fit."""
    settled: float = 0.01
    """The smoothing has settled when no texel moves farther than this in a round, in standard errors."""

    poor_probability: float = 1e-6
    """A chi-square is poor if its probability under the noise is below this, unless those of the pilot are as large."""
    pilot_quantile: float = 0.9
    """Quantile of the reduced chi-squares of the pilot that is taken as the expected one."""
    pilot_factor: float = 1.5
    """A chi-square up to this multiple of the expected one is not poor."""

    converged_share: float = 0.99
    """Smallest share of converged texels in a reliable map."""
    flagged_share: float = 0.05
    """Largest share of texels that are at a bound, poor or unidentified in a reliable map."""
    numerical_error: float = 0.1
    """Largest numerical error of the model, in standard deviations of the data, if the resolution is chosen."""
    chi_square_sigmas: float = 3.0
    """The median chi-square differs from 1 significantly if by more than this many standard deviations of a texel."""

    processes: int = 1
    """Number of processes with one thread each; 1 means threads of this process, one per core."""
    force: bool = False
    """Replace a store of other arguments."""
    progress: Progress = silent
    """Function that is called with (stage, done, all, note), or None; stages are "pilot", "map" and so on."""

    def __post_init__(self) -> None:
        for name, least in {"starts": 1, "seed": 0, "pilot_texels": 1, "chunk_size": 1, "restarts": 0, "processes": 1,
                            "emulator_min_texels": 0, "emulator_max_solves": 1}.items():  # fmt: skip
            require_count(name, getattr(self, name), least)
        for name in ("emulator_error", "settled", "pilot_factor", "numerical_error", "chi_square_sigmas"):
            require_number(name, getattr(self, name), 0.0)
        for name in ("poor_probability", "pilot_quantile", "converged_share", "flagged_share"):
            require_number(name, getattr(self, name), 0.0, 1.0)
        require_switch("emulator", self.emulator, None)
        require_switch("force", self.force)
        require_kind("spatial_prior", self.spatial_prior, SpatialPrior, None)
        object.__setattr__(self, "progress", given_progress(self.progress))

    @property
    def model(self) -> dict[str, Any]:
        """What a problem is made with, beside the stack and its transport."""
        return {"scale": self.scale, "objective": self.objective, "instrument": self.instrument}

    def numbers(self) -> dict[str, Any]:
        """Those that a store keeps: all but the model, the spatial prior and who does the work."""
        without = {*self.model, "spatial_prior", "processes", "force", "progress"}
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name not in without}


DEFAULT = MapOptions()

VERDICTS = {"converged_share", "flagged_share", "chi_square_sigmas", "settled"}
"""Options that change no number of a store: another value is not another fit."""
