"""Directional statistics as a transport: lobes and energies of the papers, truth by walks, reciprocity, samplers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.lobes.microfacet import microfacet_lobes
from layerjax.transport.lobes.statistics import Options, lobe_roughness, statistics
from layerjax.transport.lobes.variance import phase_variance, roughness
from tests.helpers.compiled import compiled
from tests.helpers.sampling import chi_square

ANGLES = np.radians([0.0, 30.0, 60.0, 75.0])
LIGHT = np.asarray(lj.direction(ANGLES, np.zeros(4)))
FORWARD, SYMMETRIC = lj.Statistical(symmetric=False), lj.Statistical()
PAPER = Options(True, "orders", angles=False, own_side=False)

COAT = lj.Stack([lj.Interface(1.4, 0.1)], lj.Conductor(1.0, 1.0, 0.1))
DIFFUSE = lj.Stack([lj.Interface(1.5, 0.1)], lj.Lambertian(0.9))
HAZE = lj.Medium(0.3, [0.6, 0.9], lj.HenyeyGreenstein(0.8))
SLAB = lj.Stack([lj.Interface(1.5, 0.2), HAZE, lj.Interface(1.2, 0.3)])


def lobes(stack, angles, options=PAPER):
    """Lobes of light along these angles, in degrees; the stack's numbers are known, as where users prepare it."""
    return compiled(lambda cosine: statistics(stack, cosine, options).reflected)(np.cos(np.radians(angles)))


def test_lobes_of_a_smooth_furnace():
    """Belcour 2018, Fig. 12, lobe by lobe; closed forms of smooth interfaces. The mirror here absorbs 1e-4."""
    faces = [lj.Interface(n, 1e-4) for n in (1.3, 1.0, 1.3, 1.0, 1.3)]
    found = lobes(lj.Stack(faces, lj.Conductor(0.01, 20.0, 1e-4)), [0.0, 60.0, 75.0])
    energies = np.array([entry.lobe.energy[0][0] for entry in found]).T
    expected = [
        [0.0170132, 0.0164440, 0.0159029, 0.0153880, 0.0148978, 0.9203540],
        [0.0533995, 0.0479854, 0.0433553, 0.0393642, 0.0359002, 0.7799954],
        [0.2013362, 0.1338512, 0.0954256, 0.0714700, 0.0555288, 0.4423882],
    ]
    np.testing.assert_allclose(energies[:, :5], np.array(expected)[:, :5], atol=5e-5)
    np.testing.assert_allclose(energies[:, 5], np.array(expected)[:, 5], atol=5e-4)


def test_energies_of_a_smooth_coat_on_metal():
    """Index 2 over a relative index 0.5 + 0.5i: Fresnel and the geometric series."""
    found = lobes(lj.Stack([lj.Interface(2.0, 1e-4)], lj.Conductor(1.0, 1.0, 1e-4)), [0.0, 60.0])
    np.testing.assert_allclose(found[0].lobe.energy[0][0], [0.1111111, 0.1613766], atol=5e-5)
    np.testing.assert_allclose(found[1].lobe.energy[0][0], [0.1616162, 0.1594298], atol=5e-5)


def test_widths_of_three_layers():
    """1.5/.2 over 2/0 over a relative .2 + 3i of .1: within 0.001 of the model's own values."""
    stack = lj.Stack([lj.Interface(1.5, 0.2), lj.Interface(2.0, 1e-4)], lj.Conductor(0.4, 6.0, 0.1))
    found = lobes(stack, [0.0], PAPER._replace(multiple=False))
    roughness = compiled(lobe_roughness)
    widths = [float(roughness(entry.lobe.variance[0])[0]) for entry in found]
    np.testing.assert_allclose(widths, [0.2, 0.0891, 0.25729], atol=1.5e-3)


# albedo of walks with multiple scattering on facets, and the error (%) that the model has been found to have there
ALBEDOS = {
    "frosted metal": (1.49, 0.1, 1.0, 1.0, 1e-3, [0.19671, 0.21759], [0.8, 17.0]),
    "coat .1 on .1": (1.4, 0.1, 1.0, 1.0, 0.1, [0.18001, 0.19104], [2.4, 11.0]),
    "coat .1 on .3": (1.4, 0.1, 1.0, 1.0, 0.3, [0.13982, 0.16554], [7.0, 7.0]),
    "index 2, .1": (2.0, 0.1, 0.01, 1.0, 0.1, [0.97138, 0.95680], [1.1, 2.0]),
    "index 2, .5": (2.0, 0.5, 0.01, 1.0, 0.5, [0.94810, 0.95002], [0.2, 0.2]),
}


