"""What is recovered: measurements by an instrument, of a surface that is partly bare, and from bins of a table."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fits
import layerjax as lj
from benchmarks.measuring.cones import mean_over_cones
from fits.data.formats import merl
from fits.data.scans import incidences
from fits.names import Strata
from fits.problem.parameters import is_free

Floats = NDArray[np.float64]

NOISE = 0.02
FLOOR = 1e-6
DETECTORS = (0.5, 1.0, 2.0, 4.0)
TILT = 0.3
"""Degrees by which the sample is tilted."""
GAIN = 0.03
BINS = 2000
STRATA: tuple[Strata, ...] = ("bins", "flux")


@dataclass(frozen=True)
class Case:
    """A problem, K noisy sets of values for it (K, N, C), and the numbers behind them by the names of parameters."""

    name: str
    how: str
    problem: fits.Problem
    values: Floats
    truth: dict[str, float]


def by_instruments(repeats: int) -> Iterator[Case]:
    """A glossy coat by detectors of several widths, with tilt and gains, fitted with the instrument or without."""
    geometry = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-80.0, 81.0, 2.0))
    upright = Rotation.from_euler("y", -TILT, degrees=True)
    wi, wo = upright.apply(geometry.wi), upright.apply(geometry.wo)
    truth = {"layers[0].ior": 1.5, "layers[0].alpha": 0.08, "base.albedo": 0.3}
    coat = lj.Stack([lj.Interface(1.5, 0.08)], lj.Lambertian(0.3))
    free = lj.Stack(
        [lj.Interface(fits.Free(1.6, 1.2, 2.2), fits.Free(0.12, 0.02, 0.5))], lj.Lambertian(fits.Free(0.4, 0.0, 1.0))
    )
    for place, detector in enumerate(DETECTORS):
        exact = mean_over_cones(coat, wi, wo, 0.0, detector, carrier(coat))
        generator = np.random.default_rng([21, place])
        data = _data(geometry, exact)
        groups = incidences(data)
        gains = np.ones((repeats, len(exact), 1))
        for group in groups:
            gains[:, group.rows] = np.exp(GAIN * generator.standard_normal((repeats, 1, 1)))
        values = gains * exact * (1.0 + NOISE * generator.standard_normal((repeats, *exact.shape)))
        instrument = fits.Instrument(detector_aperture=detector, tilt=fits.Free(0.0, -2.0, 2.0), gain_sd=GAIN)
        name = f"detector of {detector:g} degrees"
        known = truth | {"instrument.tilt": TILT}
        yield Case(name, "with the instrument", _problem(free, data, instrument=instrument), values, known)
        yield Case(name, "without", _problem(free, data), values, truth)


def of_mixtures(repeats: int) -> Iterator[Case]:
    """A metal that a coat covers in part."""
    geometry = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0))
    for place, covered in enumerate((0.3, 0.7, 0.95)):

        def mixture(weight: Any, alpha: Any, albedo: Any) -> lj.Mixture:
            coat = lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian(albedo))
            bare = lj.Stack([], lj.Conductor(0.2, 3.9, 0.35))
            return lj.Mixture({"coat": coat, "bare": bare}, {"coat": weight, "bare": None})

        exact = _values(mixture(covered, 0.2, 0.4), geometry)
        free = mixture(fits.Free(0.5, 0.0, 1.0), fits.Free(0.3, 0.02, 1.0), fits.Free(0.6, 0.0, 1.0))
        problem = _problem(free, _data(geometry, exact))
        known = dict(zip(problem.names, (0.2, 0.4, covered), strict=True))
        yield Case(f"coat on {covered:.0%} of a metal", "mixture", problem, _noisy(exact, repeats, [22, place]), known)


def of_bins(repeats: int, folder: Path) -> Iterator[Case]:
    """Six materials as MERL tables, of which some bins are fitted."""
    for name, (stack, free) in materials().items():
        path = folder / f"{name.replace(' ', '_')}.binary"
        write_table(path, stack)
        for strata in STRATA:
            data = fits.read(path, bins=BINS, strata=strata)
            problem = _problem(free, data)
            known = dict(zip(problem.names, _numbers(stack, free), strict=True))
            yield Case(
                name,
                f"{BINS:,} bins by {strata}",
                problem,
                _noisy(data.values, repeats, [23, len(name), STRATA.index(strata)]),
                known,
            )
        path.unlink()


def materials() -> dict[str, tuple[lj.Stack, lj.Stack]]:
    """Each with its numbers, and with what is free of it."""

    def flakes(thickness: Any, albedo: Any, alpha: Any, base: Any) -> lj.Stack:
        return lj.Stack([lj.Medium(thickness, albedo, lj.SGGX("surface", alpha))], lj.Lambertian(base))

    def fibers(thickness: Any, albedo: Any, alpha: Any, base: Any) -> lj.Stack:
        return lj.Stack([lj.Medium(thickness, albedo, lj.SGGX("fiber", alpha))], lj.Lambertian(base))

    def haze(thickness: Any, albedo: Any, g: Any, base: Any) -> lj.Stack:
        return lj.Stack([lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g))], lj.OrenNayar(base, 0.5))

    def varnish(ior: Any, alpha: Any, base: Any) -> lj.Stack:
        return lj.Stack([lj.Interface(ior, alpha)], lj.Lambertian(base))

    def metal(ior: Any, k: Any, alpha: Any) -> lj.Stack:
        return lj.Stack([], lj.Conductor(ior, k, alpha))

    share, free = (lambda: fits.Free(0.5, 0.0, 1.0)), fits.Free
    medium = (free(1.2, 0.05, 5.0), share(), free(0.4, 0.02, 1.0), share())
    return {
        "rough metal": (metal(0.2, 3.9, 0.3), metal(0.2, free(3.0, 1.0, 10.0), free(0.4, 0.02, 1.0))),
        "polished metal": (metal(1.5, 4.0, 0.04), metal(1.5, free(3.0, 1.0, 10.0), free(0.08, 0.01, 1.0))),
        "varnished paint": (
            varnish(1.5, 0.15, 0.35),
            varnish(free(1.6, 1.2, 2.2), free(0.3, 0.02, 1.0), share()),
        ),
        "flakes over paint": (flakes(0.8, 0.9, 0.2, 0.5), flakes(*medium)),
        "velvet": (fibers(1.0, 0.7, 0.3, 0.1), fibers(*medium)),
        "haze over a rough wall": (haze(0.5, 0.8, 0.5, 0.6), haze(*medium[:2], free(0.0, -0.9, 0.9), share())),
    }


def write_table(path: Path, stack: lj.Stack, noise: float = 0.0) -> None:
    """A MERL table with the material's values at the centres of bins above the horizon, -1 elsewhere."""
    bins = np.stack(np.unravel_index(np.arange(np.prod(merl.SHAPE)), merl.SHAPE), axis=-1)
    wi, wo = merl.centre(bins)
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    values = np.full((len(bins), len(merl.CHANNELS)), -1.0)
    values[above] = np.asarray(lj.evaluate(stack, wi[above], wo[above], carrier(stack))) / merl.SCALE
    values[above] *= 1.0 + noise * np.random.default_rng(24).standard_normal(values[above].shape)
    content = np.ascontiguousarray(values.T, "<f8").tobytes()
    path.write_bytes(np.array(merl.SHAPE, "<i4").tobytes() + content)


