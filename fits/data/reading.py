"""How measurement files are read, which of their data are used, and which are held out of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from fits.data.formats import read
from fits.data.measurements import Measurements
from fits.data.selection import select
from fits.data.totals import Totals
from fits.names import FORMATS, QUANTITIES, STRATA, Strata

CHANNEL = "channel="


@dataclass(frozen=True)
class ReadOptions:
    """How a file is read; options of the command line have these names, and errors name those.

    Args:
        format, quantity, bins, strata, wavelengths, corrected: see `fits.read`; `parse` reads them from words.
        min_retro_angle: mask measurements closer than so many degrees to retro-reflection.
        max_polar_angle: mask measurements more than so many degrees from the normal.
        select: use only these data (see `fits.data.selection.select`, and ``channel=red,green``).
        hold_out: hold these data out of the fit, so that their prediction can be scored.
    """

    format: str | None = None
    quantity: str | None = None
    bins: int | Literal["all"] | None = None
    strata: Strata | None = None
    wavelengths: tuple[float, float] | None = None
    corrected: bool | None = None
    min_retro_angle: float | None = None
    max_polar_angle: float | None = None
    select: tuple[str, ...] = ()
    hold_out: tuple[str, ...] = ()

    @classmethod
    def parse(cls, words: Sequence[str], **more: Any) -> Self:
        """Options from words such as ``format=merl`` and ``bins=5000``; more: further fields.

        Raises:
            ValueError: an unknown option, one that is given twice, or a bad value.
        """
        options: dict[str, Any] = {}
        for word in words:
            name, equals, text = word.partition("=")
            if not equals or name not in READERS:
                raise ValueError(
                    f"{word!r} is no option of reading; it must be {', '.join(f'{o}=...' for o in READERS)}"
                )
            if name in options:
                raise ValueError(f"{name} is given twice")
            options[name] = READERS[name](name, text)
        return cls(**options, **more)

    def read(self, path: str | Path) -> Measurements:
        """All that a file holds. ValueError as `fits.read`."""
        if self.strata is not None and self.bins in (None, "all"):
            raise ValueError("strata is given without a number of bins")
        named = {one.name: getattr(self, one.name) for one in fields(self)[:6]} | {"strata": self.strata or "bins"}
        return read(path, **named)

    def masked(self, path: str | Path) -> Measurements:
        """What a file holds, masked near retro-reflection and at grazing angles."""
        data = self.read(path)
        if isinstance(data, Totals):
            for name in ("min_retro_angle", "max_polar_angle", "select", "hold_out"):
                if getattr(self, name):
                    option = name.replace("_", "-")
                    raise ValueError(
                        f"{path}: holds totals, which have no outgoing direction; --{option} does not apply"
                    )
            return data
        if self.min_retro_angle is not None:
            data = data.without_retro(self.min_retro_angle)
        if self.max_polar_angle is not None:
            data = data.without_grazing(self.max_polar_angle)
        return data

    def split(self, path: str | Path) -> tuple[Measurements, Measurements | None]:
        """What of a file is fitted, and what is held out; None if nothing is."""
        data, selections = select_channels(self.masked(path), self.select)
        keep, held = np.ones(len(data), bool), np.zeros(len(data), bool)
        for words in selections:
            keep &= select(data, words)
        for words in self.hold_out:
            if words.startswith(CHANNEL):
                raise ValueError(
                    f"--hold-out {words}: the parameters of a channel cannot be predicted from others; "
                    "--select channel=... fits some of the channels"
                )
            held |= select(data, words)
        fitted = data.where(keep & ~held)
        if data.mask.any() and not fitted.mask.any():
            raise ValueError("--select and --hold-out leave nothing to fit")
        for name, given in (("selected", self.select), ("held out", self.hold_out)):
            fitted = fitted.noted(f"{name}: {' '.join(given)}") if given else fitted
        if not self.hold_out:
            return fitted, None
        held_out = data.where(keep & held)
        if not held_out.mask.any():
            raise ValueError("--hold-out leaves nothing to score: what it holds out is masked or not selected")
        return fitted, held_out


def select_channels(data: Measurements, selections: Sequence[str]) -> tuple[Measurements, list[str]]:
    """The channels that selections name, and the other selections."""
    for words in selections:
        if words.startswith(CHANNEL):
            data = data.of_channels([name.strip() for name in words.removeprefix(CHANNEL).split(",")])
    return data, [words for words in selections if not words.startswith(CHANNEL)]


def _choice(name: str, text: str) -> str:
    allowed = {"format": FORMATS, "quantity": QUANTITIES, "strata": STRATA}[name]
    if text not in allowed:
        raise ValueError(f"{name} is {text!r}; it must be one of {', '.join(allowed)}")
    return text


def _bins(name: str, text: str) -> int | str:
    if text != "all" and not (text.isdecimal() and int(text) > 0):
        raise ValueError(f"{name} is {text!r}; it must be a number of at least 1, or all")
    return text if text == "all" else int(text)


def _interval(name: str, text: str) -> tuple[float, float]:
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        low = high = float("nan")
    if not 1.0 <= low <= high < float("inf"):
        raise ValueError(f"{name} is {text!r}; it must be the lowest and the highest in nm, as in 600,620")
    return low, high


def _switch(name: str, text: str) -> bool:
    if text not in ("yes", "no"):
        raise ValueError(f"{name} is {text!r}; it must be yes or no")
    return text == "yes"


READERS = {
    "format": _choice,
    "quantity": _choice,
    "bins": _bins,
    "strata": _choice,
    "wavelengths": _interval,
    "corrected": _switch,
}
"""Options of a reader by name, and what reads their values."""