@pytest.mark.parametrize("name", ALBEDOS)
def test_albedo_is_as_near_to_the_walk_as_the_model_can_be(name):
    ior, alpha, n, k, below, truth, errors = ALBEDOS[name]
    stack = lj.Stack([lj.Interface(ior, alpha)], lj.Conductor(n, k, below))
    reflected, _ = lj.albedo(stack, LIGHT[[0, 2]], FORWARD)
    found = 100 * (np.asarray(reflected)[:, 0] / truth - 1)
    assert np.all(np.abs(found) <= np.array(errors) + 0.5)  # 0.5 %: energies of rough faces, and rounding of the table


@pytest.mark.slow
def test_haze_behind_an_index_spreads_transmitted_light_alike_from_either_side():
    """A collision adds the variance of its phase function in the medium where it happens."""
    stack, cosine = lj.Stack([lj.Interface(1.5, 1e-4), lj.Medium(0.5, 1.0, lj.HenyeyGreenstein(0.9))]), jnp.ones(())
    options = Options(True, "orders", angles=False, own_side=False)
    for upward in (False, True):
        once = microfacet_lobes(stack, options, cosine, upward).transmitted[1].alpha[0]
        np.testing.assert_allclose(once, roughness(phase_variance(jnp.asarray(0.9))), rtol=1e-3)


@pytest.mark.slow
def test_albedo_of_a_coated_diffuse_base():
    """Walks over 1.5/.1 on .9; errors of the energies (2e-3) and of the walk (1e-4)."""
    reflected, _ = lj.albedo(DIFFUSE, LIGHT[[0, 2]], FORWARD)
    np.testing.assert_allclose(reflected[:, 0], [0.79484, 0.80497], atol=1e-3)


@pytest.mark.parametrize(
    "stack", [COAT, pytest.param(SLAB, marks=pytest.mark.slow), DIFFUSE], ids=["coat", "slab", "diffuse"]
)
def test_symmetric_model_is_reciprocal(stack):
    rng = np.random.default_rng(1)
    w = rng.normal(size=(2, 200, 3))
    w /= np.linalg.norm(w, axis=-1, keepdims=True)
    below = 1.2 if stack is SLAB else 1.0
    there, back = (lj.evaluate(stack, a, b, SYMMETRIC) for a, b in (w, w[::-1]))
    index = np.where(w[:, :, 2:] < 0, below, 1.0) ** 2
    np.testing.assert_allclose(there / index[1], back / index[0], rtol=1e-9, atol=1e-13)
    assert np.any(there > 0)


@pytest.mark.slow
@pytest.mark.parametrize("theta", [0.0, 1.1, 2.3])
def test_forward_model_conserves_energy_in_a_furnace(theta):
    """A lossless slab: the energies of its lobes, and, within 4 standard errors, what its samples carry."""
    slab = lj.prepare(lj.Stack([lj.Interface(1.5, 0.2), lj.Interface(1.0, 0.3)]), FORWARD)
    wi = lj.direction(theta, 0.3)
    np.testing.assert_allclose(sum(lj.albedo(slab, wi)), 1.0, atol=1e-3)
    _, _, weight = lj.sample(slab, jnp.broadcast_to(wi, (200_000, 3)), jax.random.key(4))
    assert abs(float(jnp.mean(weight)) - 1.0) < 4 * float(jnp.std(weight)) / 200_000**0.5 + 1e-3


