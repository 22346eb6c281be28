"""Pictures of data, alone and beside models: matplotlib figures that are neither shown nor written.

In-plane data is drawn against the signed polar angle of the viewer, positive on the forward (mirror) side; out of
plane, as a map of the viewer's hemisphere with forward to the right. Colours are those of Okabe and Ito.
"""

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fits.data.geometry import Floats, direction
from fits.data.measurements import Measurements
from fits.data.scans import Incidence, in_plane, incidences, relative_azimuth, signed_angle
from fits.data.totals import KINDS, Totals
from fits.optimise.result import Fit
from fits.prediction.predict import Prediction, with_discrepancy
from fits.problem.model import Model
from fits.reports.verdicts import over_all_rows, residual_unit
from fits.sampling.posterior import Posterior

INK, GREY = "#222222", "#9a9a9a"
CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
ANGLE_LABEL = "viewing angle θₒ, degrees (+ forward, $-$ backward)"
LOG_ABOVE = 10.0  # ratio of the largest to the smallest value from which an axis is logarithmic
MOST_CHANNELS, MOST_INCIDENCES = 6, 9  # in one picture, evenly spaced among all
INTERVAL_DRAWS = 200  # posterior draws behind an interval
STEEPEST = 89.9  # degrees: in the tangent plane every BRDF of a stack is 0
STEP = 1.0  # degrees between the points of a model curve
FEWEST_IN_PLANE = 3  # measurements that make a panel
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


def as_png(figure: Figure, trimmed: bool = True) -> bytes:
    """The figure as the content of a PNG file. trimmed: without empty margins, else of the size that it has."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130, bbox_inches="tight" if trimmed else None)
    return buffer.getvalue()


# ---- data ----


def data_picture(data: Measurements) -> Figure:
    """What a file holds: in-plane values against angle, a panel for each of six channels, and maps out of plane."""
    data = data.of_channels(evenly_spaced(data.channels, MOST_CHANNELS))
    flat, shown, maps = in_plane(data), chosen(data), mapped(data)
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.85, len(shown)))  # dark to light
    sizes = [3.6] * bool(flat.any()) + [2.6] * bool(maps)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, sum(sizes)), layout="constrained")
        parts = np.ravel(figure.subfigures(len(sizes), 1, height_ratios=sizes, squeeze=False))
        if flat.any():
            panels = parts[0].subplots(1, len(data.channels), sharey=True, squeeze=False)[0]
            for channel, axes in enumerate(panels):
                for incidence, colour in zip(shown, map(mpl.colors.to_hex, colours), strict=True):
                    rows = incidence.rows[flat[incidence.rows]]
                    draw_points(axes, data, rows, channel, colour, incidence.label, data.sigma)
                value_axis(axes, data.values[flat], value_label(data, channel))
            if panels[0].get_legend_handles_labels()[0]:
                panels[0].legend(loc="best", ncols=2 if len(shown) > 4 else 1)
            parts[0].supxlabel(ANGLE_LABEL, fontsize="medium")
        if maps:
            values = np.where(data.mask, data.values[:, 0], np.nan)
            norm = value_norm(values[data.mask])
            panels = parts[-1].subplots(1, len(maps), squeeze=False)[0]
            for panel, incidence in zip(panels, maps, strict=True):
                image = hemisphere_map(panel, data, incidence, values, norm, "viridis")
            parts[-1].colorbar(image, ax=list(panels), label=value_label(data, 0), shrink=0.8)
    return figure


def totals_picture(totals: Totals, fit: Fit | None = None) -> Figure:
    """A panel for each kind of share of the incident flux: measured and fitted, against channel or angle."""
    kinds, channels = [kind for kind in KINDS if kind in totals.kinds], totals.channels
    angles, single = sorted(set(totals.theta_i)), len(channels) == 1
    marks: dict[str, Any] = {}
    predicted = np.full(totals.values.shape, np.nan)
    if fit is not None:
        predicted[totals.mask] = fit.predicted
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.2), layout="constrained")
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            own = np.flatnonzero([one == kind for one in totals.kinds])
            own = own[np.argsort(totals.theta_i[own], kind="stable")]
            for rows in own[None] if single else own[:, None]:
                x, angle = totals.theta_i[rows] if single else np.arange(len(channels)), totals.theta_i[rows[0]]
                label = "" if single or len(angles) == 1 else f" at {angle:g}°"
                sigma = None if totals.sigma is None else totals.sigma[rows].ravel()
                points: dict[str, Any] = {"fmt": "o", "color": INK, "markersize": 3, "capsize": 2}
                axes.errorbar(x, totals.values[rows].ravel(), sigma, label=f"measured{label}", **points)
                if fit is not None:
                    colour = CYCLE[0 if single else angles.index(angle) % len(CYCLE)]
                    shape = "-" if len(x) > 1 else "x"
                    axes.plot(x, predicted[rows].ravel(), shape, color=colour, label=f"fit{label}")
            if single:
                axes.set_xlabel("angle of incidence, degrees")
            else:
                ticks = range(0, len(channels), -(-len(channels) // 12))
                axes.set_xticks(ticks, [channels[place] for place in ticks], rotation=45, ha="right")
            axes.margins(y=0.1)
            title = "collimated transmittance" if kind == "unscattered" else f"total {kind}"
            axes.set(ylim=(0.0, None), title=title)
            marks |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        panels[0].set_ylabel("share of the incident flux")
        figure.legend(list(marks.values()), list(marks), loc="outside lower center", ncols=min(len(marks), 6))
    return figure


# ---- fits and predictions ----


def misfit(fit: Fit) -> np.ndarray:
    """Measurements less the model with its discrepancy, which follows them, in units of the noise, (N, C); NaN in
    unused rows."""
    independent = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
    return over_all_rows(fit, independent / residual_unit(fit))


class Curve(NamedTuple):
    """A model along one incidence: angles (M,), BSDF (M, C), that without discrepancy, and an interval, (2, M, C)."""

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
    """A panel for each incidence with data, their sigma (N, C) and models, and residuals (N, C) of each below."""
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
    used, residuals = data.used(), misfit(fit)[:, 0]
    predicted = over_all_rows(fit, with_discrepancy(fit, used.wi, used.wo, fit.predicted))[:, 0]
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


# ---- what pictures are made of ----


def evenly_spaced(items: Sequence[Any], most: int) -> list[Any]:
    """At most so many of the items, evenly spaced and with both ends."""
    return [items[place] for place in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def chosen(data: Measurements) -> list[Incidence]:
    """At most `MOST_INCIDENCES` of the incidences."""
    return evenly_spaced(incidences(data), MOST_INCIDENCES)


def mapped(data: Measurements) -> list[Incidence]:
    """The incidences whose viewers leave the plane of incidence enough to draw a map, at most four."""
    off_plane = ~in_plane(data) & data.mask
    spread = [incidence for incidence in chosen(data) if np.count_nonzero(off_plane[incidence.rows]) >= 10]
    return evenly_spaced(spread, 4) if spread else []


def value_label(data: Measurements, channel: int) -> str:
    """The name of an axis of values; it says which channel where there are several."""
    return "BRDF, 1/sr" if len(data.channels) == 1 else f"BRDF {data.channels[channel]}, 1/sr"


def channel_colour(channel: str, index: int) -> str:
    """The channel's own colour for red, green and blue, otherwise the next of the cycle."""
    return {"red": CYCLE[1], "green": CYCLE[2], "blue": CYCLE[0]}.get(channel, CYCLE[index % len(CYCLE)])


