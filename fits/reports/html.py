"""Reports as HTML: the page of a fit, that of a comparison, and what a notebook shows of results.

A page opens with the verdict in three sentences; then come values, data and model, diagnostics, identifiability,
posterior and comparison.
"""

import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from fits._files import write_together
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.optimise.uncertainty import UNIDENTIFIED_BEYOND
from fits.reports import tables, verdicts
from fits.reports.data_summary import source_rows
from fits.reports.diagnostics import residual_label, standardised
from fits.reports.pages import Pictures, Table, document, html_table, image, made_with, section, sentences, verdict
from fits.reports.plots import data as pictures
from fits.reports.plots import model as model_pictures
from fits.reports.plots import parameters as parameter_pictures
from fits.reports.results import REPORT
from fits.reports.verdicts import ReportOptions, reportable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fits.optimise.result import Fit
    from fits.prediction.compare import Comparison
    from fits.prediction.predict import Prediction
    from fits.sampling.posterior import Posterior

Results = Mapping[str, "Fit | Posterior"]


@dataclass(frozen=True, eq=False)
class FitReport:
    """What the report of a fit is made of; arguments as of `fits.report`."""

    fit: "Fit"
    posterior: "Posterior | None" = None
    others: Results = field(default_factory=dict)
    name: str = "this fit"
    held_out: Measurements | None = None
    options: ReportOptions = verdicts.DEFAULT

    @property
    def estimates(self) -> "Posterior | None":
        """The posterior, if there are estimates of it."""
        return self.posterior if self.posterior is not None and reportable(self.posterior) else None

    @cached_property
    def predicted(self) -> "Prediction | None":
        """The prediction of held-out data; None without any."""
        from fits.prediction.predict import predict

        return None if self.held_out is None else predict(self.estimates or self.fit, self.held_out)

    @cached_property
    def images(self) -> Pictures:
        """Every picture that applies, as PNG by name."""
        fit, data = self.fit, self.fit.problem.data
        figures: dict[str, Figure | None] = {"correlation": parameter_pictures.correlation_picture(fit)}
        if isinstance(data, Totals):
            figures["totals"] = pictures.totals_picture(data, fit)
        else:
            figures["model"] = model_pictures.curves_picture({self.name: fit}, self.estimates)
            figures["maps"] = model_pictures.maps_picture(fit)
            figures["residuals"] = pictures.residual_picture(data, standardised(fit), residual_label(fit))
        if self.estimates is not None:
            figures["corner"] = parameter_pictures.corner_picture(self.estimates)
        if self.posterior is not None:
            figures["trace"] = parameter_pictures.trace_picture(self.posterior)
        if self.held_out is not None and self.predicted is not None:
            figures["held_out"] = model_pictures.prediction_picture(self.predicted, self.held_out)
        if self.others:
            figures["comparison"] = model_pictures.curves_picture({self.name: fit, **_fits(self.others)})
        return {key: pictures.as_png(figure) for key, figure in figures.items() if figure is not None}

    def write(self, folder: Path) -> None:
        """Writes the report into a result directory, its pictures beside it."""
        images = {f"{key}.png": image for key, image in self.images.items()}
        write_together(folder, images | {REPORT: self.page().encode()})

    def page(self) -> str:
        """The HTML text, with the pictures inside."""
        fit, images, posterior = self.fit, self.images, self.posterior
        facts = verdicts.assess(fit, self.options)
        opening = verdicts.verdict(fit, facts)
        curves = "In the plane of incidence. Grey: one sigma of the noise model."
        if fit.problem.noise.discrepancy:
            curves += " Residuals are those of the curve with model discrepancy."
        scores = None
        if self.held_out is not None and self.predicted is not None:
            scores = tables.scores_table(self.predicted, self.held_out, "Held-out data")
        limit = f"{100.0 * UNIDENTIFIED_BEYOND:g} % of the prior range"
        count = f"{len(fit.unidentified)} of {len(facts.words)}" if fit.unidentified else "No"
        sampling: list[str | Table | list[str] | None] = [
            "<p>Not sampled. <code>layerjax sample DIR</code> samples it.</p>"
            if fit.is_posterior
            else "<p>There is none: the objective is a named residual, not a likelihood.</p>"
        ]
        if posterior is not None:
            sampling = [
                verdicts.sampled(posterior),
                tables.posterior_table(posterior) if self.estimates else None,
                image(images, "corner", "Samples of the posterior; orange: the best fit."),
                image(images, "trace", "Every walker; estimates use the steps right of the orange line."),
            ]
        title = f"Fit of {source_name(fit.problem.data)}"
        body = [
            f"<h1>{html.escape(title)}</h1>",
            verdict(opening.sentences, opening.sound),
            sentences(opening.remarks) if opening.remarks else "",
            section("Values", tables.parameter_table(fit, both=True), _stack_text(fit)),
            section(
                "Data and model",
                Table(
                    fit.problem.data.source.path, ("", ""), (*source_rows(fit.problem.data), *tables.problem_rows(fit))
                ),
                image(images, "totals", "Shares of the incident flux with one sigma, and those of the fit."),
                image(images, "model", curves),
                image(images, "maps", "From above, forward to the right, rings at 30°, 60° and 90°; star: the light."),
                scores,
                image(images, "held_out", "Held-out data in the plane of incidence, and their prediction intervals."),
            ),
            section(
                "Diagnostics",
                [
                    *(one.sentence for one in verdicts.statements(facts)["residuals"]),
                    f"{verdicts.starts_in_words(fit)}.",
                ],
                tables.incidence_table(fit),
                image(images, "residuals", "Residuals along angle, and their distribution."),
                tables.minima_table(fit),
            ),
            section(
                "Identifiability",
                [
                    f"The condition number of the scaled problem is {fit.condition_number:.3g}. {count} principal "
                    f"directions of parameter space have a standard error above {limit}.",
                ],
                tables.unidentified_table(fit) if fit.unidentified else None,
                image(images, "correlation", "Correlation of the fitted parameters."),
            ),
            section("Posterior", *sampling),
        ]
        if self.others:
            from fits.prediction.compare import compare

            body.append(_comparison(compare({self.name: self.estimates or fit, **self.others}), images))
        return document(title, [*body, made_with()])