def test_what_nothing_meets_is_not_in_the_albedo():
    """Forward haze alone: its scattered light is what is not absorbed less what passes straight, exp(-tau / cos)."""
    stack = lj.Stack([lj.Medium(0.5, 0.8, lj.HenyeyGreenstein(0.9))])
    _, transmitted = lj.albedo(stack, LIGHT, FORWARD)
    depth = 0.5 / LIGHT[:, 2]
    np.testing.assert_allclose(transmitted[:, 0], np.exp(-0.2 * depth) - np.exp(-depth), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "transport", "theta"),
    [
        (COAT, FORWARD, 0.5),
        (DIFFUSE, FORWARD, 1.2),
        (SLAB, FORWARD, 0.5),
        (SLAB, FORWARD, 2.4),
        (SLAB, SYMMETRIC, 2.4),
    ],
)
def test_samples_follow_their_density_and_have_the_albedo_as_mean_weight(stack, transport, theta):
    wi, draws = lj.direction(theta, 0.7), 200_000
    prepared = lj.prepare(stack, transport)
    # the first channel's weights, and its albedo
    wo, _, weight = lj.sample(prepared, jnp.broadcast_to(wi, (draws, 3)), jax.random.key(3))
    kept = wo[:, 2] != 0
    assert jnp.all(jnp.isfinite(weight))
    probability, _ = chi_square(wo[kept], lambda w: lj.pdf(prepared, wi, w))
    assert probability > 1e-4
    expected = sum(side[0] for side in lj.albedo(prepared, wi))
    noise = float(jnp.std(weight[:, 0])) / draws**0.5
    # 4 standard errors, and 1e-3 for the quadratures of energies
    assert abs(float(jnp.mean(weight[:, 0]) - expected)) < 4 * noise + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ior", "absorbing"),
    [(1.5, 0.4), (1.33, 0.0), (1.33, 0.4), (1.5, 0.0), (1 / 1.5, 0.0), (1 / 1.5, 0.4)],
)
def test_closed_form_of_a_coated_diffuse_base(ior, absorbing):
    """Against the walk, away from the mirror lobe: 4 standard errors and 0.3 %."""
    layers = [lj.Interface(ior, 0.3), lj.Medium(absorbing, 0.0)] if absorbing else [lj.Interface(ior, 0.3)]
    stack = lj.Stack(layers, lj.Lambertian(0.8))
    transport = lj.Statistical(facet_multiple_scattering=False)
    wi = lj.direction(jnp.array([0.2, 0.6, 1.1]), 0.0)
    wo = lj.direction(jnp.array([0.5, 0.9, 0.4]), 1.4)
    values = lj.evaluate(stack, wi, wo, transport)
    estimates, errors = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=1 << 14), key=jax.random.key(5))
    np.testing.assert_array_less(np.abs(values - estimates), 4 * errors + 3e-3 * np.abs(estimates))


@pytest.mark.slow
def test_closed_form_under_two_interfaces_and_haze():
    """Energies by the solver's other modes and resolution are the truth here: all orders, the same base."""
    stack = lj.Stack(
        [lj.Interface(1.3, 0.2), lj.Medium([0.0, 0.5], 0.0), lj.Interface(1.6, 0.3), lj.Medium(0.5, 0.9)],
        lj.Lambertian([0.5, 0.9]),
    )
    bare = lj.Stack(stack.layers, lj.Lambertian(0.0))
    wi, wo = lj.direction(jnp.array([0.2, 0.9]), 0.0), lj.direction(jnp.array([0.7, 0.3]), 2.0)
    solver = lj.AddingDoubling(nodes=40, modes=32)
    truth = lj.evaluate(stack, wi, wo, solver) - lj.evaluate(bare, wi, wo, solver)
    transport = lj.Statistical(facet_multiple_scattering=False)
    found = lj.evaluate(stack, wi, wo, transport) - lj.evaluate(bare, wi, wo, transport)
    np.testing.assert_allclose(found, truth, rtol=3e-3)


@pytest.mark.slow
def test_lobe_of_a_diffuse_base_has_the_energy_of_the_closed_form():
    wi = LIGHT[:3]
    exact, _ = lj.albedo(DIFFUSE, wi, FORWARD)
    lobe, _ = lj.albedo(DIFFUSE, wi, lj.Statistical(symmetric=False, diffuse="lobe"))
    np.testing.assert_allclose(lobe, exact, rtol=5e-3)


def test_what_it_does_not_carry_is_named():
    flakes = lj.Stack([lj.Interface(1.5, 0.1), lj.Medium(1.0, phase=lj.SGGX("surface", 0.3))], lj.Lambertian(0.5))
    with pytest.raises(ValueError, match=r"layers\[1\]: Statistical carries no SGGX medium .* AddingDoubling"):
        lj.prepare(flakes, SYMMETRIC)
    low, high = lj.Interface(0.4, 0.1), lj.Interface(np.float32([1.6, 1.7]), 0.1)
    with pytest.raises(ValueError, match=r"layers\[1\]\.ior: 4\.25 times the index above it; .* 0\.25 to 4 times"):
        SYMMETRIC.check(lj.Stack([low, high]), ["layers[0]", "layers[1]"])
    SYMMETRIC.check(lj.Stack([low, lj.Interface(np.float32(1.6), 0.1)]), ["layers[0]", "layers[1]"])
    with pytest.raises(ValueError, match=r"layers\[0\].f0: Statistical"):
        lj.prepare(lj.Stack([lj.Medium(1.0, f0=0.04)], lj.Lambertian(0.5)), SYMMETRIC)
    with pytest.raises(ValueError, match=r"Statistical\.scattering: 'all' is not one of 'orders', 'single'"):
        lj.Statistical(scattering="all")
    with pytest.raises(ValueError, match=r"layers\[1\]: the lobe of a diffuse base needs media that only absorb"):
        lj.prepare(lj.Stack(SLAB.layers[:2], lj.Lambertian(0.5)), lj.Statistical(diffuse="lobe"))


