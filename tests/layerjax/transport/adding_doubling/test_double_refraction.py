"""Light that two rough interfaces of two widths refract: against a quadrature in numpy, symmetries and differences."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.transport.adding_doubling.ballistic import ballistic_paths, evaluate_ballistic
from tests.helpers.derivatives import with_slopes

THETA_I, PHI_I = np.array([[0.0, 0.5, 0.5, 1.0, 1.3], [0.3, 0.4, 2.0, 1.0, 0.5]])
THETA_O, TURN = np.array([[0.2, 0.5, 0.8, 0.9, 1.2], [0.0, 0.1, 0.3, -0.4, 0.1]])
WI, WO = lj.direction(THETA_I, PHI_I), lj.direction(np.pi - THETA_O, PHI_I + np.pi + TURN)
WIDE = ((0.3, 0.5, 0.0, "ggx"), (0.4, 0.3, 0.7, "beckmann"))


@jax.jit
def transmitted(path, wi, wo):
    return evaluate_ballistic(path, split(wi), split(wo))


def interface(ior, alpha, alpha_y, tangent, kind="ggx"):
    return lj.Interface(ior, alpha, kind, alpha_y=alpha_y, tangent=tangent)


def slab(upper, lower, ior=1.5, below=1.0, media=()):
    return lj.Stack([interface(ior, *upper), *media, interface(below, *lower)])


def values(stack, wi=WI, wo=WO):
    (path,) = ballistic_paths(stack)
    return np.asarray(transmitted(path, wi, wo)[0])


# ---- a quadrature over directions between the interfaces ----


def in_frame(w, face):
    c, s = np.cos(face[2]), np.sin(face[2])
    return c * w[..., 0] + s * w[..., 1], c * w[..., 1] - s * w[..., 0], np.abs(w[..., 2])


def masking(w, face):
    """Smith's G1 (Walter et al. 2007) of the width along w (Heitz 2014, Eq. 80)."""
    x, y, z = in_frame(w, face)
    slope = np.sqrt((face[0] * x) ** 2 + (face[1] * y) ** 2) / z
    if face[3] == "ggx":
        return 2.0 / (1.0 + np.sqrt(1.0 + slope**2))
    a = 1.0 / np.maximum(slope, 1e-3)  # beyond it G1 is 1
    return 2.0 / (1.0 + np.asarray(jax.scipy.special.erf(a)) + np.exp(-a * a) / (a * np.sqrt(np.pi)))


def density(m, face):
    x, y, z = in_frame(m, face)
    squared = ((x / face[0]) ** 2 + (y / face[1]) ** 2) / z**2
    slopes = np.exp(-squared) if face[3] == "beckmann" else (1.0 + squared) ** -2
    return slopes / (np.pi * face[0] * face[1] * z**4)


def passed_fresnel(cosine, index):
    root = np.sqrt(np.maximum(index**2 - 1.0 + cosine**2, 0.0))
    s, p = (cosine - root) / (cosine + root), (index**2 * cosine - root) / (index**2 * cosine + root)
    return 1.0 - 0.5 * (s**2 + p**2)


def btdf(i, o, n_i, n_o, face):
    """Walter et al. 2007, Eq. 21, for i and o on either side."""
    h = n_i * i + n_o * o
    h = h / np.linalg.norm(h, axis=-1, keepdims=True)
    h = np.where(np.sum(i * h, axis=-1, keepdims=True) < 0.0, -h, h)
    c_i, c_o, upright = np.sum(i * h, axis=-1), np.sum(o * h, axis=-1), h[..., 2] * np.sign(i[..., 2])
    exists = (upright > 0.0) & (c_o < 0.0)
    facets = density(np.where(exists[..., None], h, [0.0, 0.0, 1.0]), face)
    visible = np.abs(c_i * c_o / (i[..., 2] * o[..., 2])) * masking(i, face) * masking(o, face) * facets
    value = visible * (n_o / (n_i * c_i + n_o * c_o)) ** 2 * passed_fresnel(np.abs(c_i), n_o / n_i)
    return np.where(exists, value, 0.0)


def crowded(centres, least, points):
    """Points in (-1, 1) and their weights, crowded about both centres."""
    x, weight = np.polynomial.legendre.leggauss(points)
    found = []
    bounds = sorted({-1.0, 1.0, *centres})
    for start, stop in pairwise(bounds):
        half = 0.5 * (stop - start)
        end = np.arcsinh(half / least)
        place = least * np.sinh(0.5 * end * (x + 1.0))
        step = least * np.cosh(0.5 * end * (x + 1.0)) * 0.5 * end * weight
        found += [(start + place, step), (stop - place, step)]
    return (np.concatenate(part) for part in zip(*found, strict=True))


