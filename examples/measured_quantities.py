"""Instruments and measured quantities beside scans: an aperture, a mixture of two stacks, totals, a MERL table.

    python examples/measured_quantities.py [instrument] [mixture] [totals] [bins]

Each part fits simulated data with 2 % noise in two ways, and prints both results beside the truth.
"""

import argparse
import tempfile
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import fits
import layerjax as lj

NOISE = fits.Noise(relative=0.02, floor=1e-6, discrepancy=False)
SCANS = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-80.0, 81.0, 2.0))


def instrument():
    """A glossy coat, measured through a detector aperture of 4 degrees at a sample tilt of 0.3 degrees."""

    def coat(ior, alpha, albedo):
        return lj.Stack([lj.Interface(ior, alpha)], lj.Lambertian(albedo))

    free = coat(fits.Free(1.6, 1.2, 2.2), fits.Free(0.12, 0.02, 0.5), fits.Free(0.4, 0.0, 1.0))
    true = fits.Instrument(detector_aperture=4.0, tilt=0.3)
    exact = fits.Problem(free, simulated(coat(1.5, 0.08, 0.3)), lj.Statistical(), NOISE, instrument=true)
    data = simulated(np.asarray(exact.predict([1.5, 0.08, 0.3])))
    known = fits.Instrument(detector_aperture=4.0, tilt=fits.Free(0.0, -2.0, 2.0))
    ways = {"exact directions": None, "its instrument": known}
    results = {way: fit(free, data, lj.Statistical(), instrument=instrument) for way, instrument in ways.items()}
    show("A detector of 4 degrees", {**dict(zip(exact.names, (1.5, 0.08, 0.3), strict=True)), TILT: 0.3}, results)


def mixture():
    """A metal that a coat covers by 70 %."""

    def partly(covered):
        coat = lj.Stack([lj.Interface(1.5, 0.2)], lj.Lambertian(0.4))
        metal = lj.Stack([], lj.Conductor(0.2, 3.9, fits.Free(0.3, 0.02, 1.0) if covered is None else 0.35))
        weight = fits.Free(0.5, 0.0, 1.0) if covered is None else covered
        return lj.Mixture({"coat": coat, "metal": metal}, {"coat": weight, "metal": None})

    data = simulated(partly(0.7))
    bare = lj.Stack([], lj.Conductor(0.2, 3.9, fits.Free(0.3, 0.02, 1.0)))
    results = {"metal only": fit(bare, data, lj.Statistical()), "mixture": fit(partly(None), data, lj.Statistical())}
    show(
        "A metal under patches of a coat", {"weights.coat": 0.7, "metal.base.alpha": 0.35, "base.alpha": 0.35}, results
    )


def totals():
    """A slab by scans alone, and by scans and an integrating sphere."""

    def turbid(mu_s, mu_a, g):
        return lj.Stack([lj.TurbidMedium(1.0, mu_s, mu_a, lj.HenyeyGreenstein(g))])

    slab = turbid(2.0, 0.1, 0.5)
    free = turbid(fits.Free(1.0, 0.1, 20.0), fits.Free(0.3, 0.0, 5.0), fits.Free(0.0, -0.9, 0.9))
    solver = lj.AddingDoubling(nodes=12, modes=8)
    scans = simulated(slab, solver)
    parts = {"scans": fits.Problem(free, scans, solver, NOISE), "sphere": sphere(free, 0.2, 0.3, solver)}
    reflected, transmitted = np.asarray(parts["sphere"].predict([2.0, 0.1, 0.5])).ravel()
    parts["sphere"] = sphere(free, reflected, transmitted, solver)
    results = {
        "scans": fit(free, scans, solver),
        "and a sphere": fits.fit(fits.Joint(parts, shared=["layers"]), starts=4),
    }
    names = parts["scans"].names
    show("A slab by scans and by totals", dict(zip(names, (2.0, 0.1, 0.5), strict=True)), results)


def bins():
    """Flakes over a base from a MERL table: along its slices, and by 5,000 bins from all over it."""
    from fits.data.formats import merl

    def flakes(thickness, alpha, albedo):
        return lj.Stack([lj.Medium(thickness, 0.9, lj.SGGX("surface", alpha))], lj.Lambertian(albedo))

    places = np.stack(np.unravel_index(np.arange(np.prod(merl.SHAPE)), merl.SHAPE), axis=-1)
    wi, wo = merl.centre(places)
    above = (wi[:, 2] > 0.0) & (wo[:, 2] > 0.0)
    table = np.full((3, len(places)), -1.0)
    exact = np.asarray(lj.evaluate(flakes(0.8, 0.2, 0.5), wi[above], wo[above], lj.SingleScattering()))
    noise = 1.0 + 0.02 * np.random.default_rng(1).standard_normal((3, len(exact)))
    table[:, above] = exact.T * noise / merl.SCALE[:, None]
    free = flakes(fits.Free(1.2, 0.05, 5.0), fits.Free(0.4, 0.02, 1.0), fits.Free(0.3, 0.0, 1.0))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flakes.binary"
        path.write_bytes(np.array(merl.SHAPE, "<i4").tobytes() + table.astype("<f8").tobytes())
        read = {"slices": fits.read(path), "5,000 bins": fits.read(path, bins=5000)}
    results = {way: fit(free, data, lj.SingleScattering()) for way, data in read.items()}
    names = results["slices"].problem.names
    show("Flakes from a MERL table", dict(zip(names, (0.8, 0.2, 0.5), strict=True)), results)


TILT = "instrument.tilt"


def simulated(material, transport=None):
    """Scans of a stack, or scans of these values, with noise."""
    carrier = transport or lj.Statistical()
    exact = (
        material if isinstance(material, np.ndarray) else np.asarray(lj.evaluate(material, SCANS.wi, SCANS.wo, carrier))
    )
    noisy = exact * (1.0 + 0.02 * np.random.default_rng(0).standard_normal(exact.shape))
    return fits.Measurements(SCANS.wi, SCANS.wo, noisy, None, np.ones(len(noisy), bool), ("value",))


def sphere(free, reflected, transmitted, transport):
    """A problem of total reflectance and transmittance at normal incidence, with a standard deviation of 0.005 each."""
    shares = fits.Totals.of(0.0, reflectance=reflected, transmittance=transmitted, sigma=0.005)
    return fits.Problem(free, shares, transport, fits.Noise())


def fit(free, data, transport, **more):
    return fits.fit(free, data, transport=transport, noise=NOISE, starts=4, **more)


def show(title, truth, results):
    """A row for each parameter: the truth and each fitted value."""
    table = Table(title=title, box=None)
    for heading in ("parameter", "truth", *results):
        table.add_column(heading)
    for name, value in truth.items():
        cells = []
        for one in results.values():
            number, error = one.values.get(name), one.standard_errors.get(name)
            cells.append("" if number is None else f"{number:.4g} ± {error:.2g}")
        table.add_row(name, f"{value:g}", *cells)
    chi_squares = [f"{one.reduced_chi_square:.2f}" for one in results.values()]
    table.add_row("chi-square / dof", "", *chi_squares)
    Console(width=120).print(table)


PARTS = {part.__name__: part for part in (instrument, mixture, totals, bins)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", help=f"{', '.join(PARTS)} (default: all)")
    chosen = parser.parse_args().parts or list(PARTS)
    for name in chosen:
        if name not in PARTS:
            parser.error(f"{name!r} is none of {', '.join(PARTS)}")
        PARTS[name]()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
