"""Every sampler against its own density: chi-square over bins of equal-area cells, tilted and from below too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import join, split
from layerjax.normals.ggx import ggx_density, ggx_masking, ggx_sample
from tests.helpers.cases import haze, tilt3
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square, density_of

SINGLE = lj.SingleScattering()

ABOVE, BELOW, GRAZING = (0.7, 0.4), (2.3, 1.0), (1.45, 2.0)

STACKS = {
    "surface": lj.Stack([lj.Medium(2.0, phase=lj.SGGX("surface", 0.3))]),
    "surface, tilted": lj.Stack([lj.Medium(2.0, phase=lj.SGGX("surface", 0.4, (0.4, 0.2, 0.9)))]),
    "fiber, in the plane": lj.Stack([lj.Medium(1.0, phase=lj.SGGX("fiber", 0.3, (1.0, 0.0, 0.0)))]),
    "fiber, upright": lj.Stack([lj.Medium(1.0, phase=lj.SGGX("fiber", 0.5))]),
    "rayleigh": lj.Stack([lj.Medium(1.0, phase=lj.Rayleigh())]),
    "haze": lj.Stack([haze(0.6, 1.0)]),
    "haze, backward": lj.Stack([haze(-0.4, 1.0)]),
    "three layers": lj.Stack(tilt3()),
}
OPAQUE = {
    "lambertian": lj.Stack([], lj.Lambertian(0.5)),
    "oren-nayar": lj.Stack([], lj.OrenNayar(0.8, 0.9)),
    "oren-nayar, classic": lj.Stack([], lj.OrenNayar(0.8, 0.9, form="classic")),
    "conductor": lj.Stack([], lj.Conductor(0.2, 3.9, 0.3)),
    "haze on conductor": lj.Stack([haze(0.5, 0.7, 0.8)], lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.5, 2.4], 0.25)),
}
OPAQUE["mixture"] = lj.Mixture({"metal": OPAQUE["conductor"], "dusty": OPAQUE["haze on conductor"]}, [0.35, 0.65])
CASES = [(name, stack, ABOVE) for name, stack in (STACKS | OPAQUE).items()]
CASES += [(name, STACKS[name], BELOW) for name in ("surface, tilted", "fiber, in the plane", "haze", "three layers")]
CASES += [(name, OPAQUE[name], GRAZING) for name in ("oren-nayar", "conductor")]
QUICK = ("lambertian", "oren-nayar", "conductor", "haze", "haze, from below")
"""The others, among them all with tilted axes or several layers, are slow."""
CASES = [
    pytest.param(*case, id=f"{case[0]}, theta {case[2][0]}", marks=[pytest.mark.slow] * (named not in QUICK))
    for case in CASES
    for named in [f"{case[0]}{', from below' * (case[2] == BELOW)}"]
]


@pytest.mark.parametrize(("name", "stack", "wi"), CASES)
def test_samples_follow_their_density(name, stack, wi):
    wi = lj.direction(*wi)
    towards = jnp.broadcast_to(wi, (DRAWS, 3))
    wo, density, weight = lj.sample(stack, towards, jax.random.key(7), SINGLE)
    above_only = name in OPAQUE  # a surface states its density above the horizon alone
    keep = wo[:, 2] > 0 if above_only else slice(None)

    def cells(w):
        return (
            jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w, SINGLE), 0.0) if above_only else lj.pdf(stack, wi, w, SINGLE)
        )

    probability, total = chi_square(wo[keep], cells)
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, 1.0 if not above_only else np.mean(wo[:, 2] > 0), atol=4e-3)
    found = density_of(wo, lambda w: lj.pdf(stack, wi, w, SINGLE))
    np.testing.assert_allclose(density[:100], found[:100], rtol=1e-9)

    mean, error = np.mean(weight, axis=0), np.std(weight, axis=0) / np.sqrt(DRAWS)
    reflected, transmitted = lj.albedo(stack, wi, SINGLE)
    np.testing.assert_array_less(np.abs(mean - (reflected + transmitted)), 4.5 * error + 1e-6)
    assert np.max(weight) <= 1.0 + 1e-9 or name.startswith("oren-nayar")


def test_ggx_normals_follow_the_visible_density():
    alpha = jnp.asarray(0.4)
    wi = lj.direction(1.2, 0.7)
    u = jax.random.uniform(jax.random.key(3), (2, DRAWS))
    towards = tuple(jnp.full(DRAWS, component) for component in wi)
    normals = join(ggx_sample(towards, alpha, u[0], u[1]))

    def density(m):
        m = split(m)
        cosine = wi[0] * m[0] + wi[1] * m[1] + wi[2] * m[2]
        visible = jnp.maximum(cosine, 0.0) * ggx_density(m, alpha)
        masked = ggx_masking(split(wi), alpha) / wi[2]
        return jnp.where(m[2] > 0, masked * visible, 0.0)

    probability, total = chi_square(normals, density)
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, 1.0, atol=4e-3)


def test_picks_by_collision_probability():
    # two absorbing-free hazes: shares of first collisions by Beer's law
    thin, thick = 0.3, 1.1
    stack = lj.Stack([haze(0.98, thin), haze(-0.98, thick)])
    wi = lj.direction(0.5, 0.0)
    wo, _, _ = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(5), SINGLE)
    onward = np.mean(np.asarray(wo @ wi) < 0)
    c = float(wi[2])
    share = (1 - np.exp(-thin / c)) / (1 - np.exp(-(thin + thick) / c))
    # of g = 0.98 light, the part deflected by more than a right angle, from the cumulative distribution
    g = 0.98
    stray = (1 - g**2) / (2 * g) * (1 / np.sqrt(1 + g**2) - 1 / (1 + g))
    expected = share * (1 - stray) + (1 - share) * stray
    assert abs(onward - expected) < 4.5 * np.sqrt(expected * (1 - expected) / DRAWS)


def test_the_same_key_draws_the_same():
    stack = lj.Stack(tilt3())
    wi = jnp.broadcast_to(lj.direction(0.5, 0.0), (10, 3))
    first, again = (lj.sample(stack, wi, jax.random.key(1), SINGLE)[0] for _ in range(2))
    other = lj.sample(stack, wi, jax.random.key(2), SINGLE)[0]
    assert (first == again).all()
    assert (first != other).any()
