"""Pictures of a fit, and of predictions, beside data, and of its parameters."""

from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from fits.data.geometry import Floats, direction
from fits.data.measurements import Measurements
from fits.data.scans import Incidence, in_plane, signed_angle
from fits.optimise.result import Fit
from fits.prediction.predict import Prediction, with_discrepancy
from fits.problem.model import Model
from fits.reports.plots.data import (
    ANGLE_LABEL,
    CYCLE,
    INK,
    STYLE,
    channel_colour,
    chosen,
    draw_points,
    hemisphere_map,
    mapped,
    value_axis,
    value_label,
    value_norm,
)
from fits.reports.verdicts import over_all_rows, residual_unit
from fits.sampling.posterior import Posterior

INTERVAL_DRAWS = 200  # posterior draws behind an interval
STEEPEST = 89.9  # degrees: in the tangent plane every BRDF of a stack is 0
STEP = 1.0  # degrees between the points of a model curve
FEWEST_IN_PLANE = 3  # measurements that make a panel


def bsdf(fit: Fit) -> np.ndarray:
    """Predicted BSDF at every row, with the model discrepancy, (N, C), in 1/sr; NaN in unused rows."""
    used = fit.problem.data.used()
    return over_all_rows(fit, with_discrepancy(fit, used.wi, used.wo, fit.predicted))


def misfit(fit: Fit) -> np.ndarray:
    """Measurements less `bsdf`, in units of the noise, (N, C); NaN in rows that were not used.

    With a model discrepancy these are smaller than the noise, since it follows the data: `standardised` are not.
    """
    independent = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
    return over_all_rows(fit, independent / residual_unit(fit))


class Curve(NamedTuple):
    """A model along one incidence: viewing angles (M,), BSDF (M, C), that of the stack without model discrepancy, and
    the ends of an interval, (2, M, C); None where there is no discrepancy, or no interval."""

    angle: Floats
    values: Floats
    latent: Floats | None
    interval: Floats | None


def curves_picture(fits: dict[str, Fit], posterior: Posterior | None = None) -> Figure | None:
    """Data and models along each incidence, with standardised residuals below.

    With a model discrepancy there are two curves, with and without it; residuals are of the first.

    fits: one or more fits of the same data by name; the points and their errors are those of the first one.
    posterior: adds the central interval of 95 % of its draws, of the stack without discrepancy and noise, to the first.
    None where no incidence has at least three measurements in the plane of incidence.
    """
    first = next(iter(fits.values()))
    shown, sigma = _in_plane(first.problem.data), None
    if not shown:
        return None
    if first.is_posterior:
        sigma = over_all_rows(first, np.asarray(first.problem.call(Model.sigma_at, first.vector, first.predicted)))
    drawn = fits if len(fits) > 1 else {"model": first}
    curves = {name: _curves(fit, shown, posterior if fit is first else None) for name, fit in drawn.items()}
    return _panels(first.problem.data, shown, curves, list(map(misfit, fits.values())), sigma)


def prediction_picture(prediction: Prediction, data: Measurements) -> Figure | None:
    """Held-out data and the median and interval of their prediction, which is of the used data, along each incidence.

    None where no incidence has at least three measurements in the plane of incidence.
    """
    used, whole = data.used(), prediction.predictive
    shown, signed, curves = _in_plane(used), signed_angle(used), []
    for rows in (one.rows[np.argsort(signed[one.rows], kind="stable")] for one in shown):
        latent = None if prediction.discrepancy_sd is None else prediction.latent.quantiles[2][rows]
        curves.append(Curve(signed[rows], whole.quantiles[2][rows], latent, whole.quantiles[[0, -1]][:, rows]))
    return _panels(used, shown, {"median": curves}, [(used.values - whole.mean) / whole.sd], None) if shown else None