def refracted_twice(wi, wo, upper, lower, ior, below, tau=0.0, points=150):
    """f = integral of both BTDFs over directions between, about where flat interfaces refract to; dm cos(m) = dx dy."""
    least = 0.25 * min(*upper[:2], *lower[:2])
    axes = [crowded((-wi[k] / ior, below * wo[k] / ior), least, points) for k in (0, 1)]
    (x, step_x), (y, step_y) = axes
    total = 0.0
    for place, step in zip(x, step_x, strict=True):
        squared = 1.0 - place**2 - y**2
        inside = squared > 0.0
        z = np.sqrt(np.where(inside, squared, 1.0))
        down = np.stack([np.where(inside, place, 0.0), np.where(inside, y, 0.0), -z], axis=-1)
        first, second = btdf(wi + 0.0 * down, down, 1.0, ior, upper), btdf(-down, wo + 0.0 * down, ior, below, lower)
        total += step * np.sum(np.where(inside, first * second * np.exp(-tau / z), 0.0) * step_y)
    return total


slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("upper", "lower", "ior", "below"),
    [
        (*WIDE, 1.5, 1.0),
        ((0.05, 0.5, 0.3, "ggx"), (0.5, 0.05, 0.6, "ggx"), 1.5, 1.2),
        slow((0.1, 0.4, 0.3, "ggx"), (0.1, 0.4, 0.3, "ggx"), 1.5, 1.0),
        slow((0.02, 0.5, 0.0, "ggx"), (0.02, 0.5, 0.5 * np.pi, "ggx"), 1.5, 1.2),
        slow((0.05, 0.5, 0.0, "beckmann"), (0.5, 0.05, 0.0, "beckmann"), 1.5, 1.2),
        slow((0.3, 0.6, 0.3, "beckmann"), (0.02, 0.1, 1.0, "ggx"), 1.3, 1.0),
        slow((0.01, 1.0, 0.0, "ggx"), (0.3, 0.3, 0.0, "ggx"), 1.5, 1.0),
        slow((0.3, 0.8, 0.4, "ggx"), (0.9, 0.2, 0.6, "ggx"), 1.1, 1.0),
        slow((0.2, 0.5, 0.3, "ggx"), (0.5, 0.1, 0.6, "ggx"), 0.8, 1.0),
    ],
)
def test_is_a_quadrature_over_directions_between(upper, lower, ior, below):
    """To 1e-3 and, of tails, 3e-4 of the largest."""
    tau = 0.2
    found = values(slab(upper, lower, ior, below, [lj.Medium(tau, 0.0)]))
    expected = [
        refracted_twice(wi, wo, upper, lower, ior, below, tau)
        for wi, wo in zip(np.asarray(WI), np.asarray(WO), strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=3e-4 * max(expected))


@pytest.mark.parametrize("kind", ["ggx", pytest.param("beckmann", marks=pytest.mark.slow)])
def test_equal_widths_are_one_width(kind):
    """To 1e-3 and, of tails, 1e-4 of the largest, which either quadrature is right to."""
    one = lj.Stack([lj.Interface(1.5, 0.2, kind), lj.Interface(1.2, 0.4, kind)])
    found = values(slab((0.2, 0.2, 0.4, kind), (0.4, 0.4, -1.0, kind), 1.5, 1.2))
    expected = values(one)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.max(expected))
    assert np.max(np.abs(found / values(slab((0.2, 0.4, 0.4, kind), (0.4, 0.2, -1.0, kind), 1.5, 1.2)) - 1.0)) > 0.1


def test_swapped_widths_are_a_quarter_turn_and_all_turns_together():
    upper, lower = WIDE
    expected = values(slab(upper, lower))
    swapped = [(across, along, tangent - 0.5 * np.pi, kind) for along, across, tangent, kind in (upper, lower)]
    np.testing.assert_allclose(values(slab(*swapped)), expected, rtol=1e-4)
    turned = [(along, across, tangent + 0.8, kind) for along, across, tangent, kind in (upper, lower)]
    wi, wo = (lj.direction(*(lj.angles(w)[0], lj.angles(w)[1] + 0.8)) for w in (WI, WO))
    np.testing.assert_allclose(values(slab(*turned), wi, wo), expected, rtol=1e-6)  # points do not all turn with them


def test_is_reciprocal_and_turns_upside_down():
    stack = slab(*WIDE, 1.5, 1.2)
    np.testing.assert_allclose(values(stack), 1.2**2 * values(stack, WO, WI), rtol=1e-9)
    # seen from below x and z are turned round, so that tangents are mirrored
    (upper, lower), around = WIDE, np.array([-1.0, 1.0, -1.0])
    reversed_stack = slab(*((a, b, -t, kind) for a, b, t, kind in (lower, upper)), 1.5 / 1.2, 1.0 / 1.2)
    found = values(reversed_stack, WO * around, WI * around)
    np.testing.assert_allclose(found, values(stack, WO, WI), rtol=1e-3, atol=1e-4 * np.max(np.asarray(found)))


