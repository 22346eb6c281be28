"""How a map is fitted."""

from dataclasses import dataclass
from typing import Any

from fits.maps.smoothing import Smoothness, whole

USUAL_CHUNK = 1024
"""Texels of a chunk; programs of smaller maps are for so many as well, and thus the same."""


@dataclass(frozen=True)
class Settings:
    """How a map is fitted.

    Args:
        starts, seed: of each of the first few fits of the sample.
        sample: texels of it.
        chunk: texels that are fitted and written together.
        tabulate: whether an exact transport is replaced by a table over the box of the parameters, made once; None: for
            maps of 1,000 texels or more, where a table of it holds within a tenth of the noise.
        posterior: texels whose posteriors are sampled as well, see `FittedMap.posterior`: they tell how far standard
            errors hold.
        smooth: holds neighbouring texels together, beside the plain fit and after it, see `FittedMap.smoothed`; another
            one smooths anew, and fits nothing again.

    Raises:
        ValueError: a number that is not whole, or below what it must be.
    """

    starts: int = 8
    seed: int = 0
    sample: int = 64
    chunk: int = USUAL_CHUNK
    tabulate: bool | None = None
    posterior: int = 0
    smooth: Smoothness | None = None

    def __post_init__(self) -> None:
        for name, least in {"starts": 1, "seed": 0, "sample": 1, "chunk": 1, "posterior": 0}.items():
            object.__setattr__(self, name, whole(name, getattr(self, name), least))
        if not isinstance(self.smooth, Smoothness | None):
            raise ValueError(f"smooth is {self.smooth!r}; it must be a fits.Smoothness, or None")

    def told(self) -> dict[str, Any]:
        """What the fits of the texels depend on."""
        return {name: getattr(self, name) for name in ("starts", "seed", "sample", "chunk", "tabulate")}
