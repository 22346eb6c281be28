"""Ranks of truths among posterior draws: whether they are uniform, in numbers and as a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

import fits
from fits.reports.plots.data import CYCLE, INK, STYLE

DRAWS = 99
"""Posterior draws a repeat: ranks go from 0 to 99, and bins of them are equally wide."""

BINS = (20, 10, 5, 4, 2)
EXPECTED = 5
"""Repeats in a bin from which the chi-square distribution holds: fewer repeats have fewer bins."""

LEVELS = (0.68, 0.9)
"""Of central intervals of posteriors: whole numbers of ranks."""

LEAST_P = 0.01
INTERVAL = 0.99
"""Probability that a bar of uniform ranks lies in the interval of the picture."""

COLUMNS = 4
"""Panels of the picture in a row, at most."""

Ranks = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """Uniformity of the ranks of one parameter: the statistic and p-value of a chi-square test over `bins`, and that of
    Kolmogorov and Smirnov; the mean rank in standard errors from where it should be; and how many truths the central
    intervals cover, see `LEVELS`."""

    parameter: str
    bins: int
    chi_square: float
    p_chi_square: float
    p_kolmogorov_smirnov: float
    mean_off: float
    covered: tuple[int, ...]
    uniform: bool


def spread_draws(posterior: fits.Posterior) -> tuple[Floats, float]:
    """`DRAWS` draws (DRAWS, P), and the thinning of a walker in units of the longest autocorrelation time.

    They are spread evenly over the chain after its burn-in, each of another walker than the last.
    """
    chain = posterior.chain[posterior.burn_in :]
    steps, walkers, _ = chain.shape
    chosen = np.linspace(0, steps - 1, DRAWS).round().astype(int)
    thinning = (steps - 1) / (DRAWS - 1) * walkers
    return chain[chosen, np.arange(DRAWS) % walkers], float(thinning / np.max(posterior.autocorrelation_time))


def ranks_of(truth: Floats, draws: Floats) -> list[int]:
    """How many draws (DRAWS, P) lie below the truth (P,), for each parameter."""
    return [int(below) for below in np.sum(draws < truth, axis=0)]


def judged(parameter: str, ranks: Ranks) -> Row:
    """Whether ranks (repeats,) are uniform: neither test has a p-value below `LEAST_P`."""
    counts = _counts(ranks)
    chi_square, p = stats.chisquare(counts)
    share = (ranks + 0.5) / (DRAWS + 1)
    p_ks = stats.kstest(share, "uniform").pvalue
    off = (np.mean(share) - 0.5) * np.sqrt(12.0 * len(ranks))
    covered = tuple(int(np.sum(np.abs(share - 0.5) < 0.5 * level)) for level in LEVELS)
    uniform = min(p, p_ks) > LEAST_P
    return Row(parameter, len(counts), float(chi_square), float(p), float(p_ks), float(off), covered, bool(uniform))


def expected(repeats: int, level: float) -> tuple[float, float]:
    """How many truths a central interval should cover: the central 95 % of the binomial distribution."""
    low, high = stats.binom.interval(0.95, repeats, level)
    return float(low), float(high)


def picture(ranks: Mapping[str, Ranks]) -> Figure:
    """A histogram of ranks for each parameter by its label, with the 99 % interval of the bars of uniform ranks."""
    with mpl.rc_context(STYLE):
        columns = min(COLUMNS, len(ranks))
        rows = -(-len(ranks) // columns)
        figure = Figure(figsize=(2.6 * columns, 2.5 * rows), layout="constrained")
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
        for panel in panels[len(ranks) :]:
            panel.remove()
        for panel, (label, chosen) in zip(panels, ranks.items(), strict=False):
            counts = _counts(chosen)
            edges = np.linspace(0, DRAWS + 1, len(counts) + 1)
            low, high = stats.binom.interval(INTERVAL, len(chosen), 1 / len(counts))
            panel.stairs(counts, edges, fill=True, color=CYCLE[0], alpha=0.75)
            for level in (low, high):
                panel.axhline(level, color=INK, linewidth=0.8, linestyle="dashed")
            panel.axhline(len(chosen) / len(counts), color=INK, linewidth=0.8)
            panel.grid(visible=False)
            panel.set(title=label, xlim=(0, DRAWS + 1), ylim=(0, None))
        figure.supxlabel(f"rank of the truth among {DRAWS} draws", size=9)
        figure.supylabel("repeats", size=9)
    return figure


def _counts(ranks: Ranks | Sequence[int]) -> Ranks:
    """Repeats in each of as many equal bins as they suffice for."""
    bins = next((number for number in BINS if len(ranks) >= EXPECTED * number), BINS[-1])
    return np.bincount(np.asarray(ranks) * bins // (DRAWS + 1), minlength=bins)
