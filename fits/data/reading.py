"""Measurement files as users ask for them: how they are read, what is left out, and what is held out of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fits.data.formats import read
from fits.data.measurements import Measurements
from fits.data.selection import select
from fits.data.totals import Totals
from fits.names import Strata

CHANNEL = "channel="


@dataclass(frozen=True)
class Reading:
    """How a file is read; options of the command line have these names, and errors name those.

    Args:
        format, quantity, bins, strata, wavelengths, corrected: see `fits.read`.
        mask_retro: leave out readings within so many degrees of retro-reflection.
        mask_grazing: leave out readings beyond so many degrees from the normal.
        only: fit these readings alone (see `select`, and ``channel=red,green``).
        hold_out: leave these readings out, so that their prediction can be scored.
    """

    format: str | None = None
    quantity: str | None = None
    bins: int | Literal["all"] | None = None
    strata: Strata | None = None
    mask_retro: float | None = None
    mask_grazing: float | None = None
    only: tuple[str, ...] = ()
    hold_out: tuple[str, ...] = ()
    wavelengths: tuple[float, float] | None = None
    corrected: bool | None = None

    def whole(self, path: str | Path) -> Measurements:
        """All that a file holds. ValueError as `fits.read`."""
        if self.strata is not None and self.bins in (None, "all"):
            raise ValueError("--strata is given without --bins")
        return read(
            path,
            self.format,
            self.quantity,
            bins=self.bins,
            strata=self.strata or "bins",
            wavelengths=self.wavelengths,
            corrected=self.corrected,
        )

    def measurements(self, path: str | Path) -> Measurements:
        """What a file holds, with what is to be left out masked."""
        data = self.whole(path)
        if isinstance(data, Totals):
            self._refuse_angles(path)
            return data
        if self.mask_retro is not None:
            data = data.without_retro(self.mask_retro)
        if self.mask_grazing is not None:
            data = data.without_grazing(self.mask_grazing)
        return data

    def parts(self, path: str | Path) -> tuple[Measurements, Measurements | None]:
        """What of a file is fitted, and what is held out; None if nothing is."""
        data, only = of_channels(self.measurements(path), self.only)
        keep, held = np.ones(len(data), bool), np.zeros(len(data), bool)
        for words in only:
            keep &= select(data, words)
        for words in self.hold_out:
            if words.startswith(CHANNEL):
                raise ValueError(
                    f"--hold-out {words}: a fit says nothing of the colour of a channel that it has not seen; "
                    "--only channel=... fits some of the channels"
                )
            held |= select(data, words)
        fitted = data.where(keep & ~held)
        if data.mask.any() and not fitted.mask.any():
            raise ValueError("--only and --hold-out leave nothing to fit")
        for name, given in (("only", self.only), ("held out", self.hold_out)):
            fitted = fitted.noted(f"{name}: {' '.join(given)}") if given else fitted
        if not self.hold_out:
            return fitted, None
        unseen = data.where(keep & held)
        if not unseen.mask.any():
            raise ValueError("--hold-out leaves nothing to score: what it holds out is masked, or not among --only")
        return fitted, unseen

    def _refuse_angles(self, path: str | Path) -> None:
        """Totals have no direction of view, by which these would choose."""
        for name in ("mask_retro", "mask_grazing", "only", "hold_out"):
            if getattr(self, name):
                raise ValueError(f"{path}: holds totals, of which --{name.replace('_', '-')} chooses nothing")


def of_channels(data: Measurements, selections: Sequence[str]) -> tuple[Measurements, list[str]]:
    """The channels that selections ask for, and the selections that are left."""
    for words in selections:
        if words.startswith(CHANNEL):
            data = data.of_channels([name.strip() for name in words.removeprefix(CHANNEL).split(",")])
    return data, [words for words in selections if not words.startswith(CHANNEL)]
