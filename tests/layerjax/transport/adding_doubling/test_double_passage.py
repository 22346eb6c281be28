"""Light that comes back from a mirror through the rough interface that let it in, in closed form: against a quadrature
in numpy, the walk, energies and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.transport.adding_doubling.ballistic import ballistic_paths, evaluate_ballistic

METAL = 0.3 + 3.5j
THETA_I, THETA_O, TURN = np.array([[0.5, 0.5, 1.2, 0.0], [0.5, 0.6, 1.15, 0.3], [0.0, 0.05, 0.0, 0.0]])
WI, WO = lj.direction(THETA_I, 0.2), lj.direction(THETA_O, 0.2 + np.pi + TURN)


def coat(ior, alpha, tau=0.0, metal=METAL):
    dye = [lj.Medium(tau, 0.0)] if np.any(tau) else []
    return lj.Stack([lj.Interface(ior, alpha), *dye], lj.Conductor(np.real(metal), np.imag(metal)))


# ---- the path alone ----


def masking(z, alpha):
    return 2.0 * z / (z + np.sqrt(alpha**2 * (1.0 - z * z) + z * z))


def reflectance(cosine, index):
    root = np.sqrt(index**2 - 1.0 + cosine**2 + 0j)
    s, p = (cosine - root) / (cosine + root), (index**2 * cosine - root) / (index**2 * cosine + root)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


def btdf(i, o, n_i, n_o, alpha):
    """Walter et al. 2007, Eq. 21, of GGX facets, for i and o on either side."""
    h = n_i * i + n_o * o
    h = h / np.linalg.norm(h, axis=-1, keepdims=True)
    h = np.where(np.sum(i * h, axis=-1, keepdims=True) < 0.0, -h, h)
    c_i, c_o, upright = np.sum(i * h, axis=-1), np.sum(o * h, axis=-1), h[..., 2] * np.sign(i[..., 2])
    density = alpha**2 / (np.pi * ((alpha**2 - 1.0) * upright**2 + 1.0) ** 2)
    masked = masking(np.abs(i[..., 2]), alpha) * masking(np.abs(o[..., 2]), alpha)
    visible = np.abs(c_i * c_o / (i[..., 2] * o[..., 2])) * masked * density
    value = visible * (n_o / (n_i * c_i + n_o * c_o)) ** 2 * (1.0 - reflectance(np.abs(c_i), n_o / n_i))
    return np.where((upright > 0.0) & (c_o < 0.0), value, 0.0)


def passed_twice(wi, wo, ior, alpha, tau, points=300):
    """f = integral of both BTDFs, the mirror and the medium over directions inside, about where both lobes are."""
    x, weight = np.polynomial.legendre.leggauss(points)
    least = 0.25 * alpha
    end = np.arcsinh(2.0 / least)
    radius, step = least * np.sinh(0.5 * end * (x + 1.0)), least * np.cosh(0.5 * end * (x + 1.0)) * 0.5 * end * weight
    phi = 2.0 * np.pi * (np.arange(points) + 0.5) / points
    middle = 0.5 * (wo[:2] - wi[:2]) / ior
    along = middle + radius[:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    squared = 1.0 - np.sum(along**2, axis=-1, keepdims=True)
    inside = squared > 0.0
    m = np.concatenate([np.where(inside, along, 0.0), np.sqrt(np.where(inside, squared, 1.0))], axis=-1)
    down, z = m * [1.0, 1.0, -1.0], m[..., 2]
    lobes = btdf(wi + 0.0 * m, down, 1.0, ior, alpha) * btdf(-m, wo + 0.0 * m, ior, 1.0, alpha)
    level = reflectance(z, METAL / ior) * np.exp(-2.0 * tau / z)
    # dm cos(m) is dx dy
    return np.sum(np.where(inside[..., 0], lobes * level, 0.0) * (radius * step)[:, None]) * 2.0 * np.pi / points


CASES = [
    (1.5, 0.1, 0.3),
    *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1.5, 0.05, 0.0), (1.27, 0.4, 0.0), (1.8, 0.5, 0.2))),
]


@pytest.mark.parametrize(("ior", "alpha", "tau"), CASES)
def test_is_a_quadrature_over_directions_inside(ior, alpha, tau):
    """At the mirror direction and beside it, to 1e-3 and, of tails, 1e-4 of the largest."""
    (path,) = ballistic_paths(coat(ior, alpha, tau))
    assert not path.crosses
    (found,) = jax.jit(evaluate_ballistic)(path, split(WI), split(WO))
    expected = [passed_twice(wi, wo, ior, alpha, tau) for wi, wo in zip(np.asarray(WI), np.asarray(WO), strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * max(expected))


def test_derivatives_are_those_of_differences():
    def values(numbers):
        ior, alpha, tau, n, k = numbers
        stack = lj.Stack([lj.Interface(ior, alpha), lj.Medium(tau, 0.0)], lj.Conductor(n, k))
        return evaluate_ballistic(ballistic_paths(stack)[0], split(WI), split(WO))[0]

    start = jnp.asarray([1.5, 0.1, 0.3, 0.3, 3.5])
    compiled, slopes = jax.jit(values), jax.jit(jax.jacfwd(values))(start)
    for place in range(start.size):
        step = jnp.zeros(start.size).at[place].set(1e-5)
        difference = (compiled(start + step) - compiled(start - step)) / 2e-5
        np.testing.assert_allclose(slopes[..., place], difference, rtol=1e-5, atol=1e-5 * np.abs(difference).max())


# ---- the whole stack ----


@pytest.mark.parametrize("alpha", [0.1, pytest.param(0.4, marks=pytest.mark.slow)])
def test_the_mirror_direction_does_not_depend_on_the_nodes(alpha):
    """On the grid alone it changed by 1e-3 to 1e-2, the more the more nodes there are."""
    stack, wi, wo = coat(1.27, alpha), lj.direction(1.2, 0.0), lj.direction([1.2, 1.1], [np.pi, 3.0])
    coarse, fine = (lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=n, modes=24)) for n in (12, 40))
    np.testing.assert_allclose(coarse, fine, rtol=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        coat(1.5, 0.05),
        coat(1.5, 0.5),
        lj.Stack([lj.Medium(0.2, 0.5), *coat(1.5, 0.1, 0.3).layers], lj.Conductor([0.3, 1.0], [3.5, 2.0])),
        lj.Stack([lj.Interface(1.6, 0.2, "beckmann")], lj.Conductor(0.3, 3.5)),
        lj.Stack([lj.Interface(1.5, 0.2, film=lj.ThinFilm(2.0, 120.0, [610.0, 465.0]))], lj.Conductor(0.3, 3.5)),
    ],
    ids=["narrow", "wide", "haze on it", "Beckmann", "film"],
)
def test_agrees_with_the_walk(stack):
    values = np.asarray(lj.evaluate(stack, WI, WO, lj.AddingDoubling(nodes=16, modes=24)))
    walked, errors = map(
        np.asarray,
        lj.evaluate_with_error(stack, WI, WO, lj.RandomWalk(paths=1 << 16), key=jax.random.key(1)),
    )
    assert np.all(np.abs(values - walked) < 4.5 * errors + 1e-3 * (walked + 0.1 * np.max(walked)))


@pytest.mark.slow
def test_values_sum_to_the_albedo():
    """Over the upper hemisphere."""
    stack = coat(1.5, 0.4, metal=0.01 + 20.0j)
    transport, wi = lj.AddingDoubling(nodes=16, modes=24), lj.direction(0.7, 0.0)
    x, weight = np.polynomial.legendre.leggauss(60)
    z, phi = 0.5 * (x + 1.0), 2.0 * np.pi * (np.arange(120) + 0.5) / 120
    values = np.asarray(lj.evaluate(stack, wi, lj.direction(np.arccos(z)[:, None], phi), transport))[..., 0]
    energy = np.sum(0.5 * weight * z * values.mean(axis=1)) * 2.0 * np.pi
    np.testing.assert_allclose(energy, lj.albedo(stack, wi, transport)[0][0], rtol=1e-3)
