"""A plate of painted roughness and thickness, recovered texel by texel from noisy measurements, and how well.

    python examples/painted_map.py --out DIR

A clear coat of flakes lies on a diffuse base. Its optical depth was sprayed on through a stencil, and its surface
was polished in strokes, so that both differ at each of 512 x 512 texels. 64 measurements of each with 2 % noise
are simulated with `SingleScattering`, and `fits.fit_map` estimates both parameters, with standard errors. Prints how
the pulls (error / standard error) are distributed, and writes the store of the map, its report and a picture: truth,
result, their difference.
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

SIZE, NOISE, SEED = 512, 0.02, 1
BASE = 0.3
TRANSPORT = lj.SingleScattering()
FREE = {"layers[0].phase.alpha": fits.Free(0.2, 0.02, 1.0), "layers[0].thickness": fits.Free(1.0, 0.05, 10.0)}
WORDS = ("roughness of the coat", "optical depth of the coat")
ROWS = 64
"""Number of rows of texels that are simulated at once."""


def plate(alpha, thickness):
    """The stack: numbers, `fits.Free`, or maps of them, thickness with an axis for its channels."""
    return lj.Stack([lj.Medium(thickness, 0.8, lj.SGGX("surface", alpha), f0=0.5)], lj.Lambertian(BASE))


def painting(size):
    """Roughness and optical depth of every texel, (size, size) each."""
    x, y = np.meshgrid(*[(np.arange(size) + 0.5) / size] * 2)
    stroke = np.sin(2 * np.pi * (6 * (x + y) + 0.6 * np.sin(2 * np.pi * (x - y))))
    polished = 1 / (1 + np.exp(-6 * stroke)) * np.exp(-(((x - y) / 0.6) ** 4))
    alpha = 0.45 * (0.12 / 0.45) ** (0.85 * polished + 0.15 * y)
    radius, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    stencil = (radius < 0.25 + 0.12 * np.sin(6 * angle)) | ((radius > 0.41) & (radius < 0.45))
    thickness = np.where(stencil, 1.6, 0.45) * (1 + 0.4 * np.sin(3 * x + 2 * y))
    return alpha, thickness


def measurements(alpha, thickness, geometry):
    """Measurements of every texel, with noise, (size, size, 64, 1)."""
    values = np.empty((*alpha.shape, len(geometry), 1))
    for first in range(0, len(alpha), ROWS):
        rows = slice(first, first + ROWS)
        stacks = plate(alpha[rows], thickness[rows, :, None])
        exact = lj.evaluate(stacks, geometry.wi[:, None, None], geometry.wo[:, None, None], TRANSPORT)
        values[rows] = np.moveaxis(np.asarray(exact), 0, 2)
    return values * (1 + NOISE * np.random.default_rng(SEED).standard_normal(values.shape))


def picture(truth, fitted, pulls):
    """A row for each parameter: truth and result to one scale, and their difference in standard errors."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.6), layout="constrained", sharex=True, sharey=True)
    for row, word, name in zip(axes, WORDS, FREE, strict=True):
        scale = {"vmin": truth[name].min(), "vmax": truth[name].max(), "cmap": "viridis"}
        shown = row[0].imshow(truth[name], **scale)
        row[1].imshow(fitted.values[name], **scale)
        figure.colorbar(shown, ax=row[:2], label=word, extend="both")
        difference = row[2].imshow(pulls[name], vmin=-3, vmax=3, cmap="RdBu_r", interpolation="nearest")
        figure.colorbar(difference, ax=row[2], label="(result - truth) / standard error", extend="both")
        row[0].set_ylabel("row of texels")
    for panel, title in zip(axes[0], ("truth", "result", "difference"), strict=True):
        panel.set_title(title)
    for panel in axes[1]:
        panel.set_xlabel("column of texels")
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("painted_map"), help="folder for store, report and picture")
    parser.add_argument("--size", type=int, default=SIZE, help="texels along a side (default: %(default)s)")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    geometry = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0), outgoing=np.arange(-70.0, 81.0, 10.0))
    truth = dict(zip(FREE, painting(given.size), strict=True))
    values = measurements(*truth.values(), geometry)
    print(
        f"{values[..., 0].size:,} measurements of {given.size} x {given.size} texels with {NOISE:.0%} noise", flush=True
    )

    began = time.perf_counter()
    noise, out = fits.Noise(relative=NOISE), given.out / "plate.zarr"
    fitted = fits.fit_map(plate(*FREE.values()), geometry, values, out, noise, transport=TRANSPORT)
    seconds = time.perf_counter() - began
    print(f"fitted in {seconds:.1f} s, of which {fitted.has('converged').mean():.2%} converged")

    pulls = {name: (fitted.values[name] - truth[name]) / fitted.errors[name] for name in FREE}
    for word, name in zip(WORDS, FREE, strict=True):
        error, one = np.median(fitted.errors[name] / truth[name]), pulls[name][np.isfinite(pulls[name])]
        within = [np.mean(np.abs(one) < times) for times in (1, 2, 3)]
        print(f"{word}: median error {error:.2%}; pulls of mean {one.mean():+.3f} and width {one.std():.3f},")
        print("    within 1, 2, 3 errors: " + ", ".join(f"{share:.2%}" for share in within) + " (68.27, 95.45, 99.73)")
    print(f"median chi-square per degree of freedom: {np.median(fitted.reduced_chi_square):.3f}")
    figure = picture(truth, fitted, pulls)
    figure.savefig(given.out / "painted_map.png", dpi=110)
    fits.report(fitted, path=given.out / "plate.html", force=True)
    print(f"written: {given.out / 'painted_map.png'}, plate.html, plate.zarr")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
