"""Small models with known answers: data at given directions, and functions that stand in for a transport."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from fits import Discrepancy, Fit, Free, Measurements, Noise, Problem, fit, slices
from fits.data.geometry import Pairs


def directions(count: int, seed: int, lowest_cosine: float = 0.2) -> np.ndarray:
    """Random unit vectors above the surface, (count, 3)."""
    generator = np.random.default_rng(seed)
    cosine, azimuth = generator.uniform(lowest_cosine, 1.0, count), generator.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def measured(values: ArrayLike, sigma: ArrayLike | None = None, mask: ArrayLike | None = None) -> Measurements:
    """Values (N, C) at N fixed random directions."""
    values = np.asarray(values, float)
    count, channels = values.shape
    return Measurements(
        wi=directions(count, 1),
        wo=directions(count, 2),
        values=values,
        sigma=None if sigma is None else np.broadcast_to(sigma, values.shape),
        mask=np.ones(count, bool) if mask is None else np.asarray(mask),
        channels=tuple(f"c{channel}" for channel in range(channels)),
    )


def along(
    geometry: Pairs, values: ArrayLike = 1.0, sigma: ArrayLike | None = None, channels: Sequence[str] = ("value",)
) -> Measurements:
    """Values (N, C) along the directions of a geometry, all of them used."""
    shape = len(geometry), len(channels)
    values, sigma = (None if one is None else np.broadcast_to(one, shape) for one in (values, sigma))
    return Measurements(geometry.wi, geometry.wo, values, sigma, np.ones(len(geometry), bool), tuple(channels))


def line(stack: Any, wi: Any, wo: Any) -> Any:
    """a + b cos(theta_o), one channel: linear in its parameters, so that every answer is known."""
    return (stack["a"] + stack["b"] * wo[:, 2])[:, None]


def design(count: int) -> np.ndarray:
    """The columns of `line` at the directions of `measured`."""
    return np.stack([np.ones(count), directions(count, 2)[:, 2]], axis=-1)


SCANS = slices([10.0, 30.0, 50.0, 70.0], np.arange(-80.0, 81.0, 4.0))
POSITIVE_LINE = {"a": Free(0.9, 0.1, 3.0), "b": Free(0.1, -1.0, 3.0)}


def wrong_line(seed: int, discrepancy: Discrepancy, sigma: float = 0.02) -> Measurements:
    """Readings of a line along SCANS as the noise model says: a smooth discrepancy of the logarithm, and noise."""
    generator = np.random.default_rng(seed)
    exact = np.asarray(line({"a": 1.0, "b": 0.5}, SCANS.wi, SCANS.wo))
    noise = Noise(relative=sigma, floor=1e-4, discrepancy=discrepancy)
    problem = Problem(POSITIVE_LINE, along(SCANS), line, noise)
    process = problem.model.process
    white = generator.standard_normal((1, len(process.where)))
    drawn = np.asarray(process.sample(white, problem.build([1.0, 0.5]).correlation))
    return along(SCANS, exact * np.exp(drawn) * (1.0 + sigma * generator.standard_normal(exact.shape)))


COUNT = 100
LINE = {"a": Free(0.9, -1.0, 3.0), "b": Free(0.1, -1.0, 3.0)}
TRUTH = np.array([1.0, 0.5])


def line_data(sigma: float = 0.05, seed: int = 0, truth: ArrayLike = TRUTH) -> Measurements:
    """COUNT readings of the line with these parameters, with noise."""
    noise = np.random.default_rng(seed).standard_normal((COUNT, 1))
    return measured((design(COUNT) @ truth)[:, None] + sigma * noise, sigma)


def line_fit(seed: int = 0) -> Fit:
    """The fit of a line to `line_data`."""
    return fit(LINE, line_data(seed=seed), transport=line, starts=2)


def student_fit() -> Fit:
    """The fit of a line, the level of its noise, and tails of Student's."""
    noise = Noise(relative=0.0, floor=Free(0.1, 1e-3, 1.0), tails="student")
    return fit(LINE, measured(line_data().values), transport=line, noise=noise, starts=4)


def lobe(stack: Any, wi: Any, wo: Any) -> Any:
    """Six parameters: a GGX coat, a diffuse base seen through an absorber, and single scattering in it."""
    xp = np if isinstance(wi, np.ndarray) else jnp
    cos_i, cos_o = wi[:, 2], wo[:, 2]
    half = wi + wo
    half = half / xp.sqrt(xp.sum(half * half, axis=-1, keepdims=True))
    cos_h, cos_d = half[:, 2], xp.sum(wi * half, axis=-1)
    alpha2 = stack["alpha"] ** 2
    density = alpha2 / (np.pi * (cos_h**2 * (alpha2 - 1) + 1) ** 2)
    masking = [2 / (1 + xp.sqrt(1 + alpha2 * (1 - c * c) / (c * c))) for c in (cos_i, cos_o)]
    g = xp.sqrt(stack["ior"] ** 2 - 1 + cos_d**2)
    fresnel = 0.5 * ((g - cos_d) / (g + cos_d)) ** 2
    fresnel = fresnel * (1 + ((cos_d * (g + cos_d) - 1) / (cos_d * (g - cos_d) + 1)) ** 2)
    coat = stack["gain"] * fresnel * density * masking[0] * masking[1] / (4 * cos_i * cos_o)
    passed = xp.exp(-stack["depth"] * (1 / cos_i + 1 / cos_o))
    cos_s, asymmetry = -xp.sum(wi * wo, axis=-1), stack["g"]
    phase = (1 - asymmetry**2) / (4 * np.pi * (1 + asymmetry**2 - 2 * asymmetry * cos_s) ** 1.5)
    return (coat + passed * stack["albedo"] / np.pi + phase * (1 - passed) / (cos_i + cos_o))[:, None]


LOBE = {"alpha": 0.2, "gain": 0.9, "ior": 1.5, "albedo": 0.3, "depth": 0.3, "g": 0.4}
LOBE_STACK = {
    "alpha": Free(0.4, 0.05, 1.0),
    "gain": Free(0.5, 0.0, 2.0),
    "ior": Free(1.7, 1.2, 2.5),
    "albedo": Free(0.5, 0.0, 1.0),
    "depth": Free(0.5, 0.0, 3.0),
    "g": Free(0.0, -0.9, 0.9),
}


def noisy_lobe(seed: int, count: int = 600) -> Measurements:
    """Readings of the lobe with the parameters LOBE, with an error of 5 in 100."""
    exact = lobe(LOBE, directions(count, 1), directions(count, 2))
    sigma = 0.05 * exact
    return measured(exact + sigma * np.random.default_rng(seed).standard_normal(exact.shape), sigma)
