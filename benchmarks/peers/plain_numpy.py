"""The forward models once more, as one would write them down in numpy: a yardstick for speed and a check of values.

Nothing here comes from layerjax. The formulas take the elementary functions as an argument, so that the Dr.Jit peer
(see `peers`) evaluates the same ones. Directions are components (3, N); a value is one array (N,) a channel.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.suite.scenes import Parameters, Side


@dataclass(frozen=True)
class Functions:
    """Elementary functions of a library of arrays; one_minus_exp(x) is 1 - exp(-x) without cancellation."""

    exp: Callable[[Any], Any]
    sqrt: Callable[[Any], Any]
    absolute: Callable[[Any], Any]
    minimum: Callable[[Any, Any], Any]
    where: Callable[[Any, Any, Any], Any]
    one_minus_exp: Callable[[Any], Any]


NUMPY = Functions(np.exp, np.sqrt, np.abs, np.minimum, np.where, lambda x: -np.expm1(-x))


def conductor(p: Parameters, wi: Sequence[Any], wo: Sequence[Any], side: Side, f: Functions = NUMPY) -> list[Any]:
    """GGX conductor with separable Smith masking (Walter et al. 2007), wi and wo above."""
    hx, hy, hz, cosine = _half(wi, wo, f)
    squared = p["alpha"] * p["alpha"]
    tilt = hx * hx + hy * hy + squared * hz * hz
    density = squared / (math.pi * tilt * tilt)
    masking = [2.0 / (1.0 + f.sqrt(1.0 + squared * (w[0] * w[0] + w[1] * w[1]) / (w[2] * w[2]))) for w in (wi, wo)]
    lobe = density * masking[0] * masking[1] / (4.0 * wi[2] * wo[2])
    c2 = cosine * cosine
    s2 = 1.0 - c2
    values = []
    for n, k in zip(p["ior"], p["k"], strict=True):
        real = n * n - k * k - s2
        modulus = f.sqrt(real * real + 4.0 * n * n * k * k)
        twice = 2.0 * cosine * f.sqrt(0.5 * (modulus + real))
        perpendicular = (modulus + c2 - twice) / (modulus + c2 + twice)
        parallel = (c2 * modulus + s2 * s2 - twice * s2) / (c2 * modulus + s2 * s2 + twice * s2)
        values.append(lobe * 0.5 * perpendicular * (1.0 + parallel))
    return values


def spongecake(p: Parameters, wi: Sequence[Any], wo: Sequence[Any], side: Side, f: Functions = NUMPY) -> list[Any]:
    """Single scattering in SGGX surface flakes over SGGX fibers (Wang et al. 2022, Sec. 4), upright, without a base."""
    hx, hy, hz, cosine = _half(wi, wo, f)
    rest = 1.0 - f.minimum(cosine, 1.0)
    fifth = rest * rest * rest * rest * rest
    ci, co = f.absolute(wi[2]), f.absolute(wo[2])
    across = hx * hx + hy * hy
    areas, densities = [], []
    for layer in range(2):
        a2 = p[f"alpha_{layer}"] * p[f"alpha_{layer}"]
        surface = layer == 0
        q = across + a2 * hz * hz if surface else a2 * across + hz * hz
        densities.append(a2 / (math.pi * q * q) if surface else a2 * p[f"alpha_{layer}"] / (math.pi * q * q))
        areas.append(
            [
                f.sqrt(a2 * (w[0] * w[0] + w[1] * w[1]) + w[2] * w[2])
                if surface
                else f.sqrt(w[0] * w[0] + w[1] * w[1] + a2 * w[2] * w[2])
                for w in (wi, wo)
            ]
        )
    values = []
    for c in range(3):
        depths = [
            (p[f"thickness_{i}"][c] * areas[i][0] / ci, p[f"thickness_{i}"][c] * areas[i][1] / co) for i in (0, 1)
        ]
        total = 0.0
        for i in (0, 1):
            a, b = depths[i]
            f0 = p[f"f0_{i}"][c]
            collision = p[f"albedo_{i}"][c] * (f0 + (1.0 - f0) * fifth) * 0.25 * densities[i]
            if side == "reflection":
                share = f.one_minus_exp(a + b) / (areas[i][0] * co + areas[i][1] * ci)
                path = depths[0][0] + depths[0][1] if i == 1 else None
            else:
                same = wi[2] * wo[2] > 0
                gap = f.where(same, a + b, f.absolute(a - b))
                wide = gap > 1e-5
                mean = f.where(wide, f.one_minus_exp(gap) / f.where(wide, gap, 1.0), 1.0 - 0.5 * gap)
                share = p[f"thickness_{i}"][c] * mean / (ci * co)
                other = depths[1 - i]  # crossed by a direction that leaves on the other layer's side
                first, second = (wi[2] < 0, wo[2] < 0) if i == 0 else (wi[2] > 0, wo[2] > 0)
                path = f.where(first, other[0], 0.0) + f.where(second, other[1], 0.0)
                path = path + f.where(same, 0.0, f.minimum(a, b))
            term = collision * share
            total = total + (term if path is None else term * f.exp(-path))
        values.append(total)
    return values


Model = Callable[..., list[Any]]
MODELS: dict[str, Model] = {"ior": conductor, "thickness_0": spongecake}


def model_of(parameters: Parameters) -> Model:
    """The formula that takes these parameters."""
    return next(model for name, model in MODELS.items() if name in parameters)


def gradient(
    parameters: Parameters, wi: NDArray[Any], wo: NDArray[Any], target: NDArray[Any], side: Side
) -> tuple[float, dict[str, NDArray[Any]]]:
    """Mean squared difference from `target` (C, N), and its derivatives by forward differences, as numpy has to."""
    model = model_of(parameters)
    step = float(np.sqrt(np.finfo(wi.dtype).eps))

    def loss(changed: Parameters) -> float:
        values = model(changed, wi, wo, side)
        return sum(float(np.mean((v - t) ** 2)) for v, t in zip(values, target, strict=True))

    base = loss(parameters)
    slopes = {}
    for name, value in parameters.items():
        slope = np.zeros(np.shape(value))
        for index in np.ndindex(slope.shape):
            moved = np.array(value, wi.dtype)
            moved[index] += step
            slope[index] = (loss({**parameters, name: moved}) - base) / step
        slopes[name] = slope
    return base, slopes


def _half(wi: Sequence[Any], wo: Sequence[Any], f: Functions) -> tuple[Any, Any, Any, Any]:
    x, y, z = wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2]
    length = f.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length, 0.5 * length
