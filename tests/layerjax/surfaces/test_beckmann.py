"""Facets with Gaussian slopes (Beckmann): normals by quadrature, energies by draws in numpy, samplers, transports.

Values beside Mitsuba's are in `tests/layerjax/transport/test_peers_transport.py`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

import layerjax as lj
from layerjax.directions import split
from layerjax.normals import facets
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from tests.helpers.derivatives import with_slopes
from tests.helpers.interfaces import pairs, sphere
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

KIND = "beckmann"
MIRROR = (0.01, 20.0)  # of index 1 reflects 0.9999 of the light


def masking(cosine, alpha):
    """Smith's G1 of Gaussian slopes (Walter et al. 2007, Sec. 5.3), in numpy."""
    a = cosine / (alpha * np.sqrt(np.maximum(1.0 - cosine**2, 1e-300)))
    return 2.0 / (1.0 + erf(a) + np.exp(-a * a) / (a * np.sqrt(np.pi)))


def fresnel(cosine, index):
    root = np.sqrt(index**2 - 1.0 + cosine**2 + 0j)
    s, p = (cosine - root) / (cosine + root), (index**2 * cosine - root) / (index**2 * cosine + root)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


def drawn_energies(theta, alpha, index, draws=400_000):
    """Energies that facets reflect and refract, and their errors: slopes are drawn, and weighed by what is seen."""
    p, q = np.random.default_rng(7).normal(0.0, alpha / np.sqrt(2.0), (2, draws))
    m = np.stack([-p, -q, np.ones(draws)], axis=-1) / np.sqrt(1.0 + p * p + q * q)[:, None]
    wi = np.array([np.sin(theta), 0.0, np.cos(theta)])
    c = m @ wi
    seen = np.maximum(c, 0.0) / m[:, 2] / wi[2] * masking(wi[2], alpha)  # its mean is 1
    level = fresnel(np.maximum(c, 1e-9), index)
    up = 2.0 * c * m[:, 2] - wi[2]
    eta = np.real(index)
    root = np.sqrt(np.maximum(1.0 - (1.0 - c * c) / eta**2, 0.0))
    down = -((c / eta - root) * m[:, 2] - wi[2] / eta)
    parts = [
        seen * level * np.where(up > 0, masking(np.maximum(up, 1e-9), alpha), 0.0),
        seen * (1.0 - level) * np.where(down > 0, masking(np.maximum(down, 1e-9), alpha), 0.0),
    ]
    return [(part.mean(), part.std() / np.sqrt(draws)) for part in parts]


@pytest.mark.parametrize("alpha", [1.0, 0.3, 0.03])
def test_it_is_normalised_and_masking_conserves_area(alpha):
    m, weight = sphere(600)
    density = np.where(m[..., 2] > 0, facets.density(split(jnp.asarray(m)), jnp.asarray(alpha), KIND), 0.0)
    np.testing.assert_allclose(np.sum(density * m[..., 2] * weight), 1.0, rtol=1e-12)
    for theta in (0.2, 0.9, 1.4, 1.55):
        w = np.asarray(lj.direction(theta, 0.3))
        visible = np.sum(np.maximum(m @ w, 0.0) * density * weight)
        found = facets.masking(split(jnp.asarray(w)), jnp.asarray(alpha), KIND)
        np.testing.assert_allclose(found * visible, w[2], rtol=1e-6)  # the kink at m.w = 0 limits the rule
        np.testing.assert_allclose(found, masking(w[2], alpha), rtol=1e-13)


@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_energies_are_those_of_draws(ior):
    """By the quadrature of facets, as the solver and `lj.albedo` take them."""
    for theta, alpha in ((0.0, 0.3), (0.6, 1.0), (1.2, 0.1), (1.2, 0.6), (1.5, 0.3)):
        stack = lj.Stack([lj.Interface(ior, alpha, KIND)])
        found = lj.albedo(stack, lj.direction(theta, 0.4), lj.AddingDoubling(nodes=8, modes=4))
        for share, (mean, error) in zip(found, drawn_energies(theta, alpha, ior), strict=True):
            assert abs(share[0] - mean) < 4.0 * error + 2e-4


def test_energies_of_a_conductor_are_those_of_draws():
    for theta, alpha in ((0.0, 0.3), (0.7, 1.0), (1.3, 0.05), (1.3, 0.6)):
        stack = lj.Stack([], lj.Conductor(*MIRROR, alpha, KIND))
        found, _ = lj.albedo(stack, lj.direction(theta, 0.3))
        (mean, error), _ = drawn_energies(theta, alpha, MIRROR[0] + 1j * MIRROR[1])
        assert abs(found[0] - mean) < 4.0 * error + 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "theta"), [(0.9, 0.7), (0.4, 1.5), (0.4, 0.0)])
