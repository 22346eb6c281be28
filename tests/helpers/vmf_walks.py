"""Energies of rough surfaces with von Mises-Fisher normals by a walk in numpy that shares no code with the package.

Normals are drawn from the distribution itself, above the horizon; a facet weighs what it shows to the light,
G1 <w, m> S / (cos N), S the share of the sphere's normals that lie above and N their projected area.
"""

import numpy as np
from scipy.special import ndtr


def mean_length(kappa):
    """A3 and its derivative."""
    return 1 / np.tanh(kappa) - 1 / kappa, 1 / kappa**2 - 1 / np.sinh(np.minimum(kappa, 300.0)) ** 2


def projected(cosine, kappa):
    """N, S and N / (the projected area along a direction, by a normal distribution of <w, m>): G1 over its cosine."""
    length, slope = mean_length(kappa)
    norm = (kappa - 1 + np.exp(-kappa)) / (kappa * -np.expm1(-2 * kappa))
    cosine = np.minimum(cosine, 1.0)
    mean, sd = length * cosine, np.sqrt(cosine**2 * slope + (1 - cosine**2) * length / kappa)
    area = mean * ndtr(mean / sd) + sd * np.exp(-0.5 * (mean / sd) ** 2) / np.sqrt(2 * np.pi)
    return norm, 1 / (1 + np.exp(-kappa)), np.minimum(norm / area, 1 / np.maximum(cosine, 1e-12))


def fresnel(cosine, eta):
    """Reflectance of a dielectric, and the cosine of refraction."""
    squared = 1 - (1 - cosine**2) / eta**2
    inside = np.sqrt(np.where(squared > 0, squared, 0.25))
    s, p = (cosine - eta * inside) / (cosine + eta * inside), (eta * cosine - inside) / (eta * cosine + inside)
    return np.where(squared > 0, 0.5 * (s * s + p * p), 1.0), inside


def metallic(cosine, index):
    """Reflectance of a conductor of complex index."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2 + 0j)
    s, p = (cosine - index * inside) / (cosine + index * inside), (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


class Face:
    """Facets that light meets: it is turned to the side of its z, and comes back weighed."""

    def __init__(self, kappa, random, masked=True):
        self.kappa, self.random, self.masked = kappa, random, masked

    def facets(self, w):
        """Normals, their cosines with w and what each weighs, for directions away from the surface, z > 0."""
        n = len(w)
        drop = -np.log1p(self.random.random(n) * np.expm1(-self.kappa)) / self.kappa
        sine, phi = np.sqrt(drop * (2 - drop)), 2 * np.pi * self.random.random(n)
        m = np.stack([sine * np.cos(phi), sine * np.sin(phi), 1 - drop], axis=-1)
        cosine = np.maximum(np.sum(w * m, axis=-1), 0.0)
        norm, share, over = projected(w[:, 2], self.kappa)
        return m, cosine, cosine * share / norm * (over if self.masked else 1 / w[:, 2])

    def leaving(self, z):
        """G1 of what leaves with that cosine, 0 for none."""
        up = np.maximum(z, 1e-12)
        return np.where(z > 0, up * projected(up, self.kappa)[2] if self.masked else 1.0, 0.0)

    def mirrors(self, w):
        m, cosine, weight = self.facets(w)
        wo = 2 * cosine[:, None] * m - w
        return wo, weight * self.leaving(wo[:, 2]), cosine

    def crosses(self, w, eta):
        """Directions counted from the far side (z > 0), and weights."""
        m, cosine, weight = self.facets(w)
        level, inside = fresnel(cosine, eta)
        wo = (cosine / eta - inside)[:, None] * m - w / eta
        wo[:, 2] *= -1
        return wo, weight * (1 - level) * self.leaving(wo[:, 2])

    def reflects(self, w, eta):
        wo, weight, cosine = self.mirrors(w)
        return wo, weight * fresnel(cosine, eta)[0]


def mean_and_error(x):
    return np.mean(x), np.std(x) / np.sqrt(len(x))


def coated_energies(theta, eta, top, base, bounces, count, seed, index=None, masked=True):
    """Energy, with its standard error, after each number of bounces at the base: none, one, ...

    Args:
        top: kappa of the interface.
        base: kappa of a metal under it, or None for a Lambertian of albedo 1.
        index: complex index of the metal, relative to what surrounds the stack; None: it is a perfect mirror.
    """
    random = np.random.default_rng(seed)
    upper, lower = Face(top, random, masked), None if base is None else Face(base, random, masked)
    w = np.broadcast_to([np.sin(theta), 0.0, np.cos(theta)], (count, 3))
    out = [mean_and_error(upper.reflects(w, eta)[1])]
    w, weight = upper.crosses(w, eta)
    for _ in range(bounces):
        if lower is None:
            z, phi = np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
            weight = np.where(w[:, 2] > 0, weight, 0.0)
            w = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
        else:
            w, gain, cosine = lower.mirrors(np.where(w[:, 2:] > 0, w, [0, 0, 1]))
            weight = weight * gain * (1.0 if index is None else metallic(cosine, index / eta))
        w = np.where(w[:, 2:] > 0, w, [0, 0, 1])  # without weight
        _, gain = upper.crosses(w, 1 / eta)
        out.append(mean_and_error(weight * gain))
        w, gain = upper.reflects(w, 1 / eta)
        weight = weight * gain
    return out
