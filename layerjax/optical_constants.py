"""Refractive indices by wavelength: metals by name from published tables, glasses and lacquers by dispersion formulas.

Plain functions to numbers, which go into `Conductor`, `Interface` and `ThinFilm`: one value a channel.
"""

import csv
from functools import cache
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from numpy.typing import NDArray

from layerjax import tables
from layerjax._checks import abbreviate
from layerjax._parameters import as_floating

RGB_NM = (610.0, 550.0, 465.0)
"""Wavelengths that stand for red, green and blue."""


def metal(name: str, wavelengths_nm: ArrayLike | Literal["rgb"]) -> tuple[NDArray, NDArray]:
    """Complex index n + i k of a metal in air, linear between the wavelengths of a published table.

    Args:
        name: ``"aluminium"``, ``"chromium"``, ``"copper"``, ``"gold"``, ``"iron"``, ``"nickel"``, ``"silver"``,
            ``"titanium"`` or ``"tungsten"``. The sources stand at the head of ``layerjax/tables/metals.csv``.
        wavelengths_nm: of each channel, in nm, shape (C,), within the table (250 to 1,930 has all metals); or
            ``"rgb"``: 610, 550 and 465.

    Returns:
        n and k, each (C,).

    Raises:
        ValueError: no such metal; or a wavelength that its table does not reach.

    Example:
        >>> import layerjax as lj
        >>> ior, k = lj.metal("gold", "rgb")
        >>> base = lj.Conductor(ior, k, alpha=0.2)
        >>> ior.shape
        (3,)
    """
    table = _metals()
    if not isinstance(name, str) or name not in table:
        raise ValueError(f"metal: the name {abbreviate(name)} is not one of {', '.join(table)}")
    known, n, k = table[name]
    if isinstance(wavelengths_nm, str) and wavelengths_nm != "rgb":
        raise ValueError(f'wavelengths_nm: {wavelengths_nm!r} is neither numbers nor "rgb"')
    given = RGB_NM if isinstance(wavelengths_nm, str) else as_floating("wavelengths_nm", wavelengths_nm)
    wanted = np.atleast_1d(np.asarray(given, float))
    if not np.all((wanted >= known[0]) & (wanted <= known[-1])):
        outside = wanted[(wanted < known[0]) | (wanted > known[-1]) | np.isnan(wanted)][0]
        raise ValueError(
            f"wavelengths_nm: {outside:g} is outside the table of {name}, {known[0]:.1f} to {known[-1]:.1f} nm"
        )
    return np.interp(wanted, known, n), np.interp(wanted, known, k)


def cauchy(wavelengths_nm: ArrayLike, a: ArrayLike, b: ArrayLike, c: ArrayLike = 0.0) -> Array:
    """Index a + b / x^2 + c / x^4 with x the wavelength in micrometres (Cauchy 1830): lacquers, polymers, glasses.

    Args:
        wavelengths_nm: in nm, shape (C,).
        a: index at long wavelengths.
        b: in square micrometres, some 0.003 to 0.02.
        c: in micrometres to the fourth.

    Example:
        >>> import layerjax as lj
        >>> acrylic = lj.cauchy([610.0, 550.0, 465.0], 1.4787, 0.00455)  # n_D 1.492, Abbe number 57
        >>> [f"{n:.3f}" for n in acrylic.tolist()]
        ['1.491', '1.494', '1.500']
    """
    square = (as_floating("wavelengths_nm", wavelengths_nm) * 1e-3) ** 2
    return as_floating("a", a) + as_floating("b", b) / square + as_floating("c", c) / (square * square)


def sellmeier(wavelengths_nm: ArrayLike, b: ArrayLike, c: ArrayLike) -> Array:
    """Index of a glass: n^2 - 1 = sum of b x^2 / (x^2 - c), x the wavelength in micrometres (Sellmeier 1871).

    Args:
        wavelengths_nm: in nm, shape (C,).
        b, c: coefficients of the terms, shape (T,); c in square micrometres. Of glasses the makers' sheets have them.

    Example:
        >>> import layerjax as lj
        >>> b, c = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
        >>> round(float(lj.sellmeier([587.56], b, c)[0]), 4)  # N-BK7 (Schott)
        1.5168
    """
    square = (as_floating("wavelengths_nm", wavelengths_nm)[..., None] * 1e-3) ** 2
    return jnp.sqrt(1.0 + jnp.sum(as_floating("b", b) * square / (square - as_floating("c", c)), axis=-1))


@cache
def _metals() -> dict[str, tuple[NDArray, NDArray, NDArray]]:
    """Wavelengths, n and k of each."""
    with Path(tables.__file__).with_name("metals.csv").open(newline="") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))[1:]
    names = sorted({name for name, *_ in rows})
    columns = {name: np.array([row[1:] for row in rows if row[0] == name], float).T for name in names}
    return {name: (wavelengths, n, k) for name, (wavelengths, n, k) in columns.items()}