def draw_points(
    axes: Axes,
    data: Measurements,
    rows: np.ndarray,
    channel: int,
    colour: str,
    label: str,
    sigma: np.ndarray | None = None,
) -> None:
    """Values of `rows` against the signed angle, with error bars from `sigma` (N, C); grey where they are not used."""
    style: dict[str, Any] = {"fmt": "o", "markersize": 2.5 if len(rows) > 60 else 3.5, "markeredgewidth": 0.0}
    style, signed = style | {"elinewidth": 0.6, "zorder": 2}, signed_angle(data)
    used, others = rows[data.mask[rows]], rows[~data.mask[rows]]
    if used.size:
        errors, pale = None if sigma is None else sigma[used, channel], mpl.colors.to_rgba(colour, 0.35)
        points = signed[used], data.values[used, channel], errors
        axes.errorbar(*points, color=colour, ecolor=pale, label=label, **style)
    if others.size:
        axes.errorbar(signed[others], data.values[others, channel], color=GREY, **style)


def value_norm(values: np.ndarray) -> Normalize:
    """A logarithmic scale where the positive values span more than `LOG_ABOVE`, else one that includes zero."""
    positive = values[values > 0.0]
    if positive.size and positive.max() > LOG_ABOVE * positive.min():
        return LogNorm(positive.min(), positive.max())
    return Normalize(float(np.min(values, initial=0)), float(np.max(values)) if values.size else 0.0)


def value_axis(axes: Axes, values: np.ndarray, label: str) -> None:
    """An axis of values by the scale of `value_norm`, and angles on the other."""
    norm = value_norm(values)
    low, high = norm.vmin or 0.0, norm.vmax or 0.0
    if isinstance(norm, LogNorm):
        axes.set(yscale="log", ylim=(low / 1.6, 1.6 * high))
        axes.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    elif low == 0.0 < high:
        axes.set_ylim(0.0, 1.1 * high)
    axes.set_ylabel(label)
    axes.xaxis.set_major_locator(mpl.ticker.MultipleLocator(30.0))


def hemisphere_map(
    axes: Axes, data: Measurements, incidence: Incidence, values: np.ndarray, norm: Normalize, colours: str
) -> ScalarMappable:
    """Draws `values` (N,) of one incidence over the viewer's hemisphere: forward to the right, rings every 30 degrees.

    Points are as large as there is room between them; what is NaN, or not positive on a logarithmic scale, is blank.
    """
    rows = incidence.rows[np.isfinite(values[incidence.rows])]
    rows = rows[values[rows] > 0.0] if isinstance(norm, LogNorm) else rows
    radius = np.minimum(data.theta_o, 180.0 - data.theta_o)[rows]  # transmission is drawn from below
    azimuth = np.radians(relative_azimuth(data)[rows])
    size = np.clip(24_000.0 / max(len(rows), 1), 1.0, 30.0)  # square points
    x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
    image = axes.scatter(x, y, c=values[rows], norm=norm, cmap=colours, s=size, linewidths=0.0)
    for ring in (30.0, 60.0, 90.0):
        axes.add_patch(Circle((0.0, 0.0), ring, fill=False, color=GREY, linewidth=0.5))
    axes.plot([-incidence.theta], [0.0], "*", color="white", markeredgecolor=INK, markersize=8, clip_on=False)
    axes.set(aspect="equal", xlim=(-94.0, 94.0), ylim=(-94.0, 94.0), title=f"{incidence.label} (light: star)")
    axes.set_axis_off()
    return image
