"""One HTML file that holds all of a fit: what was fitted, the values, and how far they can be trusted."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from fits._files import write_text
from fits.data.measurements import Measurements
from fits.data.scans import incidences
from fits.data.totals import Totals
from fits.reports import tables, verdicts
from fits.reports.agreement import explains
from fits.reports.data_tables import came_as
from fits.reports.diagnostics import ResidualStructure, residual_label, residual_structure, standardised
from fits.reports.pages import Pictures, document, image, made_with, section, sentences
from fits.reports.plots import data as pictures
from fits.reports.plots import model as model_pictures
from fits.reports.plots import parameters as parameter_pictures
from fits.reports.plots.predictions import bands_picture
from fits.reports.plots.totals import totals_picture
from fits.reports.predictions import scores_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fits.optimise.result import Fit
    from fits.prediction.compare import Comparison
    from fits.prediction.predict import Prediction
    from fits.sampling.posterior import Posterior

MOST_ANGLES = 24
"""Incidences that are named one by one."""


class Foretold(NamedTuple):
    """Readings that were not fitted, and the prediction of them."""

    readings: Measurements
    prediction: "Prediction"


def report(
    fit: "Fit",
    posterior: "Posterior | None" = None,
    path: str | Path = "report.html",
    *,
    others: "Mapping[str, Fit | Posterior] | None" = None,
    name: str = "this fit",
    unseen: Measurements | None = None,
    force: bool = True,
) -> None:
    """Writes the report of a fit to `path`, whole or not at all: see `fits.report`, which calls this."""
    fit.require_one("report")
    foretold = None if unseen is None else foretell(fit, posterior, unseen)
    images = draw(fit, posterior, others, name, foretold)
    write_text(path, page(fit, posterior, images, others, name, foretold), force=force)


def foretell(fit: "Fit", posterior: "Posterior | None", unseen: Measurements) -> Foretold:
    """What the posterior, or the fit where there is none to report from, says of readings that were not fitted."""
    from fits.prediction.predict import predict

    of = posterior if posterior is not None and verdicts.reportable(posterior) else fit
    return Foretold(unseen, predict(of, unseen))


def draw(
    fit: "Fit",
    posterior: "Posterior | None" = None,
    others: "Mapping[str, Fit | Posterior] | None" = None,
    name: str = "this fit",
    foretold: Foretold | None = None,
) -> dict[str, bytes]:
    """Every picture that applies, as PNG by name."""
    data = fit.problem.data
    estimates = posterior if posterior is not None and verdicts.reportable(posterior) else None
    figures: dict[str, Figure | None] = {
        "stack": parameter_pictures.stack_picture(fit.stack),
        "correlation": parameter_pictures.correlation_picture(fit),
    }
    if isinstance(data, Totals):
        figures["totals"] = totals_picture(data, fit)
    else:
        figures |= {
            "model": model_pictures.curves_picture({name: fit}, estimates),
            "maps": model_pictures.maps_picture(fit),
            "residuals": pictures.residual_picture(data, standardised(fit), residual_label(fit)),
        }
    if estimates is not None:
        figures["corner"] = parameter_pictures.corner_picture(estimates)
    if posterior is not None:
        figures["trace"] = parameter_pictures.trace_picture(posterior)
    if foretold is not None:
        figures["held_out"] = bands_picture(foretold.prediction, foretold.readings)
    if others:
        figures["comparison"] = model_pictures.curves_picture({name: fit, **_fits(others)})
    return {key: pictures.as_png(figure) for key, figure in figures.items() if figure is not None}


def page(
    fit: "Fit",
    posterior: "Posterior | None",
    images: Pictures,
    others: "Mapping[str, Fit | Posterior] | None" = None,
    name: str = "this fit",
    foretold: Foretold | None = None,
) -> str:
    """The HTML text of the report, with the pictures inside."""
    structure = residual_structure(fit.problem.data, standardised(fit))
    title = f"Fit of {source_name(fit.problem.data)}"
    sections = [
        f"<h1>{html.escape(title)}</h1>",
        _verdict(fit, structure),
        _fitted(fit),
        section(
            "The stack", image(images, "stack", "Fitted stack, from top to bottom; not to scale."), _stack_text(fit)
        ),
        section(
            "Values",
            tables.html_table(tables.parameter_table(fit)),
            "" if fit.without_discrepancy is None else tables.html_table(tables.alone_table(fit)),
        ),
        section(
            "Data and model",
            image(images, "totals", "Shares of the light, with one sigma, and those of the fit."),
            image(images, "model", _curves_caption(fit)),
            image(
                images,
                "maps",
                "Seen from above, forward to the right, rings at 30°, 60° and 90°; the star is the light.",
            ),
        ),
        "" if foretold is None else _held_out(foretold, images),
        section(
            "How well the model explains the data",
            sentences(explains(fit, structure)),
            tables.html_table(tables.incidence_table(structure)),
            image(images, "residuals", "Departures from independent noise of the stated size."),
        ),
        section(
            "What the data cannot tell",
            sentences(verdicts.determines(fit)),
            tables.html_table(tables.unresolved_table(fit)) if fit.unidentified else "",
            image(images, "correlation", "Correlation of the fitted parameters."),
        ),
        section("Minima", sentences(verdicts.minima(fit)), tables.html_table(tables.minima_table(fit))),
        _posterior(fit, posterior, images),
    ]
    if others:
        own = fit if posterior is None or not verdicts.reportable(posterior) else posterior
        from fits.prediction.compare import compare

        sections.append(comparisonsection(compare({name: own, **others}), images))
    sections.append(made_with())
    return document(title, sections)


def comparison_page(candidates: "Mapping[str, Fit | Posterior]", compared: "Comparison") -> str:
    """The HTML text of a comparison of fits of the same data, with its picture inside."""
    fits = _fits(candidates)
    figure = model_pictures.curves_picture(fits)
    images = {} if figure is None else {"comparison": pictures.as_png(figure)}
    title = f"Fits of {source_name(next(iter(fits.values())).problem.data)}"
    body = [f"<h1>{html.escape(title)}</h1>", comparisonsection(compared, images)]
    body += [
        section(name, _stack_text(fit), tables.html_table(tables.parameter_table(fit))) for name, fit in fits.items()
    ]
    return document(title, body)


def comparisonsection(compared: "Comparison", images: Pictures) -> str:
    """Which of several fits explains the data, as an HTML fragment."""
    return section(
        "Comparison",
        sentences(compared.verdict),
        tables.html_table(tables.comparison_table(compared)),
        image(images, "comparison", "The fits beside the same data."),
    )


def source_name(data: Measurements) -> str:
    """The file's name, or what the data is where there is none."""
    return Path(data.source.path).name or f"{data.source.format} data"


