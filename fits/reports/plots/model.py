"""Pictures of a fit, and of predictions, beside data, and of its parameters."""

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from fits.data.geometry import Floats, direction
from fits.data.scans import Incidence, in_plane, signed_angle
from fits.prediction.predict import with_discrepancy
from fits.problem.model import Model
from fits.reports.plots.data import (
    ANGLE_LABEL,
    CYCLE,
    GREY,
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

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.optimise.result import Fit
    from fits.prediction.predict import Prediction
    from fits.sampling.posterior import Posterior

INTERVAL_DRAWS = 200  # posterior draws behind an interval
STEEPEST = 89.9  # degrees: in the tangent plane every BRDF of a stack is 0
STEP = 1.0  # degrees between the points of a model curve
FEWEST_IN_PLANE = 3  # measurements that make a panel


def bsdf(fit: "Fit") -> np.ndarray:
    """Predicted BSDF at every row, with the model discrepancy, (N, C), in 1/sr; NaN in unused rows."""
    used = fit.problem.data.used()
    return over_all_rows(fit, with_discrepancy(fit, used.wi, used.wo, fit.predicted))


def misfit(fit: "Fit") -> np.ndarray:
    """Measurements less `bsdf`, in units of the noise, (N, C); NaN in rows that were not used.

    With a model discrepancy these are smaller than the noise, since it follows the data: `standardised` are not.
    """
    independent = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
    return over_all_rows(fit, independent / residual_unit(fit))


def curves_picture(fits: "dict[str, Fit]", posterior: "Posterior | None" = None) -> Figure | None:
    """Data and models per incidence against the signed viewing angle, with residuals in units of sigma below each.

    With a model discrepancy there are two curves, with and without it; residuals are of the first.

    fits: one or more fits of the same data by name; the points and their errors are those of the first one.
    posterior: adds the central interval of 95 % of its draws, of the stack without discrepancy and noise, to the first.
    Every incidence has an axis of its own: linear, or logarithmic where its values span a wide range.
    None where no incidence has at least three measurements in the plane of incidence.
    """
    first = next(iter(fits.values()))
    data, signed = first.problem.data, signed_angle(first.problem.data)
    shown = _in_plane(data)
    if not shown:
        return None
    curves = {name: _curves(fit, shown, posterior if fit is first else None) for name, fit in fits.items()}
    residuals = {name: misfit(fit) for name, fit in fits.items()}
    columns = 1 if len(shown) == 1 else 2 if len(shown) <= 4 else 3
    blocks = -(-len(shown) // columns)
    coloured = len(data.channels) > 1 and len(fits) == 1  # by channel, else by fit
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
            _points(upper, first, rows, coloured)
            for place, name in enumerate(fits):
                for channel, channel_name in enumerate(data.channels):
                    colour = channel_colour(channel_name, channel) if coloured else CYCLE[place % len(CYCLE)]
                    label = None if channel else "model" if len(fits) == 1 else name
                    _line(upper, curves[name][index], channel, colour, label, place)
                    points: dict[str, Any] = {"markersize": 2.2, "color": colour, "markeredgewidth": 0.0}
                    lower.plot(signed[rows], residuals[name][rows, channel], "o", **points)
            value_axis(upper, data.values[rows[data.mask[rows]]], "BRDF, 1/sr" if column == 0 else "")
            upper.set_title(incidence.label)
            upper.tick_params(labelbottom=False)
            unit = r"$\sigma$" if first.is_posterior else "scatter"
            lower.set_ylabel(f"residual / {unit}" if column == 0 else "")
        figure.supxlabel(ANGLE_LABEL, fontsize="medium")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def _in_plane(data: "Measurements") -> list[Incidence]:
    """Incidences that have a panel, with their rows in the plane of incidence."""
    flat = in_plane(data)
    enough = [one for one in chosen(data) if np.count_nonzero((flat & data.mask)[one.rows]) >= FEWEST_IN_PLANE]
    return [Incidence(one.theta, one.phi, one.rows[flat[one.rows]]) for one in enough]


def _curves(fit: "Fit", shown: list[Incidence], posterior: "Posterior | None") -> list[tuple[Any, ...]]:
    """The model along each incidence, all of them predicted at once.

    Viewing angles (M,), BSDF (M, C), that of the stack without the model discrepancy, and the ends of an interval of
    the latter, (2, M, C); None where there is no discrepancy, or no posterior.
    """
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
    values = np.broadcast_to(
        values, (*values.shape[:2], len(fit.problem.data.channels))
    )  # a grey stack is the same in all

    def parts(along: Floats | None, axis: int = 0) -> list[Any]:
        cuts = np.cumsum([len(angle) for angle in angles])[:-1]
        return [None] * len(angles) if along is None else np.split(along, cuts, axis)

    best, latent = with_discrepancy(fit, wi, wo, values[0]), values[0] if fit.problem.noise.discrepancy else None
    interval = None if posterior is None else np.quantile(values[1:], [0.025, 0.975], axis=0)
    return list(zip(angles, parts(best), parts(latent), parts(interval, 1), strict=True))


def _points(axes: Axes, fit: "Fit", rows: np.ndarray, coloured: bool) -> None:
    """The data of an incidence, with the noise that the fit assumed."""
    data, what, sigma = fit.problem.data, "data", None
    if fit.is_posterior:
        assumed = np.asarray(fit.problem.call(Model.sigma_at, fit.vector, fit.predicted))
        what, sigma = r"data and $\sigma$ of the noise model", over_all_rows(fit, assumed)
    used = data.mask[rows]
    for channel, name in enumerate(data.channels):
        colour = channel_colour(name, channel) if coloured else INK
        label = f"{what}, {name}" if len(data.channels) > 1 else what
        draw_points(axes, data, rows[used], channel, colour, label, sigma)
        draw_points(axes, data, rows[~used], channel, GREY, None if channel else "not used")


def _line(axes: Axes, curve: tuple[Any, ...], channel: int, colour: str, label: str | None, place: int) -> None:
    """One channel of a model, labelled for the legend where it is the first."""
    angle, values, latent, interval = curve
    what = label if label is None or latent is None else f"{label} with discrepancy"
    axes.plot(angle, values[:, channel], color=colour, linewidth=1.3, label=what, zorder=3)
    if latent is not None:
        what = "without discrepancy" if label and not place else None
        axes.plot(angle, latent[:, channel], "--", color=colour, linewidth=1.0, label=what, zorder=3)
    if interval is not None:
        which = ", without discrepancy" if latent is not None else ""
        what = f"95 % of the posterior{which}" if label else None
        low, high = interval[:, :, channel]
        axes.fill_between(angle, low, high, color=colour, alpha=0.3, linewidth=0.0, label=what, zorder=2.5)


def maps_picture(fit: "Fit", channel: int = 0) -> Figure | None:
    """Data, model and residual over the viewer's hemisphere, a row per incidence; None for data that stays in plane."""
    data = fit.problem.data
    shown = mapped(data, chosen(data))
    if not shown:
        return None
    values = np.where(data.mask, data.values[:, channel], np.nan)
    predicted, residuals = bsdf(fit)[:, channel], misfit(fit)[:, channel]
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
        figure.colorbar(image, ax=panels[:, :2].ravel().tolist(), label=value_label(data, channel), **bar)
        label = rf"(data $-$ {model}) / $\sigma$" if fit.is_posterior else "residual / its scatter"
        figure.colorbar(signed, ax=panels[:, 2].tolist(), label=label, extend="both", **bar)
    return figure


def prediction_picture(prediction: "Prediction", data: "Measurements") -> Figure | None:
    """Held-out data and their prediction intervals, a column for each incidence and a row for each channel.

    prediction: of the used data, with levels 0.025, 0.25, 0.5, 0.75 and 0.975.
    None where no incidence has at least three measurements in the plane of incidence.
    """
    used = data.used()
    shown, signed, channels = _in_plane(used), signed_angle(used), len(used.channels)
    if not shown:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.0 * channels), layout="constrained")
        grid = figure.subplots(channels, len(shown), squeeze=False, sharex="col")
        for (channel, column), axes in np.ndenumerate(grid):
            rows = shown[column].rows
            rows = rows[np.argsort(signed[rows], kind="stable")]
            angle = signed[rows]
            low, quarter, middle, three, high = prediction.predictive.quantiles[:, rows, channel]
            latent = prediction.latent.quantiles[2, rows, channel]
            fill: dict[str, Any] = {"color": CYCLE[0], "linewidth": 0}
            axes.fill_between(angle, low, high, alpha=0.2, label="95 % prediction interval", **fill)
            axes.fill_between(angle, quarter, three, alpha=0.35, label="50 %", **fill)
            axes.plot(angle, middle, color=CYCLE[0], linewidth=1.2, label="median")
            axes.plot(angle, latent, color=CYCLE[1], linewidth=1.0, linestyle="dashed", label="without discrepancy")
            axes.plot(angle, used.values[rows, channel], ".", color=INK, markersize=3, label="measurements")
            value_axis(axes, used.values[rows], value_label(used, channel) if column == 0 else "")
            axes.set_title("" if channel else shown[column].label)
        figure.supxlabel(ANGLE_LABEL, fontsize="medium")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def corner_picture(posterior: "Posterior") -> Figure:
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


def correlation_picture(fit: "Fit") -> Figure:
    """The correlation matrix of the fitted parameters, with its numbers."""
    names, matrix = list(fit.values), np.round(fit.correlation, 2)
    side = float(np.clip(0.75 * len(names) + 2.0, 3.5, 9.0))
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(side + 0.8, side), layout="constrained")
        axes = figure.subplots()
        image = axes.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(names)), names)
        for (row, column), value in np.ndenumerate(matrix):
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(column, row, f"{value + 0.0:.2f}", ha="center", va="center", fontsize=8, color=colour)
        figure.colorbar(image, ax=axes, label="correlation", shrink=0.8)
    return figure
