"""Which transport a stack gets, and that it is near the exact answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.stack import simplify
from layerjax.transport.automatic import automatic

ABSORBS, SCATTERS = lj.Medium(0.4, 0.0), lj.Medium(0.4, 0.5)
FACE, BASE = lj.Interface(1.5, 0.3), lj.Lambertian(0.8)


def choose(stack):
    return automatic(stack, simplify(stack))


@pytest.mark.parametrize(
    ("stack", "expected"),
    [
        (lj.Stack([SCATTERS], BASE), lj.AddingDoubling),
        (lj.Stack([lj.Medium(1e-6, 0.5)], BASE), lj.AddingDoubling),
        (lj.Stack([ABSORBS], BASE), lj.SingleScattering),
        (lj.Stack([], BASE), lj.SingleScattering),
        (lj.Stack([FACE], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, ABSORBS], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, SCATTERS], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, lj.Medium(0.4, 0.0, lj.SGGX("surface", 0.3))], BASE), lj.AddingDoubling),
        (lj.Stack([FACE, lj.Interface(1.3, 0.1)], BASE), lj.AddingDoubling),
        (lj.Stack([FACE], lj.OrenNayar(0.8, 0.3)), lj.AddingDoubling),
        (lj.Stack([FACE]), lj.AddingDoubling),
    ],
)
def test_rule(stack, expected):
    assert type(choose(stack)) is expected


def test_an_albedo_that_is_not_known_may_scatter():
    def chosen(albedo):
        assert isinstance(choose(lj.Stack([FACE, lj.Medium(0.4, albedo)], BASE)), lj.AddingDoubling)

    jax.eval_shape(chosen, 0.0)


NEAR = {
    "haze": lj.Stack([lj.Medium(1.0, 0.95, lj.HenyeyGreenstein(0.8))], BASE),
    "flakes": lj.Stack([lj.Medium(0.7, 0.9, lj.SGGX("surface", 0.2), 0.1)], BASE),
    "dyed varnish": lj.Stack([FACE, ABSORBS], BASE),
    "coated metal": lj.Stack([FACE, SCATTERS], lj.Conductor(0.4, 3.0, 0.15)),
    "slab": lj.Stack([lj.Medium(2.0, 0.99, lj.HenyeyGreenstein(0.5))]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NEAR)
def test_it_is_within_a_hundredth_of_all_orders(name):
    stack = NEAR[name]
    theta, phi = np.radians([5.0, 30.0, 55.0, 75.0]), np.radians([0.0, 60.0, 150.0])
    wi = lj.direction(theta[:, None, None], 0.0)
    wo = lj.direction(theta[:, None] if stack.base is not None else np.pi - theta[:, None], phi)
    solved = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=48, modes=64))
    np.testing.assert_allclose(lj.evaluate(stack, wi, wo), solved, rtol=1e-2)
    many = np.broadcast_arrays(*(np.asarray(w) for w in (wi, wo)))
    traced = jax.jit(lambda wi, wo: lj.evaluate(stack, wi, wo))(*many)  # directions that nothing is known of
    np.testing.assert_allclose(traced, solved, rtol=1e-2)


STATED = 5e-3
"""Five times the error that resolutions are chosen for: these are ends of the box."""


@pytest.mark.slow
@pytest.mark.parametrize(("ior", "alpha"), [(3.027, 0.00137), (2.0, 0.002), (1.5, 0.00137)])
def test_a_smooth_varnish_over_white_reflects_all(ior, alpha):
    np.testing.assert_allclose(reflected_by_varnish(ior, alpha, "auto"), 1.0, atol=STATED)


@pytest.mark.slow
def test_what_a_hazy_varnish_over_white_loses_is_what_single_facets_lose():
    solver = lj.AddingDoubling(facet_multiple_scattering=False)
    expected = reflected_by_varnish(1.5, 0.02, solver)
    np.testing.assert_allclose(reflected_by_varnish(1.5, 0.02, "auto"), expected, rtol=STATED)


def reflected_by_varnish(ior, alpha, transport):
    angles = jnp.radians(jnp.array([0.0, 20.0, 40.0, 60.0, 70.0]))
    return lj.albedo(lj.Stack([lj.Interface(ior, alpha)], lj.Lambertian(1.0)), lj.direction(angles, 0.0), transport)[0]


@pytest.mark.slow
def test_values_under_a_smooth_varnish_are_those_of_a_mirror_of_it():
    """In closed form, by Snell's and Fresnel's laws alone: f = T(i) T(o) rho / (pi n^2 (1 - rho R))."""
    ior, albedo = 2.0, 0.7
    x, w = np.polynomial.legendre.leggauss(200)
    critical = np.sqrt(1.0 - 1.0 / ior**2)
    cosine, weight = critical + 0.5 * (1.0 - critical) * (x + 1.0), 0.5 * (1.0 - critical) * w
    sent_back = critical**2 + np.sum(2.0 * weight * cosine * (1.0 - passed(cosine, 1.0 / ior)))
    theta_i, theta_o = np.radians([5.0, 25.0, 45.0, 65.0, 75.0]), np.radians([20.0, 40.0, 60.0, 80.0])
    wi, wo = lj.direction(theta_i[:, None], 0.0), lj.direction(theta_o, 2.0)
    exact = passed(np.cos(theta_i), ior)[:, None] * passed(np.cos(theta_o), ior)
    exact *= albedo / (np.pi * ior**2 * (1.0 - albedo * sent_back))
    values = lj.evaluate(lj.Stack([lj.Interface(ior, 0.0005)], lj.Lambertian(albedo)), wi, wo)
    np.testing.assert_allclose(values[..., 0], exact, rtol=STATED)


def passed(cosine, ior):
    """Fresnel's transmittance where nothing is totally reflected."""
    inner = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    s, p = (cosine - ior * inner) / (cosine + ior * inner), (inner - ior * cosine) / (inner + ior * cosine)
    return 1.0 - 0.5 * (s**2 + p**2)


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["auto", lj.Statistical()], ids=["auto", "Statistical"])
def test_no_value_is_negative(transport):
    """Also where the index steps down, and little passes beyond the critical angle."""
    generator = np.random.default_rng(5)
    cosine, azimuth = generator.uniform(0.0, 1.0, (2, 2000)), generator.uniform(0.0, 2.0 * np.pi, (2, 2000))
    wi, wo = (lj.direction(np.arccos(c), phi) for c, phi in zip(cosine, azimuth, strict=True))

    @jax.jit
    def least(ior, alpha):
        return jnp.min(lj.evaluate(lj.Stack([lj.Interface(ior, alpha)], lj.Lambertian(1.0)), wi, wo, transport))

    for ior in (0.25, 0.71189, 0.95, 1.00001, 1.5, 4.0):
        for alpha in (1e-4, 0.0025888, 0.03, 0.3, 1.0):
            assert least(ior, alpha) >= 0.0, (ior, alpha)
