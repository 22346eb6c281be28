"""What is said of a posterior with several modes, and of standard errors where a fit has several minima."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior

SURE = 1.01
"""R-hat above which walkers do not all tell the same yet."""


def errors_of_one(fit: "Fit") -> list[str]:
    """What standard errors are worth where several minima explain the data; nothing, where one does."""
    count = len(fit.alternatives)
    if not count:
        return []
    others = "Another local minimum" if count == 1 else f"{count} other local minima"
    return [
        f"{others} of the same model {'fits' if count == 1 else 'fit'} equally well: standard errors are those of the "
        "best one alone, and sampling covers all."
    ]


def modes(posterior: "Posterior") -> list[str]:
    """Which modes the posterior has, and whether their shares are known; nothing, where one is known."""
    if not posterior.modes:
        return []
    where = []
    for mode in posterior.modes:
        at = ", ".join(f"{name} {value:.4g}" for name, value in mode.values.items())
        where.append(f"{100.0 * mode.share:.2g} ± {100.0 * mode.error:.1g} % at {at}")
    sentences = [
        f"The posterior has {len(posterior.modes)} modes: {'; '.join(where)}. Estimates are of all of them together."
    ]
    if np.max(posterior.r_hat) > SURE:
        sentences.append(f"R-hat is above {SURE:g}: walkers differ in how long they stay at each mode.")
    return sentences