def source_name(data: Measurements) -> str:
    """The file's name, or what the data is where there is none."""
    return Path(data.source.path).name or f"{data.source.format} data"


def _stack_text(fit: "Fit") -> str:
    import tomli_w

    from fits.problem.stack_file import material_to_dict

    return f"<pre>{html.escape(tomli_w.dumps(material_to_dict(fit.stack)))}</pre>"


def comparison_page(candidates: Results, compared: "Comparison") -> str:
    """The HTML text of a comparison of fits of the same data, with its picture inside."""
    fits = _fits(candidates)
    figure = model_pictures.curves_picture(fits)
    images = {} if figure is None else {"comparison": pictures.as_png(figure)}
    title = f"Fits of {source_name(next(iter(fits.values())).problem.data)}"
    each = [section(name, _stack_text(fit), tables.parameter_table(fit)) for name, fit in fits.items()]
    return document(title, [f"<h1>{html.escape(title)}</h1>", _comparison(compared, images), *each])


def _comparison(compared: "Comparison", images: Pictures) -> str:
    picture = image(images, "comparison", "The fits beside the same data.")
    return section("Comparison", compared.verdict, tables.comparison_table(compared), picture)


def _fits(candidates: Results) -> "dict[str, Fit]":
    from fits.sampling.posterior import Posterior

    return {name: entry.fit if isinstance(entry, Posterior) else entry for name, entry in candidates.items()}


# In a notebook: results lie below reports and do not import them, but call these functions when they are shown.


def fit_fragment(fit: "Fit") -> str:
    """The verdict on a fit, values with errors and units, and unidentified directions; of a `Joint`, by data set."""
    fragments = []
    for name in fit.problem.problems:
        part = fit.part(name)
        opening = verdicts.verdict(part)
        fragments += [
            f"<h4>{html.escape(name)}</h4>" if name else "",
            _paragraph([*opening.sentences, *opening.remarks]),
            html_table(tables.parameter_table(part)),
            html_table(tables.unidentified_table(part)) if part.unidentified else "",
        ]
    return "".join(fragments)


def posterior_fragment(posterior: "Posterior") -> str:
    """How far the chain has converged, and its estimates, if there are any."""
    table = html_table(tables.posterior_table(posterior)) if reportable(posterior) else ""
    return _paragraph(verdicts.sampled(posterior)) + table


def comparison_fragment(comparison: "Comparison") -> str:
    """Which of several fits predicts the data best, and by how much."""
    return _paragraph(list(comparison.verdict)) + html_table(tables.comparison_table(comparison))


def _paragraph(words: list[str]) -> str:
    return f"<p>{html.escape(' '.join(words))}</p>"
