"""Which rough diffuse surface is sand? Simulated slices, fitted by five surfaces.

    python examples/sand.py --out DIR

Slices of a porous surface of flakes with the colours of sand (albedo 0.518, 0.331, 0.184, roughness 0.5; d'Eon &
Weidlich 2024, Fig. 1) are simulated by the table of light between the flakes, with 3 % noise, and fitted by
`VMFDiffuse` in both forms, `OrenNayar` in both and `Lambertian`. Prints each fit beside the truth and which surface
the data prefer, and writes a report.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import fits
import layerjax as lj

ALBEDO, ROUGHNESS = (0.518, 0.331, 0.184), 0.5
SEED = 3
COLOURS, WIDTH = fits.Free([0.4, 0.4, 0.4], 0.0, 1.0), fits.Free(0.4, 0.0, 1.0)
SURFACES = {
    "VMF diffuse, all orders": lj.VMFDiffuse(COLOURS, WIDTH, form="all_orders"),
    "VMF diffuse, paper": lj.VMFDiffuse(COLOURS, WIDTH),
    "Oren-Nayar, energy preserving": lj.OrenNayar(COLOURS, WIDTH),
    "Oren-Nayar, classic": lj.OrenNayar(COLOURS, WIDTH, form="classic"),
    "Lambertian": lj.Lambertian(COLOURS),
}


def sand_data(noise=0.03, seed=SEED):
    """Measurements at four incidences in two planes."""
    sand = lj.Stack([], lj.VMFDiffuse(ALBEDO, ROUGHNESS, form="all_orders"))
    geometry = fits.slices(incidence=(10, 35, 60, 75), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    return fits.simulate(sand, geometry, noise=noise, seed=seed)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("sand"), help="folder for the report")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    data = sand_data()
    print(f"{len(data)} measurements in {len(data.channels)} channels with 3 % noise", flush=True)
    found = {}
    for name, surface in SURFACES.items():
        found[name] = fit = fits.fit(lj.Stack([], surface), data, starts=8, seed=SEED)
        print(f"\n{name}: chi-square {fit.reduced_chi_square:.2f} per degree of freedom", flush=True)
        truths = {f"base.albedo[{c}]": level for c, level in enumerate(ALBEDO)} | {"base.roughness": ROUGHNESS}
        for index, (parameter, value) in enumerate(fit.values.items()):
            print(f"  {parameter:16} truth {truths[parameter]:5.3f}  fit {value:6.4f} ± {fit.errors[index]:.4f}")
    print()
    print(fits.compare(found).verdict)
    fits.report(found["VMF diffuse, all orders"], path=out / "sand.html")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
