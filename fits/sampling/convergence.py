"""How long a chain must be: 50 autocorrelation times, and the effective samples that are requested.

Autocorrelation is that within walkers: those that each stay in a mode of their own look as good as any. So R-hat, which
compares what is between them with what is within (Vehtari, Gelman, Simpson, Carpenter & Buerkner 2021), has to be near
1 as well; of a few chains that are 50 autocorrelation times long it is up to 1.04 by chance.

Looked at after whole checks only, which come at the same steps however often a run resumes.
"""

import math
import time

import emcee
import numpy as np
from numpy.typing import NDArray

from fits.progress import in_words
from fits.sampling.chain import MemoryChain

FIRST_CHECK = 100
LONG_ENOUGH = 50.0
MIXED = 1.05
BURN_IN = 10
FEWEST_STEPS = 4
PATIENCE = 10.0  # seconds between two looks at a chain that grows slowly

Floats = NDArray[np.float64]


def next_check(step: int) -> int:
    """Checks come after 100, 200, ... steps, later a tenth further each."""
    check = FIRST_CHECK
    while check <= step:
        check += _interval(check)
    return check


def last_checks(step: int) -> tuple[int, int]:
    """The last check up to this step, and the one before; 0 for none."""
    before, check, following = 0, 0, FIRST_CHECK
    while following <= step:
        before, check, following = check, following, following + _interval(following)
    return before, check


def _interval(check: int) -> int:
    return FIRST_CHECK * max(1, round(check / BURN_IN / FIRST_CHECK))


def autocorrelation_times(chain: MemoryChain, steps: int) -> Floats:
    """Of each parameter, (P,), in steps, of the first `steps` of a chain without their first tenth."""
    kept = chain.chain[steps // BURN_IN : steps]
    with np.errstate(invalid="ignore"):  # a single step has no variance to divide by
        times = emcee.autocorr.integrated_time(kept, tol=0)
    return np.where(np.isfinite(times) & (times > 0.0), times, math.inf)  # 0 of the first few steps


def r_hat(chain: Floats) -> Floats:
    """Rank-normalised split R-hat of each parameter, (P,), of walkers (steps, walkers, P) without their first tenth."""
    import arviz

    kept = chain[len(chain) // BURN_IN :]
    if len(kept) < FEWEST_STEPS:
        return np.full(chain.shape[-1], math.inf)
    with np.errstate(invalid="ignore", divide="ignore"):  # walkers that never moved
        found = np.array([float(arviz.rhat(kept[..., place].T)) for place in range(chain.shape[-1])])
    same = np.ptp(kept, axis=(0, 1)) == 0.0  # next to a bound numbers may be rounded to it
    return np.where(same, 1.0, np.where(np.isfinite(found), found, math.inf))


def long_enough(chain: MemoryChain, ess: float | None = None) -> bool:
    """Whether a chain, up to its last check, has 50 autocorrelation times, `ess` effective samples, and an R-hat near
    1."""
    before, check = last_checks(chain.iteration)
    if not before:  # of the first 100 steps nothing is said
        return False
    longest = np.max(autocorrelation_times(chain, check))
    kept = check - check // BURN_IN
    enough = kept > LONG_ENOUGH * longest and kept >= _asked_for(chain, ess) * longest
    return bool(enough and np.max(r_hat(chain.chain[:check])) < MIXED)


def finished(chain: MemoryChain, max_steps: int, ess: float | None) -> bool:
    """Whether sampling ends here."""
    if chain.iteration:
        return chain.iteration >= max_steps or (
            chain.iteration in last_checks(chain.iteration) and long_enough(chain, ess)
        )
    return False


def _asked_for(chain: MemoryChain, ess: float | None) -> float:
    """Effective samples that are asked for, of each walker."""
    return (ess or 0.0) / chain.shape[0]


class Outlook:
    """How far a chain is from its end, in words, and how long that takes at the pace since the last look."""

    def __init__(self, chain: MemoryChain, max_steps: int, ess: float | None):
        self.chain, self.max_steps, self.ess = chain, max_steps, ess
        self._seen, self._at = chain.iteration, time.monotonic()

    @property
    def overdue(self) -> bool:
        """Whether the last look was long ago."""
        return time.monotonic() - self._at > PATIENCE

    def note(self) -> str:
        """What is there, what is needed, and the time left."""
        step, now = self.chain.iteration, time.monotonic()
        pace, self._seen, self._at = (now - self._at) / max(step - self._seen, 1), step, now
        longest = float(np.max(autocorrelation_times(self.chain, step)))
        effective = (step - step // BURN_IN) * self.chain.shape[0] / longest
        wanted = "" if self.ess is None else f" of {self.ess:g}"
        words = f"autocorrelation time {longest:.0f}, {effective:.0f}{wanted} effective samples"
        needed = max(LONG_ENOUGH, _asked_for(self.chain, self.ess)) * longest * BURN_IN / (BURN_IN - 1)
        if not math.isfinite(needed):
            return words
        words += f", needs {needed:.0f} steps"
        if finished(self.chain, self.max_steps, self.ess):
            return words
        # where it is long enough already it waits for the next check
        left = min(max(needed, next_check(step)), self.max_steps) - step
        return f"{words}, about {in_words(pace * left)} left"
