"""A bright coat that scatters light many times, recovered from noisy BRDF slices; and what one order makes of them.

    python examples/multiple_scattering.py --out DIR

Slices of a coat of particles (albedo 0.95, optical depth 2) over a Lambertian base are simulated with 3 % noise by
`AddingDoubling` at its default resolution. All four parameters are then fitted and sampled twice: with
`AddingDoubling`, coarser than the truth, and with `SingleScattering`. Writes a report of each and the figure that sets
both beside the truth.
"""

import argparse
import time
from pathlib import Path

import jax
import matplotlib
import numpy as np

import fits
import layerjax as lj

matplotlib.use("Agg")
from matplotlib import pyplot as plt

TRUTH = {"optical depth": 2.0, "albedo": 0.95, "asymmetry g": 0.7, "base albedo": 0.2}
BOX = {"optical depth": (0.05, 20.0), "albedo": (0.0, 1.0), "asymmetry g": (-0.9, 0.9), "base albedo": (0.0, 1.0)}
START = {"optical depth": 1.0, "albedo": 0.7, "asymmetry g": 0.0, "base albedo": 0.3}
MODELS = {
    "all orders (AddingDoubling)": lj.AddingDoubling(nodes=12, modes=12),
    "one order (SingleScattering)": lj.SingleScattering(),
}
COLOURS = {"all orders (AddingDoubling)": "#0072B2", "one order (SingleScattering)": "#D55E00"}
SEED = 1


def coat(values):
    """The stack: a number or a `fits.Free` for each name of `TRUTH`."""
    thickness, albedo, g, base = values.values()
    medium = lj.Medium(thickness=thickness, albedo=albedo, phase=lj.HenyeyGreenstein(g=g))
    return lj.Stack([medium], base=lj.Lambertian(albedo=base))


def covered(samples, truth):
    """Narrowest of the central 68 and 95 % intervals that holds the truth, in words."""
    for level in (68, 95):
        low, high = np.percentile(samples, [50 - level / 2, 50 + level / 2])
        if low <= truth <= high:
            return f"inside {level} %"
    return "outside 95 %"


def picture(data, posteriors, path):
    """Each parameter's two posteriors with the truth, and the data of the plane of incidence with both best fits."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.2), layout="constrained")
    panels = [axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1]]
    for index, (panel, (name, truth)) in enumerate(zip(panels, TRUTH.items(), strict=True)):
        for label, posterior in posteriors.items():
            counts, edges = np.histogram(posterior.samples[:, index], bins=30)
            panel.stairs(counts / counts.max(), edges, fill=True, alpha=0.6, color=COLOURS[label], label=label)
        panel.axvline(truth, color="black", linestyle="--", label="truth")
        panel.set(
            xlabel=f"{name} [1]", ylabel="posterior density over its maximum", ylim=(0, 1.5 if index == 0 else 1.1)
        )
    panels[0].legend(loc="upper right")
    outgoing = np.degrees(np.arctan2(data.wo[:, 0], data.wo[:, 2]))
    incidence = np.degrees(np.arccos(data.wi[:, 2])).round()
    flat = np.abs(data.wo[:, 1]) < 1e-9
    for panel, theta in zip(axes[:, 2], (10, 60), strict=True):
        shown = flat & (incidence == theta)
        panel.errorbar(
            outgoing[shown], data.values[shown, 0], data.sigma[shown, 0], fmt="k.", label="data, 3 % noise", zorder=3
        )
        for label, posterior in posteriors.items():
            panel.plot(outgoing[shown], posterior.fit.predicted[shown, 0], color=COLOURS[label], label=f"fit, {label}")
        panel.set(xlabel="outgoing angle in the plane of incidence [degrees]", ylabel="BRDF [1/sr]")
        panel.set_title(f"light at {theta}°")
    axes[0, 2].legend()
    figure.suptitle("A coat of optical depth 2 and albedo 0.95: what the same data say with all orders and with one")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("multiple_scattering"), help="folder for reports and figure")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    geometry = fits.slices(incidence=(10, 35, 60), outgoing=np.arange(-80, 81, 10), azimuth=(0, 90))
    data = fits.simulate(coat(TRUTH), geometry, transport=lj.AddingDoubling(), noise=0.03, seed=SEED)
    free = coat({name: fits.Free(START[name], *BOX[name]) for name in TRUTH})
    print(f"{len(data)} measurements with 3 % noise", flush=True)

    posteriors = {}
    for label, transport in MODELS.items():
        began = time.perf_counter()
        fit = fits.fit(free, data, transport=transport, starts=8, seed=SEED)
        fitted = time.perf_counter()
        posteriors[label] = posterior = fits.sample(fit, walkers=16, seed=SEED)
        sampled = time.perf_counter()
        fits.report(fit, posterior, out / f"{type(transport).__name__}.html")
        steps = len(posterior.chain)
        print(f"\n{label}: fit {fitted - began:.0f} s, {steps} steps of 16 walkers {sampled - fitted:.0f} s")
        print(f"chi-square per degree of freedom {fit.reduced_chi_square:.2f}; {fit.status}")
        for index, (name, summary) in enumerate(zip(TRUTH, posterior.summary().values(), strict=True)):
            median, low, high, _, deviation = summary
            truth = TRUTH[name]
            print(
                f"  {name:14} truth {truth:5.2f}  best {fit.vector[index]:6.3f}  median {median:6.3f}"
                f"  68 % [{low:.3f}, {high:.3f}]  {(median - truth) / deviation:+6.1f} deviations,"
                f" truth {covered(posterior.samples[:, index], truth)}"
            )
    picture(data, posteriors, out / "multiple_scattering.png")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
