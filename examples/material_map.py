"""A plate whose lacquer is worn: 512 x 512 stacks, one a texel, under a light that moves across.

    python examples/material_map.py --out DIR

A coat of metal flakes lies on brushed copper. Where the plate was handled the coat is thin and the metal polished: its
thickness and the roughness of the metal are maps. Every texel has its own directions to a lamp that stands 0.6 plate
widths above, and to the eye. Writes `material_map.png`.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import layerjax as lj

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SIZE = 512
COPPER = {"ior": [0.21, 1.1, 1.2], "k": [3.7, 2.6, 2.3]}
EYE = (0.5, -0.9, 1.6)
HEIGHT, LAMPS = 0.6, (0.15, 0.5, 0.85)
"""Height of the lamp above the plate, and its places from left to right, in widths of the plate."""


def maps(size):
    """Thickness of the coat and roughness of the metal, (size, size) each."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, size), np.linspace(0.0, 1.0, size))
    rng = np.random.default_rng(4)
    worn = np.zeros_like(x)
    for _ in range(14):  # finger marks
        a, b, radius = rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9), rng.uniform(0.04, 0.11)
        worn = np.maximum(worn, np.exp(-((((x - a) ** 2 + (y - b) ** 2) / radius**2) ** 2)))
    ripple = 0.5 + 0.5 * np.sin(2 * np.pi * (9 * x + 1.5 * np.sin(2 * np.pi * y)))
    thickness = (0.25 + 1.1 * ripple) * (1.0 - 0.97 * worn)
    roughness = 0.45 - 0.33 * worn
    return jnp.asarray(thickness, jnp.float32), jnp.asarray(roughness, jnp.float32)


def plate(size):
    """The map of stacks: a thickness (size, size, 1) has its channels behind, a roughness (size, size) has none."""
    thickness, roughness = maps(size)
    flakes = lj.Medium(thickness[..., None], [0.35, 0.75, 0.8], lj.SGGX("surface", alpha=0.25))
    return lj.Stack([flakes], base=lj.Conductor(**COPPER, alpha=roughness))


def towards(point, size):
    """Unit vectors from every texel to a point, (size, size, 3), and their lengths."""
    x, y = jnp.meshgrid(jnp.linspace(0.0, 1.0, size), jnp.linspace(0.0, 1.0, size))
    ray = jnp.asarray(point, jnp.float32) - jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)
    length = jnp.linalg.norm(ray, axis=-1, keepdims=True)
    return ray / length, length


def radiance(stack, lamp, transport, size):
    """Radiance of the plate towards the eye, (size, size, 3), of a lamp at a point."""
    wi, distance = towards(lamp, size)
    wo, _ = towards(EYE, size)
    return lj.evaluate(stack, wi, wo, transport) * wi[..., 2:] / distance**2


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("material_map"))
    parser.add_argument("--size", type=int, default=SIZE)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    stack, transport = plate(given.size), lj.SpongeCake()
    pictures = []
    for x in LAMPS:
        began = time.perf_counter()
        pictures.append(np.asarray(jax.block_until_ready(radiance(stack, (x, 0.5, HEIGHT), transport, given.size))))
        print(f"lamp at {x:g}: {time.perf_counter() - began:.2f} s")
    brightest = np.percentile(pictures, 99.5)
    figure, axes = plt.subplots(1, len(LAMPS) + 1, figsize=(15, 4.3), layout="constrained")
    shown = axes[0].imshow(stack.layers[0].thickness[..., 0], cmap="viridis", extent=(0, 1, 0, 1), origin="lower")
    axes[0].set_title("optical depth of the coat")
    figure.colorbar(shown, ax=axes[0], shrink=0.8)
    for panel, x, picture in zip(axes[1:], LAMPS, pictures, strict=True):
        panel.imshow(np.clip(picture / brightest, 0.0, 1.0) ** (1 / 2.2), extent=(0, 1, 0, 1), origin="lower")
        panel.set_title(f"lamp at x = {x:g}")
    for panel in axes:
        panel.set_xlabel("x, widths of the plate")
    axes[0].set_ylabel("y, widths of the plate")
    figure.savefig(given.out / "material_map.png", dpi=110)
    print(f"written: {given.out / 'material_map.png'}")


if __name__ == "__main__":
    main()