def _panels(
    data: Measurements,
    shown: list[Incidence],
    curves: dict[str, list[Curve]],
    residuals: list[Floats],
    sigma: Floats | None,
) -> Figure:
    """A panel for each incidence with data and models against the signed viewing angle, and standardised residuals
    (N, C) of each model below; sigma: of the data, (N, C).

    Every incidence has an axis of its own: linear, or logarithmic where its values span a wide range.
    """
    signed, columns = signed_angle(data), 1 if len(shown) == 1 else 2 if len(shown) <= 4 else 3
    blocks = -(-len(shown) // columns)
    coloured = len(data.channels) > 1 and len(curves) == 1  # by channel, else by model
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 4.0 * blocks), layout="constrained")
        grid = figure.add_gridspec(2 * blocks, columns, height_ratios=[3.0, 1.2] * blocks)
        upper: Axes | None = None
        lower: Axes | None = None
        for index, incidence in enumerate(shown):
            block, column = divmod(index, columns)
            upper = figure.add_subplot(grid[2 * block, column], sharex=upper)
            lower = figure.add_subplot(grid[2 * block + 1, column], sharex=upper, sharey=lower)
            lower.axhspan(-1.0, 1.0, color="#eeeeee", zorder=0)
            lower.axhline(0.0, color=INK, linewidth=0.6)
            rows = incidence.rows
            for channel, channel_name in enumerate(data.channels):
                colour = channel_colour(channel_name, channel) if coloured else INK
                label = f"data, {channel_name}" if len(data.channels) > 1 else "data"
                draw_points(upper, data, rows, channel, colour, label, sigma)
                for place, (name, along) in enumerate(curves.items()):
                    colour = channel_colour(channel_name, channel) if coloured else CYCLE[place % len(CYCLE)]
                    _line(upper, along[index], channel, colour, "" if channel else name, place)
                    points: dict[str, Any] = {"markersize": 2.2, "color": colour, "markeredgewidth": 0.0}
                    lower.plot(signed[rows], residuals[place][rows, channel], "o", **points)
            value_axis(upper, data.values[rows[data.mask[rows]]], "BRDF, 1/sr" if column == 0 else "")
            upper.set_title(incidence.label)
            upper.tick_params(labelbottom=False)
            lower.set_ylabel(r"residual / $\sigma$" if column == 0 else "")
        figure.supxlabel(ANGLE_LABEL, fontsize="medium")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def _line(axes: Axes, curve: Curve, channel: int, colour: str, name: str, place: int) -> None:
    """One channel of a model; name: in the legend, empty after the first channel."""
    angle, values, latent, ends = curve
    label = f"{name} with discrepancy" if name and latent is not None else name
    axes.plot(angle, values[:, channel], color=colour, linewidth=1.3, label=label, zorder=3)
    if latent is not None:
        label = "without discrepancy" if name and not place else ""
        axes.plot(angle, latent[:, channel], "--", color=colour, linewidth=1.0, label=label, zorder=3)
    if ends is not None:
        style: dict[str, Any] = {"color": colour, "alpha": 0.3, "linewidth": 0.0, "zorder": 2.5}
        axes.fill_between(angle, *ends[:, :, channel], label="95 % interval" if name else "", **style)


def _in_plane(data: Measurements) -> list[Incidence]:
    """Incidences that have a panel, with their rows in the plane of incidence."""
    flat = in_plane(data)
    enough = [one for one in chosen(data) if np.count_nonzero((flat & data.mask)[one.rows]) >= FEWEST_IN_PLANE]
    return [Incidence(one.theta, one.phi, one.rows[flat[one.rows]]) for one in enough]


