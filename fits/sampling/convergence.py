"""When a chain ends: 50 autocorrelation times, the effective samples that are requested, and R-hat near 1.

R-hat compares draws between and within four groups of walkers, each split into halves in time: that of single walkers
exceeds 1.01 by chance alone until each has some hundred independent draws (nested R-hat: Margossian, Hoffman, Sountsov,
Riou-Durand, Vehtari & Gelman 2024). The effective sample size counts every walker as a chain, so that walkers which
each stay in a mode of their own have next to none.
"""

import math
from dataclasses import dataclass, replace

import emcee
import numpy as np

from fits.data.geometry import Floats
from fits.sampling.options import FIRST_CHECK, SamplerOptions

GROUPS = 4
FEWEST_DRAWS = 8
# steps after which a chain is looked at, however often a run resumes: 100, 200, ... 1000, then a tenth farther
CHECKS = FIRST_CHECK * np.unique(np.ceil(1.1 ** np.arange(100.0)).astype(int))


def next_check(step: int) -> int:
    """The first check after this step."""
    return int(CHECKS[step < CHECKS].min(initial=CHECKS[-1]))


@dataclass(frozen=True, eq=False)
class Convergence:
    """How far a chain of P parameters has come, by its `draws`, steps after the burn-in; autocorrelation time in steps,
    ESS, the smaller of bulk and tail, and R-hat, (P,) each."""

    draws: int
    autocorrelation_time: Floats
    ess: Floats
    r_hat: Floats

    @classmethod
    def of(cls, chain: Floats, options: SamplerOptions) -> "Convergence":
        """Convergence of a chain (steps, walkers, P), its burn-in included."""
        import arviz

        kept = after_burn_in(chain, options)
        draws, walkers, count = kept.shape
        if draws < FEWEST_DRAWS:
            return cls(draws, np.full(count, math.inf), np.zeros(count), np.full(count, math.inf))
        number = min(GROUPS, walkers)
        dealt = kept[:, : walkers - walkers % number].reshape(draws, -1, number, count)
        groups = np.moveaxis(dealt, 2, 0).reshape(number, -1, count)  # draws of each group in the order of time
        with np.errstate(invalid="ignore", divide="ignore"):  # of walkers that never moved
            times = emcee.autocorr.integrated_time(kept, tol=0)
            times = np.where(np.isfinite(times) & (times > 0.0), times, math.inf)
            ess, r_hat = np.empty(count), np.empty(count)
            for place in range(count):
                one = np.ascontiguousarray(kept[..., place].T)
                ess[place] = min(float(arviz.ess(one, method=method)) for method in ("bulk", "tail"))
                r_hat[place] = float(arviz.rhat(np.ascontiguousarray(groups[..., place])))
        same = np.ptp(kept, axis=(0, 1)) == 0.0  # next to a bound numbers may be rounded to it
        r_hat = np.where(same, 1.0, np.where(np.isfinite(r_hat), r_hat, math.inf))
        return cls(draws, times, np.where(np.isfinite(ess), ess, 0.0), r_hat)

    def is_converged(self, options: SamplerOptions) -> bool:
        """Whether the chain is long enough in autocorrelation times, and R-hat near 1."""
        long_enough = self.draws >= options.autocorrelation_times * np.max(self.autocorrelation_time)
        return bool(long_enough and np.max(self.r_hat) <= options.r_hat)

    def is_finished(self, options: SamplerOptions) -> bool:
        """Whether it is converged, and has the effective samples that are requested."""
        return self.is_converged(options) and float(np.min(self.ess)) >= options.ess

    def note(self, options: SamplerOptions) -> str:
        """What the chain has and what is requested, in words."""
        return (
            f"{np.min(self.ess):.0f} of {options.ess:g} effective samples, autocorrelation time "
            f"{np.max(self.autocorrelation_time):.0f} steps, R-hat {np.max(self.r_hat):.3f}"
        )


def after_burn_in(chain: Floats, options: SamplerOptions) -> Floats:
    """The draws of a chain (steps, walkers, P) that estimates use."""
    return chain[int(options.burn_in * len(chain)) :]


def expected_steps(chain: Floats, options: SamplerOptions) -> int | None:
    """Steps that a chain will have in the end, by what its second half gains a step; None where nothing can be said."""
    recent, step = Convergence.of(chain, replace(options, burn_in=0.5)), len(chain)
    longest, least = float(np.max(recent.autocorrelation_time)), float(np.min(recent.ess))
    if not (math.isfinite(longest) and least > 0.0):
        return None
    needed = max(options.ess / least * recent.draws, options.autocorrelation_times * longest)
    return min(next_check(max(math.ceil(needed / (1.0 - options.burn_in)) - 1, step)), options.max_steps)
