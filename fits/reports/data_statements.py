"""What measurements allow, in plain sentences: see `fits.data.checks`."""

import math
from typing import TYPE_CHECKING

import numpy as np

from fits.data.checks import (
    BRIGHTER,
    FAR,
    Agreement,
    Energy,
    Peak,
    Sides,
    energies,
    peaks,
    reciprocity,
    repeats,
    sides,
    symmetry,
)
from fits.data.totals import Totals

if TYPE_CHECKING:
    from fits.data.measurements import Measurements

FEWEST = 3
"""Readings above half of a peak's height from which its width is sampled."""

SHOWN = 6
"""Incidences whose energy is listed."""


RADIANS = 1.6
"""A little more than a right angle in radians: degrees of which no angle exceeds this may be none."""


def data_statements(data: "Measurements") -> list[str]:
    """Sentences on reciprocity, energy, symmetry, sampling and repeated readings of the used samples; before them on
    angles that look wrong. Of totals, of which no more can be said, on these alone."""
    if isinstance(data, Totals):
        return _units(data)
    return [
        *_units(data),
        *_brighter_side(sides(data)),
        _reciprocity(reciprocity(data)),
        _energy(energies(data)),
        _symmetry(symmetry(data)),
        _sampling(peaks(data)),
        _repeats(repeats(data)),
    ]


def _units(data: "Measurements") -> list[str]:
    angles = data.theta_i if isinstance(data, Totals) else np.concatenate([data.theta_i, data.theta_o])
    steepest = np.max(angles, initial=0.0)
    if not 0.0 < steepest < RADIANS:
        return []
    return [f"Angles: none is above {steepest:.4g}°: are they radians? They were read as degrees."]


def _brighter_side(found: list[Sides]) -> list[str]:
    doubt = (
        "Unless the sample sends light back, azimuths of this file count from the mirror direction, which must lie at "
        "phi_o = phi_i + 180."
    )
    if found and all(math.isnan(one.mirror) for one in found):
        return [f"Sides: all measurements in the plane of incidence lie on the light's side. {doubt}"]
    of_light = [one for one in found if one.light > BRIGHTER * max(one.mirror, 0.0)]
    of_mirror = [one for one in found if one.mirror > BRIGHTER * max(one.light, 0.0)]
    if len(of_light) <= len(of_mirror):
        return []
    worst = max(of_light, key=lambda one: one.light)
    return [
        f"Sides: the brightest side is the light's: at {worst.theta:g}° up to {worst.light:.3g} there, and "
        f"{worst.mirror:.3g} on the mirror side. {doubt}"
    ]


def _reciprocity(found: Agreement | None) -> str:
    if found is None:
        return "Reciprocity: no two readings have light and viewer the other way round, it cannot be tested."
    return (
        f"Reciprocity: in {found.count:,} pairs of readings light and viewer change places; {_apart(found)}. "
        "No reciprocal model comes closer to these than half of that."
    )


def _symmetry(found: Agreement | None) -> str:
    if found is None:
        return "Symmetry: no readings lie on both sides of the plane of incidence, it cannot be tested."
    return f"Symmetry: {found.count:,} pairs lie on either side of the plane of incidence; {_apart(found)}."


def _repeats(found: Agreement | None) -> str:
    if found is None:
        return "Repeats: no reading was taken twice; the noise has to come from the file's sigma or from the fit."
    noise = 100.0 * found.noise
    return f"Repeats: {found.count:,} readings were taken again; {_apart(found)}: a noise of about {noise:.2g} %."


def _apart(found: Agreement) -> str:
    words = f"they differ by {100.0 * found.median:.2g} % (median; 95 % of them by up to {100.0 * found.p95:.2g} %)"
    return words if math.isnan(found.z) else f"{words}, {found.z:.2g} of their standard errors"


def _energy(found: list[Energy]) -> str:
    if not found:
        return "Energy: no incidence has readings over half of the hemisphere, what is reflected in all is not known."
    parts = []
    for one in found[:SHOWN]:
        share = "/".join(f"{part:.3g}" for part in one.share)
        parts.append(f"{share} of the light at {one.theta:g}° over {100.0 * one.covered:.0f} % of it")
    more = f", and {len(found) - SHOWN} more incidences" if len(found) > SHOWN else ""
    words = f"Energy, by the projected hemisphere that is covered: {'; '.join(parts)}{more}."
    above = [one for one in found if max(one.share) > 1.0]
    if above:
        words += f" More than all of it at {', '.join(f'{one.theta:g}°' for one in above)}: the scale is wrong."
    return words


def _sampling(found: list[Peak]) -> str:
    if not found:
        return "Sampling: no scan crosses the mirror direction of its light, the peak was not seen."
    if not any(one.stands_out for one in found):
        return (
            f"Sampling: no peak stands out about the mirror direction: measurements within {FAR:g}° of it nowhere fall "
            "to half of the brightest one."
        )
    worst = min((one for one in found if one.stands_out), key=lambda one: one.count)
    words = (
        f"Sampling: the peak about the mirror direction holds {worst.count} readings above half its height at least "
        f"(at {worst.theta:g}°, in steps of {worst.step:.2g}°)"
    )
    if worst.count < FEWEST:
        return f"{words}: it may be narrower than the steps, and a roughness fitted to it is limited by them."
    return f"{words}: its width is sampled."
