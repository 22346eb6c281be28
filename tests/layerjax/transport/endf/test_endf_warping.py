"""Spherical warping: Jacobians against derivatives of the maps, and the paper's examples in numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.peers import endf_walk as endf_truth
from layerjax import fresnel
from layerjax.directions import direction, frame, join, normalize, reflect, refract, split
from layerjax.normals import vmf
from layerjax.transport.endf import warping
from layerjax.transport.endf.chains import LowerSide, UpperSide, chain_concentration, inner_concentration
from layerjax.transport.endf.slab import inner_slab_concentration, slab_concentration

IOR = 1.5
THETAS = (0.0, 0.5, 1.0, 1.3)


def solid_angle(to, at):
    """Factor by which the map of directions widens a small solid angle about `at`."""
    tangents = jnp.stack([join(t) for t in frame(split(at))])

    def moved(shift):
        return join(to(normalize(split(at + shift @ tangents))))

    derivative = jax.jacfwd(moved)(jnp.zeros(2))
    return jnp.linalg.norm(jnp.cross(derivative[:, 0], derivative[:, 1]))


def test_jacobians_are_the_derivatives_of_the_maps():
    m = jnp.array([0.1, 0.2, 1.0]) / jnp.sqrt(1.05)
    o = direction(0.5, 0.0)
    cosine = o @ m

    @jax.jit
    def all_of_them(ior):
        gains = warping.reflection_gains(cosine), warping.refraction_gains(cosine, ior)
        found = (
            (solid_angle(lambda n: reflect(split(o), n), m), solid_angle(lambda w: reflect(w, split(m)), o)),
            (
                solid_angle(lambda n: refract(split(o), n, ior)[0], m),
                solid_angle(lambda w: refract(w, split(m), ior)[0], o),
            ),
        )
        return gains, found

    for ior, by_facets, by_beam in ((IOR, 7.558534, 2.386946), (1 / IOR, 2.201204, 0.376540)):
        gains, found = all_of_them(ior)
        np.testing.assert_allclose(np.array(gains), np.array(found), rtol=1e-9)
        np.testing.assert_allclose(1 / gains[1].facets, by_facets, atol=6e-7)
        np.testing.assert_allclose(1 / gains[1].beam, by_beam, atol=6e-7)


# solid angle of normals over that of what leaves: exit and entry facets, and the base (eta = 1.5)
CHAIN = {0.0: (4.0, 1 / 9), 0.5: (2.968309, 0.108604), 1.0: (1.098132, 0.087602), 1.3: (0.343792, 0.050603)}


@jax.jit
def chain_jacobians(theta):
    o = split(direction(theta, 0.0))
    up = jnp.array([0.0, 0.0, 1.0])

    def leave(entry, base, exit):
        t1, _ = refract(o, entry, IOR)
        t2 = reflect((-t1[0], -t1[1], -t1[2]), base)
        return refract((-t2[0], -t2[1], -t2[2]), exit, 1 / IOR)[0]

    n = split(up)
    through = lambda m: refract(  # noqa: E731
        tuple(-c for c in refract(o, m, IOR)[0]), n, 1 / IOR
    )[0]
    maps = (lambda m: leave(m, n, n), lambda m: leave(n, m, n), lambda m: leave(n, n, m), through)
    return [1 / solid_angle(to, up) for to in maps]


@pytest.mark.parametrize("theta", THETAS)
def test_chain_rule_through_coat_and_slab(theta):
    entry, base, exit, slab = chain_jacobians(theta)
    cosine = jnp.cos(theta)
    inside, _ = warping.refracted_cosine(cosine, IOR)
    into, out = warping.refraction_gains(cosine, IOR), warping.refraction_gains(inside, 1 / IOR)
    turn = warping.reflection_gains(inside)
    np.testing.assert_allclose(1 / (into.facets * turn.beam * out.beam), entry, rtol=1e-9)
    np.testing.assert_allclose(1 / (into.facets * out.beam), slab, rtol=1e-9)
    np.testing.assert_allclose(1 / out.facets, exit, rtol=1e-9)
    np.testing.assert_allclose(1 / (turn.facets * out.beam), base, rtol=1e-9)
    np.testing.assert_allclose((entry, exit, base), np.take(CHAIN[theta], [0, 0, 1]), atol=6e-7)


def test_fresnel_values():
    cosine, ior = jnp.array([0.5, 1.0, 1.0, 0.5]), jnp.array([1.5, 1.5, 2.0, 1 / 1.5])
    expected = [0.08918671280, 0.04, 1 / 9, 1.0]
    np.testing.assert_allclose(fresnel.dielectric(cosine, ior), expected, atol=6e-12)
    np.testing.assert_allclose(endf_truth.dielectric(np.asarray(cosine), np.asarray(ior)), expected, atol=6e-12)


# Guo 2015, Figs. 6 and 7: cosine, kappa of the beam, kappa of the facets
COSINES = np.array([1.0, np.sqrt(0.5), 0.5])
BEAMS, FACETS = np.array([50.0, 100.0, 200.0]), np.array([200.0, 100.0, 50.0])


@jax.jit
def examples(beam, facets, cosine, ior):
    reflected, refracted = warping.reflect_beam(beam, facets, cosine), warping.refract_beam(beam, facets, cosine, ior)
    extended = (
        warping.extended_concentration(reflected, warping.reflection_gains(cosine)),
        warping.extended_concentration(refracted, warping.refraction_gains(cosine, ior)),
    )
    exact = warping.reflected_moment(beam, facets, cosine), warping.refraction_trace(beam, facets, cosine, ior)
    return (reflected, refracted), extended, exact


@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.slow)])
def test_the_examples_of_the_paper(dtype):
    given = (jnp.asarray(value, dtype) for value in (BEAMS, FACETS, COSINES, IOR))
    (reflected, refracted), (as_facets, as_refracting), (moment, trace) = examples(*given)
    single = dtype == np.float32
    tolerance = {"rtol": 1e-5 if single else 5e-8}  # the digits known of the values below
    np.testing.assert_allclose(reflected, [25.252525, 26.314800, 22.321429], **tolerance)
    np.testing.assert_allclose(as_facets, [101.010101, 74.429495, 44.642857], **tolerance)
    np.testing.assert_allclose(refracted, [105.937745, 182.898355, 141.416720], **tolerance)
    np.testing.assert_allclose(as_refracting, [11.770861, 34.949018, 40.432833], **tolerance)
    np.testing.assert_allclose(moment, [25.315174, 25.411022, 18.655224], **tolerance)
    np.testing.assert_allclose(vmf.sphere_density(0.0, reflected), [4.019064, 4.188131, 3.552566], rtol=1e-5)
    # exact mean resultants of the refracted beams, by quadrature; first order is what is left at kappa = 50 to 200
    np.testing.assert_allclose(trace, [107.029376, 178.31378, 131.2891], rtol=0.04)
    np.testing.assert_allclose(refracted, [107.029376, 178.31378, 131.2891], rtol=0.08)


def test_exact_moments_and_densities_by_another_way():
    """Closed form against a Monte Carlo of 2e5 paths; densities where the paper plots them against its single lobe."""
    lengths = [
        endf_truth.warped("reflection", *case, IOR, 200_000) for case in zip(COSINES, BEAMS, FACETS, strict=True)
    ]
    np.testing.assert_allclose(lengths, [0.960498000, 0.960646999, 0.946395713], atol=4e-4)
    peaks = {
        "reflection": [3.98386594, 4.11735488, 3.46021976],
        "refraction": [16.9283074, 28.4625736, 21.5896059],
    }
    for kind, expected in peaks.items():
        found = [endf_truth.peak(kind, *case, IOR) for case in zip(COSINES, BEAMS, FACETS, strict=True)]
        np.testing.assert_allclose(found, expected, rtol=1e-3 if kind == "refraction" else 1e-7)


# degrees, kappa above, kappa below: concentration of what leaves and of the extended normals
CHAINS = {
    (0, 1e4, 1e3): (110.50274, 442.01096),
    (45, 1e4, 1e3): (99.94327, 282.68225),
    (60, 1e4, 1e3): (81.916385, 163.83277),
    (45, 1e2, 1e2): (9.2053938, 26.036786),
    (0, 1e8, 1e3): (111.11105, 444.4442),
}


@jax.jit
def concentrations(ior, theta, above, below):
    top, base = UpperSide(ior, above), LowerSide(below, (), None)
    cosine = jnp.cos(theta)
    inside, _ = warping.refracted_cosine(cosine, top.ior)
    coats = [(chain_concentration(k, cosine, top, base), inner_concentration(k, inside, top, base)) for k in (1, 3)]
    slabs = [(slab_concentration(j, cosine, top, base), inner_slab_concentration(j, inside, top, base)) for j in (0, 1)]
    return cosine, inside, coats, slabs


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_concentrations_of_chains(dtype):
    theta, above, below = (np.array(values, dtype) for values in zip(*CHAINS, strict=True))
    cosine, _, coats, _ = concentrations(dtype(IOR), np.radians(theta), above, below)
    outgoing, normals = np.array(list(CHAINS.values())).T
    tolerance = 1e-5 if dtype == np.float32 else 6e-8  # the digits known of the values
    np.testing.assert_allclose(coats[0][0], normals, rtol=tolerance)
    np.testing.assert_allclose(coats[0][0] / (4 * cosine), outgoing, rtol=tolerance)


def test_narrow_lobes_add_their_variances():
    """Both forms for large kappa, where the paper's product is a sum."""
    theta, above, below = np.radians([0.0, 20.0, 30.0, 50.0, 60.0]), np.full(5, 4e7), np.full(5, 1e7)
    c, inside, coats, slabs = concentrations(np.float64(IOR), theta, above, below)
    ratio = IOR * inside / c
    for k, (outer, inner) in zip((1, 3), coats, strict=True):
        variance = (ratio - 1) ** 2 / (2 * above) + ratio**2 * (k / below + (k - 1) / above)
        np.testing.assert_allclose(outer, 1 / variance, rtol=2e-6)
        np.testing.assert_allclose(inner, ratio**2 / variance, rtol=2e-6)
    for j, (outer, inner) in enumerate(slabs):
        variance = (0.25 * (ratio - 1) ** 2 + j * ratio**2) * (1 / above + 1 / below)
        np.testing.assert_allclose(outer, 1 / variance, rtol=2e-6)
        np.testing.assert_allclose(inner, ratio**2 / variance, rtol=2e-6)


def test_a_matched_index_turns_nothing():
    _, _, coats, _ = concentrations(
        np.float64(1.0), np.radians([0.0, 20.0, 45.0, 60.0, 85.0]), np.full(5, 100.0), np.full(5, 1e3)
    )
    for normals in coats[0]:
        np.testing.assert_allclose(normals, 1e3, rtol=1e-8)