def test_a_conductor_is_sampled_as_it_says(alpha, theta):
    stack, wi = lj.Stack([], lj.Conductor(*MIRROR, alpha, KIND)), lj.direction(theta, 0.4)
    wo, _, weight = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(11))
    above = wo[:, 2] > 0
    probability, total = chi_square(wo[above], lambda w: jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w), 0.0))
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, np.mean(above), atol=5e-3)
    energy, _ = lj.albedo(stack, wi)
    assert abs(np.mean(weight) - energy[0]) < 4.5 * np.std(weight) / np.sqrt(DRAWS) + 3e-4
    assert weight.max() < 1.0 + 1e-9  # normals are drawn as they are seen: what is left is masking, and Fresnel's share


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_draws_and_slopes_are_finite(dtype):
    random = np.random.default_rng(8)
    wi, wo, ior, alpha = pairs(random, 4000, [1e-4, 0.01, 0.3, 1.0], dtype)
    u = tuple(random.choice([0.0, 1.0 - 1e-7, *random.random(200)], (3, 4000)).astype(dtype))

    def everything(wi, wo, ior, alpha, u):
        below = (wo[0], wo[1], -wo[2])
        reflected = interface_reflection(wi, wo, ior, alpha, KIND)
        passed = interface_transmission(wi, below, ior, alpha, KIND)
        drawn, _ = interface_sample(wi, ior, alpha, *u, KIND)
        return jnp.stack([reflected, passed, interface_pdf(reflected, wi, wo, ior, alpha, KIND), *drawn])

    values, slopes = jax.jit(jax.vmap(with_slopes(everything, (0, 1, 2, 3), "forward")))(wi, wo, ior, alpha, u)
    for leaf in jax.tree.leaves((values, slopes)):
        assert np.isfinite(leaf).all()
    assert (values[:, :3] >= 0).all()
    wide = (alpha > 0.2) & (wi[2] > 0.05) & (wo[2] > 0.05)
    assert (values[wide, 0] > 0).mean() > 0.6  # 0 where the index is 1


def test_slopes_of_values_and_draws_are_differences():
    wi, wo = lj.direction(0.7, 0.2), lj.direction(0.5, 2.9)

    def values(alpha):
        f = lj.evaluate(lj.Stack([], lj.Conductor(0.2, 3.0, alpha, KIND)), wi, wo)[0]
        m = facets.sample(split(wi), alpha, jnp.asarray(0.3), jnp.asarray(0.8), KIND)
        return jnp.stack([f, *m])

    at = jnp.array([0.05, 0.2, 0.9])
    found = jax.jit(jax.vmap(jax.jacfwd(values)))(at)
    step = 1e-6 * at[:, None]
    expected = (jax.vmap(values)(at + step[:, 0]) - jax.vmap(values)(at - step[:, 0])) / (2.0 * step)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stack",
    [
        lj.Stack([lj.Interface(1.5, 0.3, KIND)], lj.Lambertian(0.6)),
        lj.Stack([lj.Interface(1.5, 0.2, KIND), lj.Medium(0.3, 0.8)], lj.Conductor(0.2, 3.9, 0.3, KIND)),
        lj.Stack([lj.Interface(1.5, 0.2, KIND), lj.Interface(1.0, 0.4)]),
    ],
    ids=["paint", "metal", "slab"],
)
def test_solver_and_walk_agree(stack):
    wi = lj.direction(0.6, 0.0)
    theta, phi = np.array([0.3, 0.6, 1.2]), np.array([2.5, 3.0, 0.5])
    wo = lj.direction(theta if stack.base is not None else np.pi - theta, phi)
    exact = lj.evaluate(stack, wi, wo, lj.AddingDoubling())
    mean, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=60_000), key=jax.random.key(0))
    assert np.all(np.abs(exact - mean) < 4.0 * error + 0.005 * exact)


def test_others_refuse_it_by_name():
    stack = lj.Stack([lj.Interface(1.5, 0.3, KIND)], lj.Lambertian(0.6))
    for transport in (lj.Statistical(), lj.WeidlichWilkie(), lj.AddingDoubling(facet_multiple_scattering=True)):
        with pytest.raises(ValueError, match=r'layers\[0\].distribution: .* carries no "beckmann" normals; Adding'):
            lj.prepare(stack, transport)
    with pytest.raises(ValueError, match=r"Interface\.alpha, beckmann: 2 is outside \[0\.0001, 1\]"):
        lj.Interface(1.5, 2.0, KIND)
