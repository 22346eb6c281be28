"""Extended normals (Guo et al. 2015) beside a Monte Carlo of the same facets: energy and shape, and the figures."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, table, write
from benchmarks.peers import endf_walk as endf_truth
from layerjax.normals.vmf import concentration_of, sphere_density
from layerjax.transport.endf import warping
from layerjax.transport.endf.chains import Form

PATHS, QUICK_PATHS = 1_000_000, 100_000

PAPER, RECIPROCAL = lj.ENDF(form="paper"), lj.ENDF()
FORMS: tuple[Form, ...] = ("paper", "reciprocal")

DIRECT, ONE_BOUNCE = 1, 2
"""Events less one of direct transmission (in and out), and of one bounce (in, off the base, out); two more a bounce."""

MOST_BOUNCES = 4

MIRROR = 0.01, 20.0
"""Index of a base that absorbs 1e-4."""

SLABS = tuple(
    (above, below, angle) for above, below in ((1e3, 1e3), (1e2, 1e2), (1e4, 1e2)) for angle in (0, 45, 60, 75)
)

EXAMPLES = ((1.0, 50.0, 200.0), (float(np.sqrt(0.5)), 100.0, 100.0), (0.5, 200.0, 50.0))
"""Figs. 6 and 7: cosine between the means, kappa of the beam, kappa of the facets."""

BOUNCES = ((1e4, 1e3, 0.0), (1e4, 1e3, 30.0), (1e4, 1e3, 60.0), (1e2, 1e2, 30.0), (1e3, 10.0, 0.0))
"""Fig. 15 (the first three), and rougher ones."""

TINTED = {"kitten": (1e3, 1e3, (0.2, 0.8, 0.8)), "horse": (10.0, 1e6, (0.8, 0.8, 0.2))}
"""Fig. 16: kappa above and below, absorption; a depth of 0.5."""

DEPTH = 0.5

TEXT = """\
# Extended normals beside a Monte Carlo of their facets

{environment}
`ENDF(form="paper")`, the corrected paper, and `ENDF(form="reciprocal")` beside {paths:,} paths through von Mises-Fisher
facets (`benchmarks/peers/endf_walk.py`: plain numpy, Fresnel at every facet, separable masking). *RandomWalk* is the
energy of the same paths, selected by their number of events from as many of the library's own walk
(`lj.goniophotometer`).
*Distance* is the sum of |model - truth| over 41 by 41 cells of the projected lobe by the sum of the truth; *floor* is
what the noise of the truth alone makes of it. Angles in degrees; kappa = 2 / alpha^2, of the coat and of the base.
Standard errors of energies are below {error:.1g}.

## One bounce under a coat on a mirror

The last two are Fig. 17 of the paper; kappa 10 over 1e6 is the horse of Fig. 16 without absorption.

{coats}
## Direct transmission through a slab of index 1.5

{slabs}
## Figs. 6 and 7: concentration of a beam after rough reflection and refraction at index 1.5

*Exact* is the concentration with the exact mean resultant length: in closed form for reflection, by Monte Carlo for
refraction (last digit uncertain). *Paper*: Eqs. 18 and 21, and what they are off; *first order* the mean of both axes'
variances for refraction (for reflection the exact form). *Normals*: the extended ones, Eqs. 19 and 22. *Peak*: the
density in the mean direction by quadrature (Eqs. 16 and 20), and that of the paper's single lobe.

{warping}
## Fig. 15: bounce by bounce, index 1.5

Energies on a mirror. From the second bounce on total reflection traps light where surfaces are rough, and lets it out
later than the model says.

{bounces}
## Fig. 16: light absorption

Albedo of coats of index 1.5 with an absorbing medium of depth {depth} on a mirror, surface and one bounce, per channel;
Weidlich & Wilkie 2007 with GGX facets of the same widths.

