"""How measurement files are read, which of their data are used, and which are held out of a fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from fits._files import given_path
from fits.data.formats import FileOptions, read_file
from fits.data.measurements import Measurements
from fits.data.scans import select
from fits.data.totals import Totals
from layerjax._checks import require_number

CHANNELS = "channels="
READERS = ("format", "quantity", "bins", "strata", "wavelengths", "corrected")
"""Options of a reader that words of the command line may give."""


def read(path: str | Path, format: str | None = None, quantity: str | None = None, **options: Any) -> Measurements:
    """Read a measurement file: CSV, MERL, RGL, Zemax, LightTools, Speos, WINDOW XML, FRED, ASTM, pab, ALTA, SSDD, iad.

    Args:
        path: the file.
        format: format of the file; None: recognised by the content.
        quantity: quantity of its values; None: as the file states.
        options: further fields of `fits.ReadOptions`, such as ``bins=5000`` or ``max_polar_angle=80``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file and, where there is one, line, column, value and allowed range.
        TypeError: an unknown option.
    """
    return ReadOptions(format, quantity, **options).read(path)


@dataclass(frozen=True, eq=False)
class ReadOptions(FileOptions):
    """Options of `fits.read`, `fits.fit_files` and the command line for reading files.

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
        seed: random seed of the choice.
        wavelengths, corrected: for iad's files only: see `read_slab`.
        min_retro_angle: mask measurements closer than so many degrees to retro-reflection.
        max_polar_angle: mask measurements more than so many degrees from the normal.
        select: use only these data (see `fits.data.scans.select`, and ``channels=red,green``).
        hold_out: hold these data out of the fit, so that their prediction can be scored.
    """

    min_retro_angle: float | None = None
    max_polar_angle: float | None = None
    select: Sequence[str] = ()
    hold_out: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, high in (("min_retro_angle", 180.0), ("max_polar_angle", 90.0)):
            if (angle := getattr(self, name)) is not None:
                require_number(name, angle, 0.0, high)
        for name in ("select", "hold_out"):
            if not isinstance(words := getattr(self, name), list | tuple):
                raise ValueError(f"{name} is {words!r:.60}, must be a list of selections, such as ['incidence=10,50']")

    @classmethod
    def parse(cls, words: Sequence[str], **more: Any) -> Self:
        """Options from words such as ``format=merl`` and ``bins=5000``; more: further fields.

        Raises:
            ValueError: an unknown option, or one that is given twice.
        """
        options: dict[str, Any] = {}
        for word in words:
            name, equals, text = word.partition("=")
            if not equals or name not in READERS:
                allowed = ", ".join(f"{one}=..." for one in READERS)
                raise ValueError(f"{word!r} is no option of a reader; it must be {allowed}")
            if name in options:
                raise ValueError(f"{name} is given twice")
            options[name] = _value(text)
        return cls(**options, **more)

    def read(self, path: str | Path) -> Measurements:
        """What a file holds, masked and selected. ValueError as `fits.read`, and for data that are to be held out."""
        if self.hold_out:
            raise ValueError("hold_out: it is for a fit and a score; `fits.Measurements.drop` omits data")
        return self.split(path)[0]

    def split(self, path: str | Path) -> tuple[Measurements, Measurements | None]:
        """What of a file is fitted, and what is held out; None if nothing is. ValueError as `fits.read`."""
        path = given_path("path", path)
        data = read_file(path, self)
        if isinstance(data, Totals):
            for name in ("min_retro_angle", "max_polar_angle", "select", "hold_out"):
                if getattr(self, name):
                    words = f"which have no outgoing direction; --{name.replace('_', '-')} does not apply"
                    raise ValueError(f"{path}: holds totals, {words}")
            return data, None
        data = self.masked(data)
        keep, held = np.ones(len(data), bool), np.zeros(len(data), bool)
        keep = np.all([keep, *(select(data, words) for words in self.select if not words.startswith(CHANNELS))], axis=0)
        held = np.any([held, *(select(data, words) for words in self.hold_out)], axis=0)
        fitted = data.where(keep & ~held)
        if data.mask.any() and not fitted.mask.any():
            raise ValueError(f"{path}: --select and --hold-out leave nothing to fit")
        for name, given in (("selected", self.select), ("held out", self.hold_out)):
            fitted = fitted.noted(f"{name}: {' '.join(given)}") if given else fitted
        if not self.hold_out:
            return fitted, None
        held_out = data.where(keep & held)
        if not held_out.mask.any():
            raise ValueError("--hold-out leaves nothing to score: what it holds out is masked or not selected")
        return fitted, held_out

    def masked(self, data: Measurements) -> Measurements:
        """The channels that are used, masked near retro-reflection and at grazing angles."""
        if (least := self.min_retro_angle) is not None:
            apart = np.degrees(2.0 * np.arcsin(np.clip(np.linalg.norm(data.wi - data.wo, axis=-1) / 2.0, 0.0, 1.0)))
            data = data.where(apart >= least, f"masked: within {least:g} degrees of retro-reflection")
        if (most := self.max_polar_angle) is not None:  # of light and viewer, from the normal line
            tilt = np.max([np.minimum(angle, 180.0 - angle) for angle in (data.theta_i, data.theta_o)], axis=0)
            data = data.where(tilt <= most, f"masked: more than {most:g} degrees from the normal")
        if any(words.startswith(CHANNELS) for words in self.hold_out):
            raise ValueError("--hold-out channels: the parameters of a channel cannot be predicted from others")
        for words in self.select:
            if words.startswith(CHANNELS):
                data = data.of_channels([name.strip() for name in words.removeprefix(CHANNELS).split(",")])
        return data


def _value(text: str) -> Any:
    """A switch, a whole number, numbers, or the word itself, which the reader then judges."""
    if text in ("yes", "no"):
        return text == "yes"
    try:
        return int(text) if "," not in text else tuple(map(float, text.split(",")))
    except ValueError:
        return text
