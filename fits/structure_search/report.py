"""What a search found: a table, sentences and a page."""

import html
from pathlib import Path

from fits._files import write_text
from fits.reports import tables
from fits.reports.html import source_name
from fits.reports.pages import document, section
from fits.reports.verdicts import assess, listed, noise_statements, not_described, ratio_without_discrepancy
from fits.structure_search.search import Search

PAGE = "search.html"
SHOWN = 20
"""Rows of the table on the terminal."""


def write_report(search: Search, directory: str | Path) -> None:
    """Write the page into the directory of a search."""
    title = f"Stacks behind {source_name(search.best.fit.problem.data)}"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        section("What the data say", search_sentences(search)),
        section("Structures", search_table(search, None)),
        section("The best", tables.parameter_table(search.best.fit)),
    ]
    write_text(Path(directory) / PAGE, document(title, body), force=True)


def search_table(search: Search, most: int | None = SHOWN) -> tables.Table:
    """A row for each structure, best first."""
    rows = []
    for one in search.candidates[:most]:
        score, without = one.model_score, one.fit.without_discrepancy
        count, ratio, cells = one.parameters, one.fit.reduced_chi_square, ("", "", "", "")
        if without is not None:  # of the stack alone
            count, ratio = len(without.values), without.chi_square / max(without.degrees_of_freedom, 1)
        if score is not None:
            difference = f"{score.elpd_diff:.1f} ± {score.dse:.1f}"
            cells = (f"{score.elpd:.1f}", difference, f"{score.weight:.2f}", f"{score.model_probability:.2g}")
        rows.append((one.name, str(count), f"{ratio:.3g}", f"{one.bic:.1f}", *cells))
    hidden = len(search.candidates) - len(rows)
    note = (
        "First the cross-validated models, by elpd (sum of log predictive densities of held-out data); then the "
        "others, by BIC with independent noise." + (f" {hidden} more are in the report." if hidden else "")
    )
    heads = ("from the top", "parameters", "chi2/dof", "BIC - best", "elpd", "elpd_diff ± dse", "weight", "probability")
    return tables.Table("Stacks", heads, tuple(rows), note)


def search_sentences(search: Search) -> list[str]:
    """One verdict, by the predictive score, and its caveats."""
    best = search.best
    facts = assess(best.fit)
    words = [
        *([] if facts.described else [not_described(facts)]),
        f"Of {len(search.candidates)} models, {best.name} has the best cross-validated predictive score. "
        f"{_others(search)}",
    ]
    term = best.fit.problem.build(best.fit.vector).correlation
    if term is not None:
        words.append(
            f"Even the best model has a discrepancy of {100.0 * float(term.amplitude):.2g} %; the reduced chi-square "
            f"without it is {ratio_without_discrepancy(best.fit):.3g}."
        )
    unsure = [one.name for one in search.candidates if one.model_score and not one.model_score.evidence.reliable]
    if unsure:
        words.append(f"Probabilities are unreliable for {listed(unsure)}.")
    if search.stopped:
        words.append("The time budget ended the search before all models were tried. The same command resumes it.")
    return [*words, *noise_statements(best.fit.problem)]


def _others(search: Search) -> str:
    """Which others are indistinguishable from the best by the score; and that nothing else in the table decides."""
    scores = {one.name: one.model_score for one in search.candidates if one.model_score is not None}
    if not search.indistinguishable:
        if len(scores) == 1:
            return "No other was cross-validated."
        return "It is ahead of every other cross-validated model by more than the error of the difference."
    near = [f"{name} ({scores[name].elpd_diff:.2g} ± {scores[name].dse:.2g})" for name in search.indistinguishable]
    return (
        f"It is statistically indistinguishable from {listed(near)}: these score differences are within two standard "
        "errors. BIC, weight and probability do not overrule this: BIC takes residuals to be independent, the weight "
        "has no error, and the probability holds if one of these models is right."
    )
