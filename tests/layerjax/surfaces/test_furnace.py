"""Facets of two widths by a walk in numpy from facet to facet, which shares no code with the package.

After Heitz, Hanika, d'Eon & Dachsbacher 2016: under the Smith assumption a rough surface is a medium of facets. With
depth -log C1(h), where C1 is the distribution of heights, a ray along w meets a facet after an exponential free path
of 1 / |Lambda(w)|, and has left where the depth falls below 0. Slopes are drawn as they are seen, by the
inverse of their distribution against the ray, and exactly as they are across it.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy.special import erf

import layerjax as lj

MOST_FACETS = 2000
METAL = (0.3, 4.0)
KINDS = ["ggx", "beckmann"]


class Walk:
    """Light on a rough mirror: facets of this kind, of two widths along x and y."""

    def __init__(self, kind, widths, seed):
        self.kind, self.widths, self.random = kind, np.asarray(widths), np.random.default_rng(seed)

    def stretched(self, w):
        """z of w, and the length of the rest, as facets of width 1 see them."""
        return w[:, 2], np.hypot(self.widths[0] * w[:, 0], self.widths[1] * w[:, 1])

    def seen_below(self, slope, z, r):
        """Projected area of the facets of width 1 whose slope against the ray is less, integral of P(s) (z - r s)."""
        if self.kind == "ggx":
            root = np.sqrt(1.0 + slope**2)
            return 0.5 * z * (1.0 + slope / root) + 0.5 * r / root
        return 0.5 * z * (1.0 + erf(slope)) + 0.5 * r * np.exp(-(slope**2)) / np.sqrt(np.pi)

    def lamda(self, w):
        """Smith's Lambda of light that goes along w, up or down: facets that face it, over z."""
        z, r = self.stretched(w)
        return np.maximum(self.seen_below(-z / r, -z, r), 1e-300) / z

    def normals(self, w):
        """Normals that are seen along w, by bisection for the arctangent of the slope against it."""
        z, r = self.stretched(w)
        low, high = np.full(z.shape, -0.5 * np.pi), np.arctan2(z, r)  # beyond, facets look away
        wanted = self.random.random(z.size) * self.seen_below(np.tan(high), z, r)
        for _ in range(52):
            middle = 0.5 * (low + high)
            less = self.seen_below(np.tan(middle), z, r) < wanted
            low, high = np.where(less, middle, low), np.where(less, high, middle)
        against = np.tan(0.5 * (low + high))
        if self.kind == "ggx":
            across = np.sqrt((1.0 + against**2) / 3.0) * self.random.standard_t(3, z.size)
        else:
            across = self.random.normal(0.0, np.sqrt(0.5), z.size)
        x, y = self.widths[0] * w[:, 0] / r, self.widths[1] * w[:, 1] / r
        p, q = self.widths[0] * (against * x - across * y), self.widths[1] * (against * y + across * x)
        return np.stack([-p, -q, np.ones_like(p)], axis=-1) / np.sqrt(1.0 + p * p + q * q)[:, None]

    def mirrored(self, w):
        """Where light from w, that has met a facet, goes, and its cosine with the facet."""
        m = self.normals(w)
        cosine = np.sum(w * m, axis=-1)
        return 2.0 * cosine[:, None] * m - w, cosine

    def leaves(self, w):
        """Where light from w leaves, and after how many facets; of the few that have met the most, 0."""
        out, facets = np.zeros_like(w), np.zeros(len(w), int)
        along, depth, inside = -w, np.zeros(len(w)), np.arange(len(w))
        for met in range(MOST_FACETS):
            depth = depth - self.random.exponential(size=len(along)) / self.lamda(along)
            left = depth < 0
            out[inside[left]], facets[inside[left]] = along[left], met
            inside, along, depth = inside[~left], along[~left], depth[~left]
            if not inside.size:
                break
            along, _ = self.mirrored(-along)
        return out, facets


