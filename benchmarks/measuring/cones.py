"""Measurements through apertures by dense quadrature."""

import numpy as np

import layerjax as lj

SINGLE = lj.SingleScattering()


def disc(w: np.ndarray, width: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions over a cone about w (3,) of this full angle, (K, 3), and their shares of its solid angle."""
    radius = np.radians(0.5 * width)
    x, weights = np.polynomial.legendre.leggauss(count)
    cosine = 0.5 * (1.0 + np.cos(radius)) + 0.5 * (1.0 - np.cos(radius)) * x
    turn = 2.0 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    helper = np.array([0.0, 1.0, 0.0]) if abs(w[1]) < 0.5 else np.array([1.0, 0.0, 0.0])
    first = np.cross(helper, w) / np.linalg.norm(np.cross(helper, w))
    across = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(w, first)
    sine = np.sqrt(1.0 - cosine**2)
    found = cosine[:, None, None] * w + sine[:, None, None] * across
    return found.reshape(-1, 3), np.repeat(0.5 * weights, 2 * count) / (2 * count)


def mean_over_cones(
    stack: lj.Stack,
    wi: np.ndarray,
    wo: np.ndarray,
    source: float,
    detector: float,
    transport: lj.Transport = SINGLE,
) -> np.ndarray:
    """BSDF averaged over both apertures, (N, C), each value by hundreds of pairs of directions or more."""
    found, count = [], 6 if source and detector else 12
    for i, o in zip(wi, wo, strict=True):
        (lights, a), (views, b) = (
            disc(w, width, count) if width else (w[None], np.ones(1)) for w, width in ((i, source), (o, detector))
        )
        values = np.asarray(lj.evaluate(stack, lights[:, None], views[None], transport))
        cosines = np.abs(lights[:, None, 2] * views[None, :, 2]) / abs(i[2] * o[2])
        above = (lights[:, None, 2] * i[2] > 0.0) & (views[None, :, 2] * o[2] > 0.0)
        found.append(np.einsum("i,j,ijc->c", a, b, values * (cosines * above)[..., None]))
    return np.array(found)