def _fits(candidates: "Mapping[str, Fit | Posterior]") -> "dict[str, Fit]":
    from fits.sampling.posterior import Posterior

    return {name: entry.fit if isinstance(entry, Posterior) else entry for name, entry in candidates.items()}


def _held_out(foretold: Foretold, images: Pictures) -> str:
    return section(
        "Readings that were held out",
        tables.html_table(scores_table(foretold.prediction, foretold.readings, "")),
        image(images, "held_out", "Held-out readings in the plane of incidence, and their prediction intervals."),
    )


def _verdict(fit: "Fit", structure: ResidualStructure) -> str:
    words, fine = verdicts.in_short(fit, structure)
    return f'<p class="verdict{" fine" if fine else ""}">{html.escape(" ".join(words))}</p>'


def _fitted(fit: "Fit") -> str:
    data, problem = fit.problem.data, fit.problem
    rows = [
        ("file", data.source.path or "none"),
        ("format", data.source.format),
        ("values came as", came_as(data)),
        ("channels", ", ".join(data.channels)),
        ("readings", f"{int(data.mask.sum())} of {len(data.mask)} used, {int((~data.mask).sum())} masked"),
        ("incidence", _incidence_words([group.theta for group in incidences(data.used())])),
        ("noise", verdicts.noise_in_words(problem)),
        ("objective", problem.objective),
        ("common scale", verdicts.scale_in_words(problem)),
        ("starts", verdicts.starts_in_words(fit)),
        ("transport", verdicts.transport_in_words(fit)),
        *((("numerical error of the model", verdicts.numerical_error(fit)),) if fit.resolution else ()),
        *(("note", note) for note in data.source.notes),
        *((("attribution", data.source.attribution),) if data.source.attribution else ()),
    ]
    return section("What was fitted", tables.html_table(tables.Table("", ("", ""), tuple(rows))))


def _curves_caption(fit: "Fit") -> str:
    caption = "In the plane of incidence. Grey: one sigma as the noise model assumes it."
    if fit.problem.noise.discrepancy:
        caption += " Residuals are of the curve with the discrepancy, which follows the readings."
    return caption


def _incidence_words(angles: Sequence[float]) -> str:
    """Each of them; of many how many there are, and from where to where."""
    if len(angles) > MOST_ANGLES:
        return f"{len(angles)}, from {min(angles):g}° to {max(angles):g}°"
    return ", ".join(f"{angle:g}°" for angle in angles)


def _stack_text(fit: "Fit") -> str:
    import tomli_w

    from fits.problem.toml import material_to_dict

    return f"<pre>{html.escape(tomli_w.dumps(material_to_dict(fit.stack)))}</pre>"


def _posterior(fit: "Fit", posterior: "Posterior | None", images: Pictures) -> str:
    if posterior is None:
        if fit.is_posterior:
            return section("Posterior", "<p>Not sampled. <code>layerjax sample DIR</code> samples it.</p>")
        return section("Posterior", "<p>There is none: the objective is a named residual, not a likelihood.</p>")
    return section(
        "Posterior",
        sentences(verdicts.sampled(posterior)),
        tables.html_table(tables.posterior_table(posterior)) if verdicts.reportable(posterior) else "",
        image(images, "corner", "Samples of the posterior; orange: the best fit."),
        image(images, "trace", "Every walker; estimates use what is right of the orange line."),
    )