def reflectance(cosine, index):
    root = np.sqrt(index**2 - 1.0 + cosine**2 + 0j)
    s, p = (cosine - root) / (cosine + root), (index**2 * cosine - root) / (index**2 * cosine + root)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


def agrees(samples, expected, slack=0.0):
    samples = np.asarray(samples, float)
    return abs(samples.mean() - expected) < 4.5 * samples.std() / np.sqrt(samples.size) + slack


def furnace(kind, widths, count):
    """Light that falls in from everywhere leaves alike in all directions, and all of it."""
    random = np.random.default_rng(3)
    z, phi = np.sqrt(random.random(count)), 2.0 * np.pi * random.random(count)
    w = np.stack([np.sqrt(1.0 - z * z) * np.cos(phi), np.sqrt(1.0 - z * z) * np.sin(phi), z], axis=-1)
    out, facets = Walk(kind, widths, 4).leaves(w)
    assert facets.min() > 0
    assert np.mean(facets > 1) > 0.02  # it takes several facets
    x, y, z = out.T
    for found, expected in ((z, 2 / 3), (z * z, 1 / 2), (x * x, 1 / 4), (y * y, 1 / 4), (x * y, 0.0), (x, 0.0)):
        assert agrees(found, expected)


def first_facets(kind, widths, theta, phi, count):
    """Energy, and what falls into parts of the hemisphere, of light that one facet mirrors.

    Here masking is separable: light leaves from any height, not from the one at which it came (Heitz 2014, Sec. 6.1).
    """
    wi = np.asarray(lj.direction(theta, phi))
    walk = Walk(kind, widths, 5)
    wo, cosine = walk.mirrored(np.broadcast_to(wi, (count, 3)))
    up = wo[:, 2] > 0
    passed = np.where(up, 1.0 / (1.0 + walk.lamda(np.where(up[:, None], wo, [0.6, 0.0, 0.8]))), 0.0)
    share = passed * reflectance(cosine, METAL[0] + 1j * METAL[1])
    stack = lj.Stack([], lj.Conductor(*METAL, widths[0], kind, alpha_y=widths[1]))
    assert agrees(share, lj.albedo(stack, wi)[0][0], slack=3e-4)  # the rule of facets of `lj.albedo`
    # by sectors of the azimuth, and above and below 45 degrees
    edges, sectors, points = (0.0, np.sqrt(0.5), 1.0), 6, 40
    turn = 2.0 * np.pi / sectors
    x, weight = np.polynomial.legendre.leggauss(points)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    for low, high in pairwise(edges):
        for sector in range(sectors):
            inside = (wo[:, 2] > low) & (wo[:, 2] <= high)
            inside &= np.floor(np.arctan2(wo[:, 1], wo[:, 0]) % (2.0 * np.pi) / turn) == sector
            z = low + (high - low) * x[:, None]
            around = lj.direction(np.arccos(z), turn * (sector + x))
            values = np.asarray(lj.evaluate(stack, wi, around))[..., 0]
            expected = np.sum(values * z * (high - low) * turn * np.outer(weight, weight))
            assert agrees(share * inside, expected, slack=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_furnace_of_two_widths_loses_nothing(kind):
    furnace(kind, (0.4, 0.9), 60_000)


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_facet_of_two_widths_is_that_of_the_walk(kind):
    first_facets(kind, (0.3, 0.7), 1.1, 0.5, 200_000)


@pytest.mark.slow
@pytest.mark.parametrize("widths", [(0.2, 0.4), (1.0, 0.3), (0.05, 0.8)])
@pytest.mark.parametrize("kind", KINDS)
def test_furnaces_of_more_widths(kind, widths):
    furnace(kind, widths, 1_000_000)
    for theta, phi in ((0.2, 1.0), (0.8, -0.3), (1.4, 2.0)):
        first_facets(kind, widths, theta, phi, 1_000_000)
