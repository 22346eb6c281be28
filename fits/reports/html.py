"""Reports as HTML: the page of a fit, and what a notebook shows of results.

A page opens with the verdict in three sentences; then come values, data and model, diagnostics, identifiability,
posterior and comparison.
"""

import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import tomli_w
from matplotlib.figure import Figure

import layerjax as lj
from fits._files import write_text
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.optimise.result import Fit
from fits.optimise.uncertainty import UNIDENTIFIED_BEYOND
from fits.prediction.compare import Comparison, compare, fits_of
from fits.prediction.predict import Prediction, predict
from fits.problem.stack_file import material_to_dict
from fits.reports import tables, verdicts
from fits.reports.data_summary import source_rows
from fits.reports.pages import Part, Table, document, html_table, image, made_with, section, sentences, verdict
from fits.reports.plots import data as pictures
from fits.reports.results import REPORT
from fits.reports.verdicts import ReportOptions, reportable
from fits.sampling.posterior import Posterior


@dataclass(frozen=True, eq=False)
class FitReport:
    """What the report of a fit is made of; arguments as of `fits.report`."""

    fit: Fit
    posterior: Posterior | None = None
    others: Mapping[str, Fit | Posterior] = field(default_factory=dict)
    name: str = "this fit"
    held_out: Measurements | None = None
    options: ReportOptions = verdicts.DEFAULT

    @property
    def estimates(self) -> Posterior | None:
        """The posterior, if there are estimates of it."""
        return self.posterior if self.posterior is not None and reportable(self.posterior) else None

    @cached_property
    def predicted(self) -> Prediction | None:
        """The prediction of held-out data; None without any."""
        return None if self.held_out is None else predict(self.estimates or self.fit, self.held_out)

    def write(self, folder: Path) -> None:
        """Writes the report into a result directory."""
        write_text(folder / REPORT, self.page(), force=True)

    def page(self) -> str:
        """The HTML text, with the pictures inside."""
        fit, data = self.fit, self.fit.problem.data
        facts = verdicts.assess(fit, self.options)
        opening = verdicts.verdict(fit, facts)

        # the data, beside the model
        source = Table(data.source.path, ("", ""), (*source_rows(data), *tables.problem_rows(fit)))
        compared: list[Part] = [source]
        if isinstance(data, Totals):
            caption = "Shares of the incident flux with one sigma, and those of the fit."
            compared.append(_picture(pictures.totals_picture(data, fit), caption))
        else:
            caption = (
                "In the plane of incidence, with one sigma of the noise model; grey points were not used. With model "
                "discrepancy, residuals include it; intervals of the posterior do not."
            )
            compared.append(_picture(pictures.curves_picture({self.name: fit}, self.estimates), caption))
            caption = "From above, forward to the right, rings at 30°, 60° and 90°; star: the light."
            compared.append(_picture(pictures.maps_picture(fit), caption))
        if self.held_out is not None and self.predicted is not None:
            compared.append(tables.scores_table(self.predicted, self.held_out, "Held-out data"))
            caption = (
                "Held-out data in the plane of incidence and their prediction; residuals by its standard deviation."
            )
            compared.append(_picture(pictures.prediction_picture(self.predicted, self.held_out), caption))

        # what the data identify
        count = f"{len(fit.unidentified)} of {len(facts.words)}" if fit.unidentified else "No"
        identified = (
            f"The condition number of the scaled problem is {fit.condition_number:.3g}. {count} principal directions "
            f"of parameter space have a standard error above {100.0 * UNIDENTIFIED_BEYOND:g} % of the prior range."
        )

        # the posterior, as far as there is one
        sampling: list[Part] = ["<p>There is none: the objective is a named residual, not a likelihood.</p>"]
        if fit.is_posterior:
            sampling = ["<p>Not sampled. <code>layerjax sample DIR</code> samples it.</p>"]
        if self.posterior is not None:
            sampling = [verdicts.sampled(self.posterior)]
            if self.estimates is not None:
                corner = pictures.corner_picture(self.estimates)
                sampling.append(tables.posterior_table(self.estimates))
                sampling.append(_picture(corner, "Draws from the posterior; orange: the best fit."))

        residuals = [one.sentence for one in verdicts.statements(facts)["residuals"]]
        residuals.append(f"Fit: {fit.status}.")
        named = isinstance(fit.stack, lj.Stack | lj.Mixture)  # which the transport of a user's own need not take
        stack = tomli_w.dumps(material_to_dict(fit.stack)) if named else str(fit.stack)
        title = f"Fit of {Path(data.source.path).name or f'{data.source.format} data'}"
        body = [
            f"<h1>{html.escape(title)}</h1>",
            verdict(opening.sentences, opening.sound),
            sentences(opening.remarks) if opening.remarks else "",
            section("Values", tables.parameter_table(fit, both=True), f"<pre>{html.escape(stack)}</pre>"),
            section("Data and model", *compared),
            section("Diagnostics", residuals, tables.incidence_table(fit), tables.minima_table(fit)),
            section("Identifiability", [identified], tables.unidentified_table(fit), tables.correlation_table(fit)),
            section("Posterior", *sampling),
        ]
        if self.others:
            found = compare({self.name: self.estimates or fit, **self.others})
            picture = _picture(
                pictures.curves_picture({self.name: fit, **fits_of(self.others)}), "The fits beside the data."
            )
            body.append(section("Comparison", found.verdict.splitlines(), tables.comparison_table(found), picture))
        return document(title, [*body, made_with()])


def _picture(figure: Figure | None, caption: str) -> str:
    return "" if figure is None else image(pictures.as_png(figure), caption)


# In a notebook: results lie below reports and do not import them, but call these functions when they are shown.


def fit_fragment(fit: Fit) -> str:
    """The verdict on a fit, values with errors and units, and unidentified directions; of a `Joint`, by data set."""
    fragments = []
    for name in fit.problem.problems:
        part = fit.part(name)
        opening = verdicts.verdict(part)
        fragments += [
            f"<h4>{html.escape(name)}</h4>" if name else "",
            _paragraph([*opening.sentences, *opening.remarks]),
            html_table(tables.parameter_table(part)),
            html_table(tables.unidentified_table(part)),
        ]
    return "".join(fragments)


def posterior_fragment(posterior: Posterior) -> str:
    """How far the chain has converged, and its estimates, if there are any."""
    table = html_table(tables.posterior_table(posterior)) if reportable(posterior) else ""
    return _paragraph(verdicts.sampled(posterior)) + table


def comparison_fragment(comparison: Comparison) -> str:
    """Which of several fits predicts the data best, and by how much."""
    return _paragraph([comparison.verdict]) + html_table(tables.comparison_table(comparison))


def _paragraph(words: list[str]) -> str:
    return f"<p>{html.escape(' '.join(words))}</p>"
