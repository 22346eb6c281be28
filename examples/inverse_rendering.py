"""A coat recovered from a picture: roughness of its surface, depth of its haze, and the colour of what lies below.

    python examples/inverse_rendering.py --out DIR

Needs `pip install "layerjax[mitsuba]"`. Mitsuba renders a sphere in the light of a lamp, its material evaluated by
`RandomWalk`: light is followed through the layers, and the picture has the noise of that. From another material on,
Mitsuba's own optimiser then follows derivatives of the picture, the material evaluated by `AddingDoubling`, which has
derivatives and no noise. Prints the recovered values beside the truth, and draws the pictures.
"""

import argparse
from pathlib import Path

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

import layerjax as lj

mi.set_variant("llvm_ad_rgb")
import layerjax.mitsuba as plugin  # noqa: E402  (after the variant)

SIZE, SAMPLES = 48, 1
STEPS, RATE = 120, (0.05, 0.005)
PATHS = 2000
SOLVER = lj.AddingDoubling(nodes=10, modes=12)
BALL = "ball.bsdf."
FREE = {"layers[0].alpha": (0.05, 1.0), "layers[1].thickness": (0.01, 4.0), "base.albedo": (0.01, 0.99)}
"""Free parameters and their bounds."""


def coat(alpha, thickness, albedo):
    """A rough dielectric interface over haze over a diffuse base."""
    haze = lj.Medium(thickness=thickness, albedo=0.9, phase=lj.HenyeyGreenstein(0.4))
    return lj.Stack([lj.Interface(1.5, alpha), haze], lj.Lambertian(albedo))


TRUTH = coat(0.2, 0.6, [0.7, 0.35, 0.15])
START = coat(0.45, 0.2, [0.4, 0.4, 0.4])


def scene_of(stack, transport):
    """The middle of a sphere of the material, in the light of a lamp: all that is random is where rays begin."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "filter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 17, "film": film, "sampler": {"type": "independent"}}
    camera["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 4.2], [0, 0, 0], [0, 1, 0])
    lamp = {"type": "point", "position": [-2, 2, 3], "intensity": {"type": "rgb", "value": 20.0}}
    ball = {"type": "sphere", "bsdf": plugin.bsdf(stack, transport)}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
            "camera": camera,
            "ball": ball,
            "lamp": lamp,
        }
    )


def recover(scene, target):
    """Follow derivatives of the picture; the losses on the way."""
    numbers = mi.traverse(scene)
    optimiser = mi.ad.Adam(lr=RATE[0])
    for name in FREE:
        optimiser[BALL + name] = numbers[BALL + name]
    numbers.update(optimiser)
    scale = dr.mean(target, axis=None)
    losses = []
    for step in range(STEPS):
        picture = mi.render(scene, numbers, spp=SAMPLES, seed=2 * step + 1, seed_grad=2 * step + 2)
        # relative where it is bright, so that a highlight does not outweigh the rest
        loss = dr.mean(dr.square((picture - target) / (target + 0.1 * scale)), axis=None)
        dr.backward(loss)
        optimiser.set_learning_rate(RATE[0] * (RATE[1] / RATE[0]) ** (step / STEPS))
        optimiser.step()
        for name, (low, high) in FREE.items():
            optimiser[BALL + name] = dr.clip(optimiser[BALL + name], low, high)
        numbers.update(optimiser)
        losses.append(float(np.ravel(loss)[0]))
        print(f"\r  step {step + 1}/{STEPS}: loss {losses[-1]:.5f}", end="", flush=True)
    print()
    return losses


def values_of(scene):
    """Values of the free parameters, by name."""
    numbers = mi.traverse(scene)
    return {name: np.ravel(np.array(numbers[BALL + name])) for name in FREE}


def draw(pictures, losses, path):
    """The pictures side by side, and the loss."""
    figure, axes = plt.subplots(1, 5, figsize=(15, 3.3), layout="constrained", width_ratios=(1, 1, 1, 1.15, 1.2))
    for panel, (title, picture) in zip(axes, pictures.items(), strict=False):
        panel.imshow(np.clip(picture, 0.0, 1.0) ** (1 / 2.2))
        panel.set_title(title)
        panel.set_axis_off()
    truth, _, found = pictures.values()
    shown = axes[3].imshow(np.mean(found - truth, axis=-1), cmap="RdBu_r", vmin=-0.05, vmax=0.05)
    axes[3].set_title("found less given, radiance")
    axes[3].set_axis_off()
    figure.colorbar(shown, ax=axes[3], shrink=0.8)
    axes[4].semilogy(np.arange(1, len(losses) + 1), losses, color="black")
    axes[4].set(xlabel="step", ylabel="mean squared relative error", title="loss")
    figure.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("inverse_rendering"), help="folder for the picture")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    truth = scene_of(TRUTH, lj.RandomWalk(paths=PATHS))
    print("the picture, by following light through the layers")
    target = mi.render(truth, spp=SAMPLES, seed=0)
    scene = scene_of(START, SOLVER)
    before = np.array(mi.render(scene, spp=SAMPLES, seed=0))
    print("the material, by derivatives of the picture")
    losses = recover(scene, target)
    after = np.array(mi.render(scene, spp=SAMPLES, seed=0))
    expected, found = values_of(truth), values_of(scene)
    for name in FREE:
        for place, (one, other) in enumerate(zip(expected[name], found[name], strict=True)):
            print(f"  {name + (f'[{place}]' if len(expected[name]) > 1 else ''):22s} {one:7.3f}  found {other:7.3f}")
    pictures = {"given: by RandomWalk": np.array(target), "start": before, "found: by AddingDoubling": after}
    draw(pictures, losses, arguments.out / "inverse_rendering.png")
    print(f"{arguments.out / 'inverse_rendering.png'}")


if __name__ == "__main__":
    main()