def _curves(fit: Fit, shown: list[Incidence], posterior: Posterior | None) -> list[Curve]:
    """The model along each incidence, all of them predicted at once; its interval is without discrepancy."""
    signed, angles = signed_angle(fit.problem.data), []
    for incidence in shown:
        own = signed[incidence.rows]
        angle = np.arange(np.floor(own.min()), np.ceil(own.max()) + STEP / 2, STEP)
        angles.append(np.clip(angle, -STEEPEST, STEEPEST))
    each = list(zip(shown, angles, strict=True))
    wi = np.concatenate([np.tile(direction(one.theta, one.phi), (len(angle), 1)) for one, angle in each])
    wo = np.concatenate([direction(angle, one.phi + 180.0) for one, angle in each])
    vectors = fit.vector[None]
    if posterior is not None:
        picked = np.linspace(0, len(posterior.samples) - 1, INTERVAL_DRAWS).astype(int)
        vectors = np.concatenate([vectors, np.asarray(posterior.samples)[picked]])
    values = np.asarray(fit.problem.predict_at(vectors, wi, wo))
    # a grey stack is the same in all channels
    values = np.broadcast_to(values, (*values.shape[:2], len(fit.problem.data.channels)))
    best, latent = with_discrepancy(fit, wi, wo, values[0]), values[0] if fit.problem.noise.discrepancy else None
    ends = None if posterior is None else np.quantile(values[1:], [0.025, 0.975], axis=0)

    def parts(along: Floats | None, axis: int = 0) -> list[Any]:
        cuts = np.cumsum([len(angle) for angle in angles])[:-1]
        return [None] * len(angles) if along is None else np.split(along, cuts, axis)

    return list(map(Curve, angles, parts(best), parts(latent), parts(ends, 1)))


def maps_picture(fit: Fit) -> Figure | None:
    """Data, model and residual of the first channel over the viewer's hemisphere; None for data that stays in plane."""
    data = fit.problem.data
    if not (shown := mapped(data)):
        return None
    values = np.where(data.mask, data.values[:, 0], np.nan)
    predicted, residuals = bsdf(fit)[:, 0], misfit(fit)[:, 0]
    norm = value_norm(values[data.mask])
    limit = float(np.clip(np.nanquantile(np.abs(residuals), 0.98), 3.0, 30.0))
    model = "with discrepancy" if fit.problem.noise.discrepancy else "model"
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 2.6 * len(shown) + 0.3), layout="constrained")
        panels = figure.subplots(len(shown), 3, squeeze=False)
        for row, incidence in zip(panels, shown, strict=True):
            image = hemisphere_map(row[0], data, incidence, values, norm, "viridis")
            hemisphere_map(row[1], data, incidence, predicted, norm, "viridis")
            signed = hemisphere_map(row[2], data, incidence, residuals, Normalize(-limit, limit), "PuOr")
            for axes, what in zip(row, ("data", model, "residual"), strict=True):
                axes.set_title(f"{incidence.label}: {what}")
        bar: dict[str, Any] = {"shrink": 0.7, "aspect": 30}
        figure.colorbar(image, ax=panels[:, :2].ravel().tolist(), label=value_label(data, 0), **bar)
        figure.colorbar(signed, ax=panels[:, 2].tolist(), label=r"residual / $\sigma$", extend="both", **bar)
    return figure


def corner_picture(posterior: Posterior) -> Figure:
    """Every pair of parameters and every single parameter, over the posterior's samples; lines at the fitted values."""
    import corner

    side = float(np.clip(1.6 * len(posterior.names), 4.0, 11.0))
    with mpl.rc_context(STYLE | {"axes.grid": False, "axes.titlesize": 8}):
        figure = Figure(figsize=(side, side))
        corner.corner(
            np.asarray(posterior.samples),
            labels=list(posterior.names),
            quantiles=(0.16, 0.5, 0.84),
            show_titles=True,
            title_fmt=".3g",
            truths=[posterior.fit.values[name] for name in posterior.names],
            truth_color=CYCLE[1],
            color=CYCLE[0],
            label_kwargs={"fontsize": 8},
            max_n_ticks=3,
            fig=figure,
            quiet=bool(posterior.modes),  # of modes narrower than a bin there are no contours
        )
    return figure