{tinted}
Fig. 14 is not here: the text does not give its roughnesses. Figs. 1, 17 (other than above) and 18 are pictures.
"""


def study(
    quick: bool = False, report: Callable[[str], None] = print, directory: Path = DIRECTORY
) -> tuple[str, Sequence[Path]]:
    """Measure, and write ``endf.md`` and ``endf.json``. quick: fewer paths."""
    paths = QUICK_PATHS if quick else PATHS
    results: dict[str, list[dict[str, Any]]] = {}
    for name, measure in (
        ("coats", _coats),
        ("slabs", _slabs),
        ("warping", _warping),
        ("bounces", _bounces),
        ("tinted", _tinted),
    ):
        report(name)
        results[name] = measure(paths)
    around = environment.describe()
    error = max(row["error"] for name in ("coats", "slabs", "bounces", "tinted") for row in results[name])
    tables = {name: _table(rows) for name, rows in results.items()}
    text = TEXT.format(environment=environment_lines(around), paths=paths, error=error, depth=DEPTH, **tables)
    content = {"environment": around, "paths": paths, **results}
    return text, write("endf", content, text, directory)


def _coats(paths: int) -> list[dict[str, Any]]:
    rows = []
    for above, below, angle, ior in endf_truth.TABLE:
        reflectance = endf_truth.conductor(MIRROR[0] / ior, MIRROR[1] / ior)
        (truth,) = endf_truth.coat(ior, above, below, angle, paths, reflectance=reflectance)
        bare = _values(_coat(above, below, ior), angle, lj.ENDF(bounces=0))
        rows.append(
            {"kappa": _named(above, below), "angle": angle, "index": ior}
            | _compared(truth, _coat(above, below, ior), angle, bare, paths)
        )
    return rows


def _slabs(paths: int) -> list[dict[str, Any]]:
    rows = []
    for above, below, angle in SLABS:
        truth = endf_truth.slab(1.5, above, below, angle, paths)
        stack = lj.Stack([_face(1.5, above), _face(1.0, below)])
        rows.append({"kappa": _named(above, below), "angle": angle} | _compared(truth, stack, angle, None, paths))
    return rows


def _compared(truth: endf_truth.Walked, stack: lj.Stack, angle: float, bare: Any, paths: int) -> dict[str, Any]:
    """Energy and shape of the lobe below the surface (`bare`: values of the surface) or of what passes (None)."""
    wi = lj.direction(np.radians(angle), 0.0)
    lobe = endf_truth.lobe(truth)
    energies, distances = {}, {}
    for form in FORMS:
        transport = lj.ENDF(0 if bare is None else 1, form)
        near, far = lj.albedo(stack, wi, transport)
        if bare is None:
            energies[form] = float(far[0])
            values = _values(stack, angle, transport, below=True)
            distances[form] = lobe.distance(values)
        else:
            energies[form] = float(near[0] - lj.albedo(stack, wi, lj.ENDF(bounces=0))[0][0])
            both = _values(stack, angle, transport)
            distances[form] = lobe.distance(_difference(both, bare))
    energy, error = truth.energy
    reflected, transmitted = _walked(stack, angle, paths)
    walk, noise = transmitted[DIRECT] if bare is None else reflected[ONE_BOUNCE]
    return {
        "Monte Carlo": energy,
        "RandomWalk": walk,
        "error": max(error, noise),
        **{f"energy, {form}": value for form, value in energies.items()},
        **{f"distance, {form}": value for form, value in distances.items()},
        "floor": lobe.floor,
    }


def _warping(paths: int) -> list[dict[str, Any]]:
    rows = []
    ior = jnp.asarray(1.5)
    for kind in ("reflection", "refraction"):
        for number, (cosine, beam, facets) in enumerate(EXAMPLES, 1):
            c, o, m = (jnp.asarray(value) for value in (cosine, beam, facets))
            if kind == "reflection":
                kappa, gains = warping.reflect_beam(o, m, c), warping.reflection_gains(c)
                exact = first = warping.reflected_moment(o, m, c)
            else:
                kappa, gains = warping.refract_beam(o, m, c, ior), warping.refraction_gains(c, ior)
                length = jnp.asarray(endf_truth.warped(kind, cosine, beam, facets, 1.5, paths))
                exact, first = concentration_of(length, 1.0 - length), warping.refraction_trace(o, m, c, ior)
            peak = endf_truth.peak(kind, cosine, beam, facets, 1.5)
            row: dict[str, Any] = {"exact": exact, "paper": kappa, "off": kappa / exact - 1.0, "first order": first}
            row |= {
                "normals": warping.extended_concentration(kappa, gains),
                "peak": peak,
                "peak, paper": sphere_density(c * 0, kappa),
            }
            rows.append({"": f"{kind} {number}"} | {name: float(value) for name, value in row.items()})
    return rows


def _bounces(paths: int) -> list[dict[str, Any]]:
    rows = []
    for above, below, angle in BOUNCES:
        reflectance = endf_truth.conductor(MIRROR[0] / 1.5, MIRROR[1] / 1.5)
        truth = endf_truth.coat(1.5, above, below, angle, paths, bounces=MOST_BOUNCES, reflectance=reflectance)
        wi, stack = lj.direction(np.radians(angle), 0.0), _coat(above, below, 1.5)
        sums = {
            form: [float(lj.albedo(stack, wi, lj.ENDF(k, form))[0][0]) for k in range(MOST_BOUNCES + 1)]
            for form in FORMS
        }
        near, _ = _walked(stack, angle, paths)
        for k, order in enumerate(truth, 1):
            energy, error = order.energy
            walk, noise = near[ONE_BOUNCE + 2 * (k - 1)]
            row = {"kappa": _named(above, below), "angle": angle, "bounce": k}
            row |= {"Monte Carlo": energy, "RandomWalk": walk, "error": max(error, noise)}
            rows.append(row | {form: sums[form][k] - sums[form][k - 1] for form in FORMS})
    return rows


def _tinted(paths: int) -> list[dict[str, Any]]:
    rows = []
    for name, (above, below, absorption) in TINTED.items():
        tint = lj.Medium([DEPTH * value for value in absorption], 0.0)
        coat = lj.Stack([_face(1.5, above), tint], _mirror(below))
        rough = lj.Stack([lj.Interface(1.5, _width(above))], lj.Conductor(*MIRROR, _width(below)))
        ggx = lj.Stack([rough.layers[0], tint], rough.base)
        reflectance = endf_truth.conductor(MIRROR[0] / 1.5, MIRROR[1] / 1.5)
        for angle in (0.0, 30.0, 60.0):
            wi = lj.direction(np.radians(angle), 0.0)
            top, noise = endf_truth.surface(1.5, above, angle, paths).energy
            models: dict[str, Any] = {form: lj.albedo(coat, wi, lj.ENDF(1, form))[0] for form in FORMS}
            models["Weidlich & Wilkie"] = lj.albedo(ggx, wi, lj.WeidlichWilkie())[0]
            for channel, sigma in enumerate(sorted(set(absorption))):
                place = absorption.index(sigma)
                depth = DEPTH * sigma
                (order,) = endf_truth.coat(
                    1.5, above, below, angle, paths, depth=depth, reflectance=reflectance, seed=channel
                )
                energy, error = order.energy
                row = {"": name, "angle": angle, "absorption": sigma, "Monte Carlo": top + energy}
                row |= {"error": float(np.hypot(noise, error))}
                rows.append(row | {model: float(values[place]) for model, values in models.items()})
    return rows


def _walked(stack: lj.Stack, angle: float, paths: int) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Energies and their errors by the number of events less one, reflected and transmitted."""
    wi, key = lj.direction(np.radians(angle), 0.0), jax.random.key(0)
    seen = lj.goniophotometer(stack, wi, key=key, paths=paths, polar=1, azimuth=1, orders=2 * MOST_BOUNCES + 2)
    sides = np.stack([np.asarray(seen.orders)[..., 0], np.asarray(seen.orders_error)[..., 0]], axis=-1).tolist()
    return sides[0], sides[1]