def carrier(stack: lj.Stack | lj.Mixture) -> lj.Transport:
    """A cheap transport that supports it; what it neglects does not matter, as it also makes the data."""
    media = isinstance(stack, lj.Stack) and any(isinstance(layer, lj.Medium) for layer in stack.layers)
    return lj.SingleScattering() if media else lj.Statistical()


def _problem(stack: Any, data: fits.Measurements, **more: Any) -> fits.Problem:
    noise = fits.Noise(relative=NOISE, floor=FLOOR)
    return fits.Problem(stack, data, carrier(stack), noise=noise, **more)


def _values(stack: Any, geometry: fits.Geometry) -> Floats:
    return np.asarray(lj.evaluate(stack, geometry.wi, geometry.wo, carrier(stack)), float)


def _data(geometry: fits.Geometry, values: Floats) -> fits.Measurements:
    return fits.Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), ("value",))


def _noisy(exact: Floats, repeats: int, seed: int | list[int]) -> Floats:
    return exact * (1.0 + NOISE * np.random.default_rng(seed).standard_normal((repeats, *exact.shape)))


def _numbers(stack: lj.Stack, free: lj.Stack) -> list[float]:
    """The numbers of a stack where the other is free."""
    pairs = zip(jax.tree.leaves(stack), jax.tree.leaves(free, is_leaf=is_free), strict=True)
    return [float(value) for value, leaf in pairs if is_free(leaf)]