def test_a_mirror_under_the_interface_is_a_slab():
    """With the interface again, seen in the mirror: the metal keeps less than 1e-3."""
    face, wo = (0.1, 0.4, 0.3, "ggx"), WO * np.array([1.0, 1.0, -1.0])
    (path,) = ballistic_paths(lj.Stack([interface(1.5, *face), lj.Medium(0.1, 0.0)], lj.Conductor(0.01, 20.0)))
    assert not path.crosses
    expected = values(slab(face, face, 1.5, 1.0, [lj.Medium(0.2, 0.0)]))
    np.testing.assert_allclose(transmitted(path, WI, wo)[0], expected, rtol=1e-3)


@pytest.mark.parametrize(
    ("dtype", "mode"),
    [(np.float32, "forward"), slow(np.float32, "reverse"), slow(np.float64, "forward"), slow(np.float64, "reverse")],
)
def test_values_and_slopes_are_finite(dtype, mode):
    random = np.random.default_rng(3)
    count, ends = 60, [1e-4, 0.01, 0.3, 1.0]
    numbers = np.concatenate(
        [
            random.choice([0.25, 0.8, 1.0, 1.0 + 1e-6, 1.5, 4.0], (2, count)),
            random.choice(ends, (4, count)),
            random.choice([-3.0, 0.0, 0.5 * np.pi, 1.0], (2, count)),
        ]
    ).astype(dtype)
    theta = random.choice([0.0, 1e-3, 0.5, 1.2, 0.5 * np.pi - 1e-6], (2, count))
    wi = np.asarray(lj.direction(theta[0], random.uniform(-3, 3, count))).astype(dtype)
    wo = np.asarray(lj.direction(np.pi - theta[1], random.uniform(-3, 3, count))).astype(dtype)

    def value(numbers, wi, wo):
        ior, below, alpha, alpha_y, second, second_y, tangent, other = numbers
        stack = slab((alpha, alpha_y, tangent), (second, second_y, other), ior, below)
        return evaluate_ballistic(ballistic_paths(stack)[0], split(wi), split(wo))[0]

    found, slopes = jax.jit(jax.vmap(with_slopes(value, (0,), mode)))(numbers.T, wi, wo)
    for leaf in jax.tree.leaves((found, slopes)):
        assert np.isfinite(leaf).all()
    assert np.all(np.asarray(found) >= 0.0)


def test_derivatives_are_those_of_differences():
    def value(numbers):
        ior, below, alpha, alpha_y, second, second_y, tangent, other = numbers
        stack = slab((alpha, alpha_y, tangent), (second, second_y, other, "beckmann"), ior, below)
        return evaluate_ballistic(ballistic_paths(stack)[0], split(WI), split(WO))[0]

    start = jnp.asarray([1.5, 1.2, 0.1, 0.4, 0.5, 0.2, 0.3, 1.0])
    compiled, slopes = jax.jit(value), jax.jit(jax.jacfwd(value))(start)
    for place in range(start.size):
        step = jnp.zeros(start.size).at[place].set(1e-5)
        difference = (compiled(start + step) - compiled(start - step)) / 2e-5
        np.testing.assert_allclose(slopes[..., place], difference, rtol=1e-5, atol=1e-5 * np.abs(difference).max())


# ---- the whole stack ----

FLAKES = lj.Medium(0.4, 0.8, lj.SGGX("surface", 0.4, (0.6, 0.0, 0.8)), 0.5)
FILM = lj.ThinFilm(2.0, 120.0, [610.0, 465.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([interface(1.5, 0.1, 0.4, 0.3)], lj.Conductor(0.3, 3.5)),
        lj.Stack(
            [lj.Medium(0.2, 0.5), interface(1.5, 0.3, 0.1, 0.3), lj.Medium(0.3, 0.5), interface(1.2, 0.2, 0.4, 0.0)]
        ),
        lj.Stack([lj.Interface(1.5, 0.2), FLAKES, lj.Interface(1.2, 0.3, "vmf")]),
        lj.Stack([lj.Interface(1.5, 0.2, film=FILM), interface(1.2, 0.2, 0.4, 0.5)]),
    ],
    ids=["mirror", "haze", "tilted flakes", "film"],
)
def test_agrees_with_the_walk(stack):
    """4.5 standard errors and the error that the solver estimates, which is below 2 % of values and mean."""
    wo = WO * np.array([1.0, 1.0, -1.0]) if stack.base is not None else WO
    exact, doubt = lj.evaluate_with_error(stack, WI, wo, lj.AddingDoubling(ordinates=(12, 20)))
    walk = lj.RandomWalk(paths=1 << 15)
    mean, error = map(np.asarray, lj.evaluate_with_error(stack, WI, wo, walk, key=jax.random.key(1)))
    assert np.all(np.abs(exact - mean) < 4.5 * error + doubt + 1e-3 * (mean + 0.1 * np.max(mean)))
    assert np.all(doubt < 0.02 * (exact + np.mean(exact)))
