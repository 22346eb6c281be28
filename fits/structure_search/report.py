"""What a search found: a table, sentences, a picture and a page."""

import html
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from fits._files import write_together
from fits.reports import tables
from fits.reports.html import source_name
from fits.reports.pages import document, image, section, sentences
from fits.reports.plots.data import CYCLE, GREY, STYLE, as_png
from fits.reports.verdicts import assess, listed, noise_statements, not_described, ratio_without_discrepancy
from fits.structure_search.search import Candidate, Search

PAGE, PICTURE = "search.html", "search.png"
SHOWN = 20
"""Rows of the table on the terminal."""
NAMED = 5
"""Structures that the picture names."""


def write_report(search: Search, directory: str | Path) -> None:
    """Write the page and its picture into the directory of a search."""
    picture = as_png(search_picture(search))
    title = f"Stacks behind {source_name(search.best.fit.problem.data)}"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        section("What the data say", sentences(search_sentences(search))),
        section(
            "Structures", image({"search": picture}, "search", _CAPTION), tables.html_table(search_table(search, None))
        ),
        section("The best", tables.html_table(tables.parameter_table(search.best.fit))),
    ]
    write_together(Path(directory), {PICTURE: picture, PAGE: document(title, body).encode()})


def search_table(search: Search, most: int | None = SHOWN) -> tables.Table:
    """A row for each structure, best first."""
    rows = tuple(map(_row, search.candidates[:most]))
    hidden = len(search.candidates) - len(rows)
    note = (
        "First the cross-validated models, by predictive score (the sum of log predictive densities of held-out data); "
        "then the others, by BIC with independent noise." + (f" {hidden} more are in the report." if hidden else "")
    )
    heads = ("from the top", "parameters", "chi2/dof", "BIC - best", "score", "behind best", "weight", "probability")
    return tables.Table("Stacks", heads, rows, note)


def _row(one: Candidate) -> tuple[str, ...]:
    score, without = one.model_score, one.fit.without_discrepancy
    cells = ("", "", "", "")
    if score is not None:
        behind = f"{score.elpd_diff:.1f} ± {score.dse:.1f}"
        cells = (f"{score.elpd:.1f}", behind, f"{score.weight:.2f}", f"{score.model_probability:.2g}")
    ratio = without.chi_square / max(without.degrees_of_freedom, 1) if without else one.fit.reduced_chi_square
    return (one.name, str(_of_stack(one)), f"{ratio:.3g}", f"{one.bic:.1f}", *cells)


def _of_stack(one: Candidate) -> int:
    """Parameters, without those of the model discrepancy."""
    return len(one.fit.without_discrepancy.values) if one.fit.without_discrepancy else one.parameters


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
            f"Even the best model needs a correlated discrepancy term of {100.0 * float(term.amplitude):.2g} %; "
            f"chi2/dof without it is {ratio_without_discrepancy(best.fit):.3g}."
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


def search_picture(search: Search) -> Figure:
    """Predictive score and BIC against the number of parameters."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.8), layout="constrained")
        left, right = figure.subplots(1, 2)
        for number, one in enumerate(search.candidates):
            score, close = one.model_score, one.model_score is not None and number < NAMED
            colour, label = (CYCLE[number % len(CYCLE)], one.name) if close else (GREY, None)
            if score is not None:
                behind = max(score.elpd_diff, 0.0)
                left.errorbar(_of_stack(one), behind, yerr=score.dse, fmt="o", color=colour, label=label)
            right.plot(_of_stack(one), one.bic, "o", color=colour)
        left.set(ylabel="elpd difference to the best", title="Held-out data")
        right.set(ylabel="BIC above the lowest", title="Fit with independent noise")
        for axes in (left, right):
            axes.set_yscale("symlog", linthresh=10.0)
            axes.invert_yaxis()
            axes.set_xlabel("parameters of the stack")
            axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
        figure.legend(loc="outside lower center", ncols=2)
    return figure


_CAPTION = (
    "Left: how far the log predictive density of held-out incidences is behind that of the best structure, with its "
    "standard error. Right: the Bayesian information criterion of fits with independent noise."
)
