"""One material three times: by the plugin for Mitsuba, by an exported file in Mitsuba, and without a renderer.

    python examples/in_mitsuba.py --out DIR

Needs `pip install "layerjax[mitsuba]"`. A sphere of rough copper under lacquer is lit from the front, below a constant
sky. The pictures differ by the noise of Mitsuba's paths, and the file's also by what lies between its nodes.
"""

import argparse
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

import fits
import layerjax as lj
from fits.reports.render import LIGHTS, SKY, SUN, sphere

mi.set_variant("llvm_ad_rgb")
import layerjax.mitsuba as plugin  # noqa: E402  (after the variant)

STACK = lj.Stack([lj.Interface(1.5, 0.15), lj.Medium(0.2, 0.0)], lj.Conductor([0.2, 0.92, 1.1], [3.9, 2.45, 2.14], 0.3))
TRANSPORT = lj.Statistical()
LIGHT = LIGHTS["lit from the front"]
SIZE, SAMPLES, WIDTH = 128, 512, 1.04


def rendered(bsdf):
    """The sphere by Mitsuba, (SIZE, SIZE, 3)."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "filter": {"type": "box"}}
    # x to the right and y up, as without a renderer; tangents run around y
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale([WIDTH, WIDTH, 1])
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    sun = {"type": "directional", "direction": [-x for x in LIGHT], "irradiance": {"type": "rgb", "value": np.pi * SUN}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "orthographic", "film": film, "to_world": view},
        "ball": {"type": "sphere", "to_world": upright, "bsdf": bsdf},
        "sun": sun,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
    }
    return np.array(mi.render(mi.load_dict(scene), spp=SAMPLES))


def draw(pictures, path):
    """The pictures, and how far those of Mitsuba are from that without a renderer."""
    figure, axes = plt.subplots(2, 3, figsize=(10, 6.6), layout="constrained")
    plain = pictures["layerjax render"]
    for column, (title, picture) in enumerate(pictures.items()):
        axes[0, column].imshow(np.clip(picture, 0.0, 1.0) ** (1 / 2.2))
        axes[0, column].set_title(title)
        error = 100.0 * (picture - plain).mean(axis=-1) / plain.mean(axis=-1)
        shown = axes[1, column].imshow(error, cmap="RdBu_r", vmin=-10, vmax=10)
        ball = error[plain[..., 0] != SKY]
        axes[1, column].set_title(f"{np.std(ball):.1f} % apart, on average {np.mean(ball):.2f} %", fontsize=10)
    figure.colorbar(shown, ax=axes[1], label="from layerjax render, %", shrink=0.9)
    for panel in axes.flat:
        panel.set_axis_off()
    figure.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("in_mitsuba"), help="folder for the picture and the file")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    file = arguments.out / "lacquered_copper.bsdf"
    print("\n".join(fits.export(STACK, file, "rgl", transport=TRANSPORT, force=True).notes))
    pictures = {
        "layerjax render": sphere(STACK, lj.prepare(STACK, TRANSPORT), LIGHT, SIZE),
        "Mitsuba, plugin": rendered(plugin.bsdf(STACK, TRANSPORT)),
        "Mitsuba, file": rendered({"type": "measured", "filename": str(file)}),
    }
    draw(pictures, arguments.out / "in_mitsuba.png")
    print(arguments.out / "in_mitsuba.png")


if __name__ == "__main__":
    main()
