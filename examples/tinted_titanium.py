"""Heat-tinted titanium: the colours of a thin oxide film, and its thickness measured by the light that it reflects.

    python examples/tinted_titanium.py --out DIR

Slices of a rough titanium plate under an oxide film are simulated with 2 % noise in red, green and blue; thickness,
index of the oxide and roughness are fitted. The picture shows the colour that a facet reflects by thickness and angle.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import fits
import layerjax as lj

matplotlib.use("Agg")
from matplotlib import pyplot as plt

RGB_NM = [610.0, 550.0, 465.0]
TITANIUM = dict(zip(("ior", "k"), lj.metal("titanium", RGB_NM), strict=True))
OXIDE = 2.4
TRUTH = {"base.film.thickness_nm": 65.0, "base.film.ior": OXIDE, "base.alpha": 0.25}


def plate(thickness, index=OXIDE, alpha=0.25):
    """Titanium under its oxide: a number or a `fits.Free` each."""
    film = lj.ThinFilm(ior=index, thickness_nm=thickness, wavelengths_nm=RGB_NM)
    return lj.Stack([], lj.Conductor(**TITANIUM, alpha=alpha, film=film))


def measured_thickness():
    """The fit of simulated slices."""
    view = fits.slices(incidence=(10.0, 30.0, 50.0, 70.0))
    data = fits.simulate(plate(*TRUTH.values()), view, noise=0.02, seed=0)
    free = plate(fits.Free(100.0, 0.0, 300.0), fits.Free(2.0, 1.5, 3.0), fits.Free(0.1, 0.02, 0.6))
    return fits.fit(free, data, noise=fits.Noise(relative=0.02, discrepancy=False), starts=16)


def colours(thicknesses, degrees):
    """What a facet reflects, shape (angles, thicknesses, 3)."""
    base = plate(thicknesses[0]).base

    def of(thickness, cosine):
        film = lj.ThinFilm(OXIDE, thickness, RGB_NM)
        return jnp.stack(lj.Conductor(base.ior, base.k, base.alpha, film=film).reflectance(cosine))

    cosine = jnp.cos(jnp.radians(degrees))
    return jax.vmap(lambda c: jax.vmap(lambda d: of(d, c))(thicknesses))(cosine)


def picture(path):
    """Colours by thickness and angle, and the reflectance of each channel along the normal."""
    thicknesses, degrees = jnp.linspace(0.0, 250.0, 500), jnp.linspace(0.0, 85.0, 170)
    found = np.asarray(colours(thicknesses, degrees))
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    shown = np.where(found <= 0.0031308, 12.92 * found, 1.055 * found ** (1 / 2.4) - 0.055)  # sRGB
    left.imshow(shown, extent=(0.0, 250.0, 85.0, 0.0), aspect="auto", interpolation="bilinear")
    left.set(xlabel="thickness of the oxide, nm", ylabel="angle of incidence, degrees", title="Colour of a facet")
    for c, (name, colour) in enumerate(zip(("red", "green", "blue"), ("#D55E00", "#009E73", "#0072B2"), strict=True)):
        right.plot(thicknesses, found[0, :, c], color=colour, label=f"{name}, {RGB_NM[c]:g} nm")
    right.set(
        xlabel="thickness of the oxide, nm",
        ylabel="reflectance",
        title="Along the normal",
        ylim=(0.0, 0.8),
        xlim=(0.0, 250.0),
    )
    right.legend(loc="upper center", ncols=3)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Fit, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(), help="directory of the picture (default: the current one)")
    out = parser.parse_args().out
    fit = measured_thickness()
    for name, truth in TRUTH.items():
        print(f"{name:22} {fit.values[name]:8.4g} ± {fit.standard_errors[name]:.2g}  (truth {truth:g})")
    out.mkdir(parents=True, exist_ok=True)
    picture(out / "thin_film.png")


if __name__ == "__main__":
    main()
