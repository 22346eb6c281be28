"""How measurement files are read, which of their data are used, and which are held out of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, Self

import numpy as np

from fits._files import given_path
from fits.data.formats import FileOptions, read_file
from fits.data.measurements import Measurements
from fits.data.selection import select
from fits.data.totals import Totals
from fits.names import FORMATS, QUANTITIES, STRATA

CHANNEL = "channel="


def read(path: str | Path, format: str | None = None, quantity: str | None = None, **options: Any) -> Measurements:
    """Read a measurement file: CSV, MERL, RGL, Zemax, LightTools, Speos, WINDOW XML, FRED, ASTM, pab, ALTA, SSDD, iad.

    Args:
        path: the file.
        format, quantity: what it is, and what its numbers are; None finds out from the content.
        options: further fields of `fits.ReadOptions`, such as ``bins=5000`` or ``max_polar_angle=80``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file and, where there is one, line, column, value and allowed range.
        TypeError: an option that is none.
    """
    return ReadOptions(format, quantity, **options).read(path)


@dataclass(frozen=True, eq=False)
class ReadOptions(FileOptions):
    """How files are read, of `fits.read`, `fits.fit_files` and the command line, whose options have these names.

    Args:
        format: "csv", "totals" (a CSV with shares of light, which gives `Totals`), "rxt" (the totals of a slab, see
            `read_slab`), "merl", "rgl", "zemax", "lighttools", "klems" and "tensortree" (both are XML of WINDOW and
            Radiance), "fred", "astm" (E1392), "pab", "alta", "speos" or "ssdd"; None finds out from the content.
        quantity: what the numbers in the file are: "brdf", f in 1/sr; "brdf_cos", f |cos theta_o|; or
            "reflectance_factor", pi f. A CSV says so in its column names, and then this picks among them; Zemax,
            LightTools, FRED and ASTM files hold "brdf" unless this says otherwise; ALTA files that do not say what they
            hold need it; all others say it themselves.
        geometry: for MERL and RGL only, the directions to look up; None: of MERL the default `slices`, of RGL the
            directions at which the file has values.
        lookup: for MERL only, "centre" or "linear": see `fits.data.formats.merl.read`.
        bins: for MERL and RGL only: so many bins, or nodes, from all over the table, at most 100,000, or "all".
        strata: for MERL only, what each of these bins stands for an equal share of: "bins" of the table, or "flux",
            the projected solid angle of light and viewer.
        seed: of their choice.
        wavelengths, corrected: for iad's files only: see `read_slab`.
        min_retro_angle: mask measurements closer than so many degrees to retro-reflection.
        max_polar_angle: mask measurements more than so many degrees from the normal.
        select: use only these data (see `fits.data.selection.select`, and ``channel=red,green``).
        hold_out: hold these data out of the fit, so that their prediction can be scored.
    """

    min_retro_angle: float | None = None
    max_polar_angle: float | None = None
    select: Sequence[str] = ()
    hold_out: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, high in (("min_retro_angle", 180.0), ("max_polar_angle", 90.0)):
            if not (
                (angle := getattr(self, name)) is None or (isinstance(angle, Real) and 0.0 <= float(angle) <= high)
            ):
                raise ValueError(f"{name} is {angle!r:.60}, must be in [0, {high:g}] degrees")
        for name in ("select", "hold_out"):
            if not isinstance(words := getattr(self, name), list | tuple):
                raise ValueError(f"{name} is {words!r:.60}, must be a list of selections, such as ['incidence=10,50']")

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
                    f"{word!r} is no option of a reader; it must be {', '.join(f'{o}=...' for o in READERS)}"
                )
            if name in options:
                raise ValueError(f"{name} is given twice")
            options[name] = READERS[name](name, text)
        return cls(**options, **more)

    def read(self, path: str | Path) -> Measurements:
        """What a file holds, masked and selected. ValueError as `fits.read`, and for data that are to be held out."""
        if self.hold_out:
            raise ValueError("hold_out: it is for a fit and a score; `fits.Measurements.drop` omits data")
        return self.split(path)[0]

    def split(self, path: str | Path) -> tuple[Measurements, Measurements | None]:
        """What of a file is fitted, and what is held out; None if nothing is. ValueError as `fits.read`."""
        data = self._masked(given_path("path", path))
        if isinstance(data, Totals):
            return data, None
        kept = [select(data, words) for words in self.select if not words.startswith(CHANNEL)]
        keep = np.all(kept, axis=0) if kept else np.ones(len(data), bool)
        held = np.any([select(data, words) for words in self.hold_out], axis=0) if self.hold_out else ~keep & False
        fitted = data.where(keep & ~held)
        if data.mask.any() and not fitted.mask.any():
            what = "--select and --hold-out leave nothing to fit" if self.hold_out else "--select leaves nothing"
            raise ValueError(f"{path}: {what}")
        for name, given in (("selected", self.select), ("held out", self.hold_out)):
            fitted = fitted.noted(f"{name}: {' '.join(given)}") if given else fitted
        if not self.hold_out:
            return fitted, None
        held_out = data.where(keep & held)
        if not held_out.mask.any():
            raise ValueError("--hold-out leaves nothing to score: what it holds out is masked or not selected")
        return fitted, held_out

    def _masked(self, path: Path) -> Measurements:
        """The channels that are used, masked near retro-reflection and at grazing angles."""
        data = read_file(path, self)
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
        for words in self.hold_out:
            if words.startswith(CHANNEL):
                raise ValueError(
                    f"--hold-out {words}: the parameters of a channel cannot be predicted from others; "
                    "--select channel=... fits some of the channels"
                )
        for words in self.select:
            if words.startswith(CHANNEL):
                data = data.of_channels([name.strip() for name in words.removeprefix(CHANNEL).split(",")])
        return data


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
