"""What a search for the stack behind the data found: a table, sentences, a picture, a page."""

import html
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from fits.reports import tables
from fits.reports.html import source_name
from fits.reports.pages import document, image, section, sentences
from fits.reports.plots.data import CYCLE, GREY, STYLE, as_png
from fits.reports.verdicts import assess, listed, noise_statements, not_described, ratio_without_discrepancy

if TYPE_CHECKING:
    from fits.structure_search.searching import Found, Search

SHOWN = 20
"""Rows of the table on the terminal."""

NAMED = 5
"""Structures that the picture names."""


def search_table(search: "Search", most: int | None = SHOWN) -> tables.Table:
    """A row for each structure, best first."""
    rows = tuple(_row(one) for one in search.found[:most])
    hidden = len(search.found) - len(rows)
    note = (
        "First the models that were looked at closely, by predictive score (the sum of log predictive densities of "
        "readings left out of the fit); then the others, by BIC with independent noise."
        + (f" {hidden} more are in the report." if hidden else "")
    )
    heads = ("from the top", "parameters", "chi2/dof", "BIC - best", "score", "behind best", "weight", "probability")
    return tables.Table("Stacks", heads, rows, note)


def search_sentences(search: "Search") -> list[str]:
    """What the data say of the structures: one verdict, by the predictive score, and what is to be known of it."""
    best = search.best
    assert best.model_score is not None
    facts = assess(best.fit)
    words = [
        *([] if facts.described else [not_described(facts)]),
        f"Of {len(search.found)} models, {best.name} has the best cross-validated predictive score. {_others(search)}",
    ]
    term = best.fit.problem.build(best.fit.vector).correlation
    if term is not None:
        words.append(
            f"Even the best model needs a correlated discrepancy term of {100.0 * float(term.amplitude):.2g} %; "
            f"chi2/dof without it is {ratio_without_discrepancy(best.fit):.3g}."
        )
    unsure = [one.name for one in search.found if one.model_score and not one.model_score.evidence.reliable]
    if unsure:
        words.append(f"Probabilities are unreliable for {listed(unsure)}.")
    if search.stopped:
        words.append("The time budget ended the search before all models were tried. The same command goes on with it.")
    return [*words, *noise_statements(best.fit.problem)]


def _others(search: "Search") -> str:
    """Which others the score does not tell from the best; and that nothing else in the table does."""
    gaps = {one.name: one.model_score for one in search.found if one.model_score is not None}
    if not search.alike:
        if len(gaps) == 1:
            return "No other was looked at closely."
        return "It is ahead of every other that was looked at closely by more than chance."
    near = listed([f"{name} ({gaps[name].elpd_diff:.2g} ± {gaps[name].dse:.2g})" for name in search.alike])
    return (
        f"It is statistically indistinguishable from {near}: these score differences are within two standard errors. "
        "BIC, weight and probability do not overrule this: BIC takes residuals to be independent, the weight has no "
        "error, and the probability holds if one of these models is right."
    )


def search_picture(search: "Search") -> Figure:
    """What structures foretell, and how well they fit, against how many parameters they have."""
    close = [one for one in search.found if one.model_score is not None]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.8), layout="constrained")
        left, middle, right = figure.subplots(1, 3, width_ratios=[3.0, 3.0, 2.0])
        for number, one in enumerate(close):
            assert one.model_score is not None
            colour = CYCLE[number % len(CYCLE)] if number < NAMED else GREY
            error, behind = one.model_score.dse, one.model_score.elpd_diff
            left.errorbar(_own(one), max(behind, 0.0), yerr=error, fmt="o", color=colour, markersize=5, label=one.name)
        left.set_yscale("symlog", linthresh=10.0)
        left.invert_yaxis()
        left.set(xlabel="parameters of the stack", ylabel="score behind the best", title="Foretelling what is left out")
        counts = [_own(one) for one in search.found]
        middle.plot(counts, [max(one.bic, 0.0) for one in search.found], "o", color=GREY, markersize=4)
        for number, one in enumerate(close[:NAMED]):
            middle.plot(_own(one), max(one.bic, 0.0), "o", color=CYCLE[number % len(CYCLE)], markersize=6)
        middle.set_yscale("symlog", linthresh=10.0)
        middle.invert_yaxis()
        middle.set(xlabel="parameters of the stack", ylabel="BIC above the lowest", title="Fit with noise alone")
        for axes in (left, middle):
            axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
        named = close[:NAMED]
        places = np.arange(len(named))
        shares = [one.model_score.model_probability if one.model_score else 0.0 for one in named]
        right.barh(places, shares, color=[CYCLE[number % len(CYCLE)] for number in places])
        right.set(xlabel="probability", title="Posterior", xlim=(0.0, 1.0))
        right.set_yticks(places, ["" for _ in named])
        right.invert_yaxis()
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def search_page(search: "Search") -> str:
    """All of it as one HTML file."""
    title = f"Stacks behind {source_name(search.best.fit.problem.data)}"
    picture = {"search": as_png(search_picture(search))}
    body = [
        f"<h1>{html.escape(title)}</h1>",
        section("What the data say", sentences(search_sentences(search))),
        section("Structures", image(picture, "search", _CAPTION), tables.html_table(search_table(search, None))),
        section("The best", tables.html_table(tables.parameter_table(search.best.fit))),
    ]
    return document(title, body)


_CAPTION = (
    "Left: how far the log-density of incidences that are left out falls behind that of the best structure, with its "
    "standard error. Middle: the Bayesian information criterion of fits with noise alone. Right: probability among the "
    "structures that were looked at closely, all as probable beforehand."
)


def _row(one: "Found") -> tuple[str, ...]:
    seen = one.model_score
    cells = ("", "", "", "")
    if seen is not None:
        cells = (
            f"{seen.elpd:.1f}",
            f"{seen.elpd_diff:.1f} ± {seen.dse:.1f}",
            f"{seen.weight:.2f}",
            f"{seen.model_probability:.2g}",
        )
    alone = one.fit.without_discrepancy
    ratio = alone.chi_square / max(alone.degrees_of_freedom, 1) if alone else one.fit.reduced_chi_square
    return (one.name, str(_own(one)), f"{ratio:.3g}", f"{one.bic:.1f}", *cells)


def _own(one: "Found") -> int:
    """Parameters, without those of errors that readings share."""
    return len(one.fit.without_discrepancy.values) if one.fit.without_discrepancy else one.parameters