def _values(stack: lj.Stack, angle: float, transport: lj.Transport, below: bool = False) -> Any:
    """The lobe as a function of directions above, mirrored down if it lies there."""
    prepared, wi = lj.prepare(stack, transport), lj.direction(np.radians(angle), 0.0)
    return lambda wo: np.asarray(lj.evaluate(prepared, wi, wo * [1.0, 1.0, -1.0 if below else 1.0]))[:, 0]


def _difference(one: Any, other: Any) -> Any:
    return lambda w: one(w) - other(w)


def _coat(above: float, below: float, ior: float) -> lj.Stack:
    return lj.Stack([_face(ior, above)], _mirror(below))


def _face(ior: float, kappa: float) -> lj.Interface:
    return lj.Interface(ior, _width(kappa), distribution="vmf")


def _mirror(kappa: float) -> lj.Conductor:
    return lj.Conductor(*MIRROR, _width(kappa), distribution="vmf")


def _named(above: float, below: float) -> str:
    return f"{above:g} on {below:g}".replace("e+0", "e")


def _width(kappa: float) -> float:
    return float(np.sqrt(2.0 / kappa))


def _table(rows: Sequence[dict[str, Any]]) -> str:
    names = [name for name in rows[0] if name != "error"]
    return table(names, [[_cell(name, row[name]) for name in names] for row in rows])


def _cell(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name in ("angle", "index", "bounce", "absorption"):
        return f"{value:g}"
    if name == "off":
        return f"{100 * value:+.1f} %"
    return f"{value:.4f}" if value < 3 else f"{value:.2f}"
