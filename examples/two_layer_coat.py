"""A metal under an absorbing coat, recovered from noisy BRDF slices; and which parameters they do not identify.

    python examples/two_layer_coat.py --out DIR

Slices of a coat (index 1.5, roughness 0.1, optical depth 0.3, no scattering) over copper at 550 nm (n 0.95, k 2.6,
roughness 0.3) are simulated with 3 % noise by `Statistical`. All six parameters are fitted three times: with
bounds only, with a prior from a handbook of metals, and with the extinction k known. Prints each fit beside the truth
and which parameters are not identified separately, and writes a report of each.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

import fits
import layerjax as lj
from fits.reports import verdicts

TRUTH = {
    "layers[0].ior": 1.5,
    "layers[0].alpha": 0.1,
    "layers[1].thickness": 0.3,
    "base.ior": 0.95,
    "base.k": 2.6,
    "base.alpha": 0.3,
}
COAT = (fits.Free(1.4, 1.2, 2.2), fits.Free(0.2, 0.02, 0.6), fits.Free(0.5, 0.01, 3.0))
ROUGHNESS = fits.Free(0.2, 0.02, 0.8)
METALS = {
    "bounds only": (fits.Free(1.0, 0.05, 6.0), fits.Free(3.0, 0.5, 10.0)),
    "a handbook's metals (n 1, k 3, each within a factor of 1.6)": (
        fits.Free(1.0, 0.05, 6.0, fits.LogNormal(1.0, 0.5)),
        fits.Free(3.0, 0.5, 10.0, fits.LogNormal(3.0, 0.5)),
    ),
    "k known": (fits.Free(1.0, 0.05, 6.0), TRUTH["base.k"]),
}
SEED = 1


def coat(ior, alpha, thickness, base_ior, base_k, base_alpha):
    """The stack: a number or a `fits.Free` for each name of `TRUTH`."""
    return lj.Stack(
        [lj.Interface(ior=ior, alpha=alpha), lj.Medium(thickness=thickness, albedo=0.0)],
        base=lj.Conductor(ior=base_ior, k=base_k, alpha=base_alpha),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("two_layer_coat"), help="folder for the reports")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    transport = lj.Statistical()
    geometry = fits.slices(incidence=(10, 35, 60), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    data = fits.simulate(coat(*TRUTH.values()), geometry, transport=transport, noise=0.03, seed=SEED)
    print(f"{len(data)} measurements with 3 % noise", flush=True)

    for number, (known, metal) in enumerate(METALS.items()):
        began = time.perf_counter()
        fit = fits.fit(coat(*COAT, *metal, ROUGHNESS), data, transport=transport, starts=8, seed=SEED)
        print(f"\nPrior of the metal: {known}; {time.perf_counter() - began:.0f} s", flush=True)
        for name, value in fit.values.items():
            truth, error = TRUTH[name], fit.standard_errors[name]
            off = f"{(value - truth) / error:+5.1f} errors off" if np.isfinite(error) else "at a bound"
            print(f"  {name:20} truth {truth:4.2f}  fit {value:6.4f} ± {error:6.4f}  {off}")
        for sentence in verdicts.summary(fit):
            print(f"  {sentence}")
        fits.report(fit, path=out / f"{number}.html")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
