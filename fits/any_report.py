"""The report of a result, whether a fit or a fitted map."""

from collections.abc import Mapping
from pathlib import Path

from fits._files import require_switch, write_text
from fits.data.measurements import TO_HAVE_THEM, Measurements
from fits.maps.report import report as report_map
from fits.maps.store import FittedMap
from fits.optimise.result import Fit
from fits.reports.html import FitReport
from fits.reports.verdicts import DEFAULT, ReportOptions
from fits.sampling.posterior import Posterior
from layerjax._checks import require_kind
from layerjax.compiling import program_cache


@program_cache()
def report(
    fit: Fit | FittedMap,
    posterior: Posterior | None = None,
    path: str | Path = "report.html",
    *,
    others: Mapping[str, Fit | Posterior] | None = None,
    name: str = "this fit",
    held_out: Measurements | None = None,
    options: ReportOptions = DEFAULT,
    force: bool = True,
) -> None:
    """Write the report of a fit or of a fitted map. A file that cannot be completed is not written.

    Args:
        fit: a fit; or a map, finished or not, which takes only `path` and `force`.
        posterior: posterior of the fit, if it was sampled.
        path: HTML file, which includes its pictures.
        others: further fits of the same data, or their posteriors, by name, to be compared with this one.
        name: name of this fit among `others`.
        held_out: measurements that were not fitted, to be shown with their prediction.
        options: thresholds that decide what the report of a fit says.
        force: replace an existing file.

    Raises:
        ValueError: `path` exists and `force` is False, `others` cannot be compared with this fit, or it is one of
            several measurements (see `Fit.part`); or a part of a map is damaged.
    """
    require_kind("fit", fit, Fit, FittedMap)
    require_kind("posterior", posterior, Posterior, None)
    require_kind("others", others, Mapping, None)
    require_kind("held_out", held_out, Measurements, None, fix=TO_HAVE_THEM)
    require_kind("options", options, ReportOptions)
    require_switch("force", force)
    if isinstance(fit, FittedMap):
        if posterior is not None or others or held_out is not None:
            raise ValueError("posterior, others, held_out: a map has none; it is reported by itself")
        report_map(fit, path, force)
        return
    fit.require_one("report")
    write_text(path, FitReport(fit, posterior, others or {}, name, held_out, options).page(), force=force)