def box_stack(p):
    face = lj.Interface(p["ior"], p["alpha"])
    haze = lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))
    return [face, haze, lj.Interface(p["other"], p["beta"])]


BOX = {
    "coated metal": lambda p: lj.Stack(box_stack(p)[:1], lj.Conductor(p["n"], p["k"], p["beta"])),
    "over metal": lambda p: lj.Stack(box_stack(p)[:2], lj.Conductor(p["n"], p["k"], p["beta"])),
    "through": lambda p: lj.Stack(box_stack(p)),
    "over diffuse": lambda p: lj.Stack(box_stack(p), lj.Lambertian(p["albedo"])),
}


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param("coated metal", jnp.float32, marks=pytest.mark.slow),
        pytest.param("over metal", jnp.float32, marks=pytest.mark.slow),
        pytest.param("over metal", jnp.float64, marks=pytest.mark.slow),
        pytest.param("through", jnp.float32, marks=pytest.mark.slow),
        pytest.param("over diffuse", jnp.float32, marks=pytest.mark.slow),
    ],
)
def test_values_and_gradients_are_finite_over_the_box(name, dtype):
    rng = np.random.default_rng(11)
    count = 40

    def mixed(low, high, *others):
        values = rng.uniform(low, high, count)
        return np.where(rng.random(count) < 0.5, rng.choice([low, high, *others], count), values)

    p = {
        "ior": mixed(0.25, 4.0, 1.0),
        "other": mixed(0.25, 4.0, 1.0),
        "alpha": mixed(1e-4, 1.0),
        "beta": mixed(1e-4, 1.0),
        "thickness": mixed(0.0, 1e4, 1.0),
        "albedo": mixed(0.0, 1.0),
        "g": mixed(-0.999, 0.999, 0.0),
        "n": mixed(0.01, 10.0),
        "k": mixed(0.0, 20.0),
    }
    p = {key: jnp.asarray(value, dtype) for key, value in p.items()}
    cosine = np.array([1.0, 0.6, 1e-3, 1e-6])
    wi = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1)
    wo = np.concatenate([wi * [-1, 1, 1], wi[::-1], wi * [-1, 1, -1]])
    wi, wo = jnp.asarray(np.concatenate([wi, wi, wi]), dtype), jnp.asarray(wo, dtype)

    @jax.jit
    def run(p):
        def one(q):
            def total(q, wi, wo):
                f = lj.evaluate(BOX[name](q), wi, wo, SYMMETRIC)
                return jnp.sum(f), f

            gradients, f = jax.grad(total, argnums=(0, 1, 2), has_aux=True)(q, wi, wo)
            return gradients, f

        return jax.lax.map(one, p)

    (by_parameter, by_wi, by_wo), values = run(p)
    assert values.dtype == dtype
    for found in (values, by_wi, by_wo, *by_parameter.values()):
        assert jnp.all(jnp.isfinite(found))
    assert jnp.all(values >= 0)


def test_a_bare_diffuse_base_is_itself():
    rough, wi, wo = lj.Stack([], lj.OrenNayar([0.8, 0.3], 0.7)), LIGHT[1:], LIGHT[:3] * [-1, 1, 1]
    single = lj.SingleScattering()
    np.testing.assert_array_equal(lj.evaluate(rough, wi, wo, SYMMETRIC), lj.evaluate(rough, wi, wo, single))
    np.testing.assert_array_equal(lj.albedo(rough, wi, SYMMETRIC), lj.albedo(rough, wi, single))
    _, density, weight = lj.sample(rough, jnp.asarray(wi), jax.random.key(0), SYMMETRIC)
    assert jnp.all(jnp.isfinite(weight) & (weight > 0) & (density[:, None] > 0))
