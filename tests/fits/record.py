"""A record of what `fits` finds on the shipped data and examples, to compare a changed `fits` with.

    python -m tests.fits.record write [CASE ...]      # computes the cases (all by default) and keeps them
    python -m tests.fits.record check [CASE ...]      # computes them again, and prints and counts what differs

The numbers stand in `tests/data/record.json`, how far they may differ in `LIMITS`. A chi-square follows the noise of
the optimum to first order: moved by 0.01 standard errors, it changes by 0.014 of its own standard deviation, a
thousandth with 200 degrees of freedom. Predictions are means of 256 draws: four standard errors of the difference of
two are 0.35 sd. Every case takes from seconds to minutes, which is why no test runs them.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import fits
import layerjax as lj
from tests.helpers.places import COATINGS, EXAMPLES

RECORD = Path(__file__).parents[1] / "data" / "record.json"
STARTS = 4
COATED = lj.Stack([lj.Interface(1.5, 0.2)], lj.Lambertian(0.4))
GEOMETRY = fits.slices(incidence=(10.0, 40.0, 70.0), outgoing=np.arange(-80.0, 81.0, 10.0))


def of_fit(fit: Any) -> dict[str, Any]:
    found = {name: getattr(fit, name) for name in ("cost", "values", "standard_errors", "reduced_chi_square")}
    found["unidentified"] = [sorted(direction.weights) for direction in fit.unidentified]
    return found | {"at_bound": sorted(fit.at_bound), "insensitive": sorted(fit.insensitive)}


def example(name: str, data: Path, incidence: tuple[float, ...] | None = None) -> Any:
    """The fit of a stack file of `examples` to a file of data."""
    problem, measured = fits.read_problem(EXAMPLES / f"{name}.toml"), fits.read(data)
    measured = measured if incidence is None else measured.select(incidence=incidence)
    given = {name: getattr(problem, name) for name in ("transport", "noise", "scale")}
    return fits.fit(problem.stack, measured, starts=STARTS, **given)


def held_out() -> dict[str, Any]:
    """A hazy coat on two incidences of a paint, and its prediction of the other two."""
    data = COATINGS / DATA["aeroglaze"]
    fit = example("coated_diffuse", data, (10.0, 50.0))
    seen = fits.predict(fit, fits.read(data).select(incidence=[30.0, 70.0]))
    ends = {"mean": seen.mean, "low": seen.quantile(0.025), "high": seen.quantile(0.975)}
    every_tenth = {name: values[::10].ravel().tolist() for name, values in ends.items()}
    return of_fit(fit) | {"prediction": every_tenth | {"median_error": seen.scores.median_error}}


def joint() -> dict[str, Any]:
    """One coating in two measurements."""
    import joint_steel

    return of_fit(fits.fit(fits.Joint(joint_steel.problems(), shared=joint_steel.SHARED), starts=STARTS))


def slab() -> dict[str, Any]:
    """A slab by scans and by an integrating sphere."""
    import measured_quantities as quantities

    def of(mu_s: Any, mu_a: Any, g: Any) -> Any:
        return lj.Stack([lj.TurbidMedium(1.0, mu_s, mu_a, lj.HenyeyGreenstein(g))])

    solver, noise = lj.AddingDoubling(nodes=8, modes=4), fits.Noise(relative=0.02, floor=1e-6)
    free = of(fits.Free(1.0, 0.1, 20.0), fits.Free(0.3, 0.0, 5.0), fits.Free(0.0, -0.9, 0.9))
    scans = fits.Problem(free, quantities.simulated(of(2.0, 0.1, 0.5), solver), solver, noise)
    parts = {"scans": scans, "sphere": quantities.sphere(free, 0.30, 0.55, solver)}
    return of_fit(fits.fit(fits.Joint(parts, shared=["layers"]), starts=STARTS))


def mixture() -> dict[str, Any]:
    """A metal that a coat covers in part."""
    import measured_quantities as quantities

    def partly(covered: Any, alpha: Any) -> Any:
        metal = lj.Stack([], lj.Conductor(0.2, 3.9, alpha))
        return lj.Mixture({"coat": COATED, "metal": metal}, {"coat": covered, "metal": None})

    data = quantities.simulated(partly(0.7, 0.35))
    return of_fit(quantities.fit(partly(fits.Free(0.5, 0.0, 1.0), fits.Free(0.3, 0.02, 1.0)), data, lj.Statistical()))


def texels() -> dict[str, Any]:
    from tests.helpers import quick_maps

    with tempfile.TemporaryDirectory() as folder:
        fitted = quick_maps.fitted(Path(folder) / "map.zarr", quick_maps.values((16, 16)))
        columns = {"values": fitted.values, "errors": fitted.errors}
        found = {key: {name: column[name].ravel().tolist() for name in fitted.names} for key, column in columns.items()}
        return found | {"poor": int(fitted.has("poor").sum())}


def structures() -> dict[str, Any]:
    """A search among a few structures on simulated data: ranking, and what cannot be told from the best."""
    from benchmarks.studies.structures import LIBRARY, TRANSPORT

    data = fits.simulate(COATED, GEOMETRY, transport=TRANSPORT, noise=0.02, seed=0)
    options = fits.SearchOptions(layers=1, starts=STARTS)
    search = fits.search(data, LIBRARY, transport=TRANSPORT, options=options)
    bic = {one.name: one.bic for one in search.candidates}
    return {"ranking": list(bic), "indistinguishable": sorted(search.indistinguishable), "bic": bic}


def compared() -> dict[str, Any]:
    found = {name: example(name, COATINGS / DATA["anoblack"]) for name in ("coated_diffuse", "rough_conductor")}
    scores = {row.name: row.model_score for row in fits.compare(found, refit=True).rows}
    columns = ("elpd_diff", "dse", "weight")
    numbers = {column: {name: getattr(score, column) for name, score in scores.items()} for column in columns}
    return numbers | {"ranking": list(scores)}


def posterior() -> dict[str, Any]:
    free = lj.Stack([lj.Interface(fits.Free(1.4, 1.2, 2.2), fits.Free(0.3, 0.02, 1.0))], lj.Lambertian(0.4))
    data = fits.simulate(COATED, GEOMETRY, transport=lj.Statistical(), noise=0.05, seed=0)
    fit = fits.fit(free, data, transport=lj.Statistical(), noise=fits.Noise(relative=0.05), starts=STARTS)
    drawn = fits.sample(fit, ess=2000)
    quantiles = np.quantile(drawn.samples, (0.05, 0.5, 0.95), axis=0).T.tolist()
    columns = {"quantiles": quantiles, "sd": drawn.samples.std(axis=0).tolist()}
    return of_fit(fit) | {name: dict(zip(drawn.names, column, strict=True)) for name, column in columns.items()}


DATA = {
    "aeroglaze": "aeroglaze_650nm_inplane.csv",
    "anoblack": "anoblack_ec1_on_al6061_650nm_inplane.csv",
    "nite": "nite_on_blasted_steel1008_650nm_inplane.csv",
    "nite_hemisphere": "nite_on_blasted_steel1008_650nm_hemisphere.csv",
    "nite_zemax": "AnoBlackNiTEonSteel.bsdf",
    "nite_lighttools": "AnoBlackNiTEonSteel.txt",
}
STACKS = sorted(path.stem for path in EXAMPLES.glob("*.toml"))
PAIRS = [("nite", stack) for stack in STACKS] + [(name, "coated_diffuse") for name in DATA if name != "nite"]
CASES: dict[str, Callable[[], dict[str, Any]]] = {
    **{
        f"{name}-{stack}": partial(lambda *given: of_fit(example(*given)), stack, COATINGS / DATA[name])
        for name, stack in PAIRS
    },
    **{case.__name__: case for case in (held_out, joint, slab, mixture, posterior)},
    **{"map": texels, "search": structures, "compare": compared},
}

LIMITS = dict.fromkeys(("cost", "bic"), 1e-6) | dict.fromkeys(("reduced_chi_square", "standard_errors", "errors"), 1e-3)
LIMITS |= {"values": 0.01, "quantiles": 0.1, "elpd_diff": 0.01, "weight": 0.01, "prediction": 0.35}


def units_of(stored: dict[str, Any]) -> dict[str, Any]:
    """In what differences are measured, by key; what has no unit here is compared relative to itself."""
    score = {one: max(error, 1.0) for one, error in stored.get("dse", {}).items()}
    units = {"values": stored.get("standard_errors", stored.get("errors")), "quantiles": stored.get("sd")}
    units |= {"elpd_diff": score, "weight": score}
    if "prediction" in stored:  # standard deviations, from the ends of 95 % intervals
        low, mean, high = (np.array(stored["prediction"][name]) for name in ("low", "mean", "high"))
        sd = (high - low) / 3.92
        units["prediction"] = {"low": sd, "mean": sd, "high": sd, "median_error": np.median(sd / np.abs(mean))}
    return units


def differences(name: str, stored: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """Sentences on what differs by more than the stated tolerances."""
    said, units = [], units_of(stored)
    for key in sorted(stored.keys() - {"dse", "sd"}):
        old, new, unit = stored[key], found[key], units.get(key) or stored[key]
        if key not in LIMITS or (isinstance(old, dict) and sorted(old) != sorted(new)):
            said += [f"{name}: {key}: {new}, was {old}"] if new != old else []
            continue
        for one in old if isinstance(old, dict) else [""]:
            old_one, new_one, size = (np.asarray(each[one] if one else each, float) for each in (old, new, unit))
            same = (old_one == new_one) | (np.isnan(old_one) & np.isnan(new_one))
            apart = np.where(same, 0.0, np.abs(new_one - old_one) / np.where(np.abs(size) > 0.0, np.abs(size), 1.0))
            worst = int(np.argmax(np.nan_to_num(apart, nan=np.inf)))
            if not apart.flat[worst] <= LIMITS[key]:
                numbers = f"{new_one.flat[worst]:.8g}, was {old_one.flat[worst]:.8g}, off {apart.flat[worst]:.2g}"
                said.append(f"{name}: {key} {one}: {numbers}")
    return said


def main() -> int:
    """Write or check the cases that the command line names."""
    verb, *names = sys.argv[1:] or ["check"]
    record = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    wrong = 0
    for name in names or CASES:
        began = time.perf_counter()
        found = CASES[name]()
        took = f"{time.perf_counter() - began:.0f} s"
        if verb == "write":
            record[name] = found
            RECORD.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n")
        said = differences(name, record[name], found)
        wrong += len(said)
        print("\n".join(said) or f"{name}: {'kept' if verb == 'write' else 'as it was'}, {took}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(EXAMPLES))
    sys.exit(main())
