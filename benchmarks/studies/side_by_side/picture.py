"""The picture of the side-by-side page: the BSDF in the plane of incidence by every transport, a panel a family."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import layerjax as lj
from benchmarks.studies.error_vs_time.models import Model, supports
from benchmarks.studies.error_vs_time.truth import REFERENCES
from benchmarks.suite.cases import FAMILIES, Case
from fits.reports.plots.data import CYCLE, INK, STYLE, as_png

SHOWN = {
    "plastics_and_paints": "coated_sand",
    "coated_metals": "thin_layer_rough",
    "fabrics_and_fibers": "window_shade",
    "leaves_and_wood": "plant",
    "transmitting_slabs": "rough_glass_slab",
    "thick_and_conservative": "white_paint",
    "grazing_light": "grazing_conductor",
    "smooth_surfaces": "opal_pane",
    "brushed_surfaces": "lacquer_on_brushed_metal",
}
"""The stack of each family that is drawn."""

INCIDENCE = np.radians(50.0)
AZIMUTH = np.radians(25.0)
VIEWS = np.linspace(-85.0, 85.0, 171)
PATHS = 4096
COLUMNS = 4


def draw(models: Sequence[Model], cases: Sequence[Case], report: Callable[[str], None], panels: int | None) -> bytes:
    """PNG of the first channel times the cosine of the view, light from the left; panels: the first few alone."""
    by_name = {case.name: case for case in cases}
    shown = [by_name[name] for name in SHOWN.values() if name in by_name][:panels]
    wi = lj.direction(INCIDENCE, AZIMUTH)
    views = np.radians(VIEWS)
    wo = lj.direction(jnp.abs(jnp.asarray(views)), jnp.where(jnp.asarray(views) < 0, AZIMUTH, AZIMUTH + np.pi))
    columns = min(COLUMNS, len(shown) + 1)
    lines = -(-(len(shown) + 1) // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.4 * columns, 2.9 * lines + 0.3), layout="constrained")
        axes = np.ravel(figure.subplots(lines, columns, squeeze=False))
        seen = {}
        for panel, case in zip(axes, shown, strict=False):
            cosine = np.cos(views)
            truth = np.asarray(lj.evaluate(case.stack, wi, wo, REFERENCES.truth))[:, 0] * cosine
            (seen["truth"],) = panel.plot(VIEWS, truth, color=INK, linewidth=2.4, alpha=0.5)
            for index, model in enumerate(models):
                transport = list(model.steps.values())[-1]
                if transport == REFERENCES.truth or not supports(transport, case.stack):
                    continue
                key = jax.random.key(0) if transport.random else None
                if isinstance(transport, lj.RandomWalk):
                    transport = lj.RandomWalk(paths=PATHS)
                values = np.asarray(lj.evaluate(case.stack, wi, wo, transport, key=key))[:, 0] * cosine
                colour, line = CYCLE[index % len(CYCLE)], ("-", "--")[index // len(CYCLE)]
                (seen[model.name],) = panel.plot(VIEWS, values, line, color=colour, linewidth=1.2)
            panel.set(title=f"{FAMILIES[case.family]}\n{case.name}", yscale="log", xlabel="view, degrees")
            panel.set_ylim(max(truth.max() * 1e-4, 0.5 * truth[truth > 0].min()), 3.0 * truth.max())
            jax.clear_caches()
            report(f"drawn: {case.name}")
        for panel in axes[len(shown) :]:
            panel.axis("off")
        axes[len(shown)].legend(seen.values(), seen.keys(), loc="center left")
        figure.supylabel("BSDF times cosine of the view, 1/sr", size=9)
    return as_png(figure)
