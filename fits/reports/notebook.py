"""What a notebook shows of fits, posteriors and comparisons: verdicts and tables of the report, as HTML fragments.

Results lie below reports and do not import them: they ask for these functions by name when they are shown.
"""

import html
from typing import TYPE_CHECKING

from fits.reports import tables, verdicts
from fits.reports.diagnostics import residual_structure, standardised

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.prediction.compare import Comparison
    from fits.sampling.posterior import Posterior


def fit_fragment(fit: "Fit") -> str:
    """How well the model explains the data, values with errors and units, what is left open; of a `Joint`, by part."""
    parts = {name: fit.part(name) for name in fit.problem.problems}
    return "".join((f"<h4>{html.escape(name)}</h4>" if name else "") + _one(part) for name, part in parts.items())


def posterior_fragment(posterior: "Posterior") -> str:
    """How far the chain can be trusted, and its estimates, where it is long enough for any."""
    table = tables.html_table(tables.posterior_table(posterior)) if verdicts.reportable(posterior) else ""
    return _paragraph(verdicts.sampled(posterior)) + table


def comparison_fragment(comparison: "Comparison") -> str:
    """Which of several fits explains the data, and by how much."""
    return _paragraph(list(comparison.verdict)) + tables.html_table(tables.comparison_table(comparison))


def _one(fit: "Fit") -> str:
    words, _ = verdicts.in_short(fit, residual_structure(fit.problem.data, standardised(fit)))
    ratio = f"Chi-square per degree of freedom: {fit.reduced_chi_square:.3g} ({fit.degrees_of_freedom})."
    found = [_paragraph([*words, ratio] if fit.is_posterior else words), tables.html_table(tables.parameter_table(fit))]
    if fit.unidentified:
        found.append(tables.html_table(tables.unresolved_table(fit)))
    return "".join(found)


def _paragraph(words: list[str]) -> str:
    return f"<p>{html.escape(' '.join(words))}</p>"
