"""Pictures of measurements, and what all pictures share. A picture is a matplotlib `Figure`, neither shown nor written.

In-plane data is drawn against the signed polar angle of the viewer, positive on the forward (mirror) side; out of
plane, as a map of the viewer's hemisphere with forward to the right. Colours are those of Okabe and Ito, which most
readers with a colour deficiency can distinguish.
"""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fits.data.scans import Incidence, in_plane, incidences, relative_azimuth, signed_angle
from fits.data.totals import KINDS, Totals

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.optimise.result import Fit

INK, GREY = "#222222", "#9a9a9a"
CYCLE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
ANGLE_LABEL = "viewing angle θₒ, degrees (+ forward, $-$ backward)"
LOG_ABOVE = 10.0  # ratio of the largest to the smallest value from which an axis is logarithmic
MOST_CHANNELS, MOST_INCIDENCES = 6, 9  # in one picture, evenly spaced among all
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


# ---- pictures ----


def data_picture(data: "Measurements") -> Figure:
    """What a file holds: in-plane values against angle, one panel per channel, and maps where data leaves the plane.

    Of more than six channels some are shown, evenly spaced and with both ends.
    """
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


def totals_picture(totals: Totals, fit: "Fit | None" = None) -> Figure:
    """A panel for each kind: measured shares of the incident flux, and those of the fit, against the channel, or the
    angle of incidence where there is but one channel; a colour for each angle."""
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
            axes.set_ylim(bottom=0.0)
            axes.set_title("collimated transmittance" if kind == "unscattered" else f"total {kind}")
            marks |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        panels[0].set_ylabel("share of the incident flux")
        figure.legend(list(marks.values()), list(marks), loc="outside lower center", ncols=min(len(marks), 6))
    return figure


# ---- what pictures are made of ----


def evenly_spaced(items: Sequence[Any], most: int) -> list[Any]:
    """At most so many of the items, evenly spaced and with both ends."""
    return [items[place] for place in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def chosen(data: "Measurements") -> list[Incidence]:
    """At most `MOST_INCIDENCES` of the incidences."""
    return evenly_spaced(incidences(data), MOST_INCIDENCES)


def mapped(data: "Measurements") -> list[Incidence]:
    """The incidences whose viewers leave the plane of incidence enough to draw a map, at most four."""
    off_plane = ~in_plane(data) & data.mask
    spread = [incidence for incidence in chosen(data) if np.count_nonzero(off_plane[incidence.rows]) >= 10]
    return evenly_spaced(spread, 4) if spread else []


def value_label(data: "Measurements", channel: int) -> str:
    """The name of an axis of values; it says which channel where there are several."""
    return "BRDF, 1/sr" if len(data.channels) == 1 else f"BRDF {data.channels[channel]}, 1/sr"


def channel_colour(channel: str, index: int) -> str:
    """The channel's own colour for red, green and blue, otherwise the next of the cycle."""
    return {"red": CYCLE[1], "green": CYCLE[2], "blue": CYCLE[0]}.get(channel, CYCLE[index % len(CYCLE)])


def draw_points(
    axes: Axes,
    data: "Measurements",
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
        axes.set_yscale("log")
        axes.set_ylim(low / 1.6, 1.6 * high)
        axes.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    elif low == 0.0 < high:
        axes.set_ylim(0.0, 1.1 * high)
    axes.set_ylabel(label)
    axes.xaxis.set_major_locator(mpl.ticker.MultipleLocator(30.0))


def hemisphere_map(
    axes: Axes, data: "Measurements", incidence: Incidence, values: np.ndarray, norm: Normalize, colours: str
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
