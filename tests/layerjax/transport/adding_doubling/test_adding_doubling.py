"""Adding-doubling against published values, energy, reciprocity, the walk, and its own derivatives by differences."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax import HenyeyGreenstein, Interface, Lambertian, Medium, Stack
from layerjax.evaluate import evaluate_known
from layerjax.transport.adding_doubling.resolution import Resolution
from layerjax.transport.known_directions import known_directions
from tests.helpers.places import STORED

PUBLISHED = STORED / "published_slab_values.csv"
FIBERS = lj.SGGX("fiber", 0.4, axis=(1.0, 0.0, 0.0))
FLAKES = lj.SGGX("surface", 0.5, axis=(0.3, 0.2, 0.9))
ENERGY = lj.AddingDoubling(nodes=32, modes=1)
"""An albedo needs the mean over azimuth alone."""


def directions(count, both=True, seed=0):
    generator = np.random.default_rng(seed)
    cosine, azimuth = generator.uniform(0.1, 1.0, count), generator.uniform(0.0, 2 * np.pi, count)
    side = generator.choice([-1.0, 1.0], count) if both else np.ones(count)
    sine = np.sqrt(1 - cosine**2)
    return jnp.asarray(np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), side * cosine], axis=-1))


@pytest.mark.parametrize("row", list(csv.DictReader(PUBLISHED.read_text().splitlines())), ids=lambda row: row["id"])
def test_published_slab_values(row):
    medium = Medium(float(row["optical_thickness_b"]), float(row["albedo_a"]), HenyeyGreenstein(float(row["g"])))
    stack = Stack([medium])
    wi = lj.direction(np.arccos(float(row["mu0"])), 0.0)
    reflected, transmitted = lj.albedo(stack, wi, ENERGY)
    found = {
        "R_total": reflected,
        "R_diffuse": reflected,
        "T_total": transmitted + lj.unscattered(stack, wi),
    }[row["quantity"]]
    np.testing.assert_allclose(found[0], float(row["value"]), atol=1e-5)


@pytest.mark.parametrize(
    ("thickness", "cosine", "reflected", "transmitted"),
    [(1.0, 1.0, 0.3413288, 0.2907918), (1.0, 0.5, 0.4983755, 0.3662892), (5.0, 1.0, 0.7387212, 0.2545409)],
)
def test_isotropic_slab_against_milne(thickness, cosine, reflected, transmitted):
    # from a discretised Milne equation
    found = lj.albedo(Stack([Medium(thickness)]), lj.direction(np.arccos(cosine), 0.0), ENERGY)
    np.testing.assert_allclose(np.ravel(found), [reflected, transmitted], atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layers", "reflected", "transmitted"),
    [
        ([Medium(0.5, phase=lj.SGGX("surface", 0.5)), Medium(2.0, phase=lj.SGGX("surface", 0.9))], 0.3449, 0.2654),
        ([Medium(5.0, phase=lj.SGGX("surface", 0.5))], 0.4648, 0.1860),
        ([Medium(1.0, phase=lj.SGGX("fiber", 0.5, axis=(1.0, 0.0, 0.0)))], 0.1886, 0.1710),
    ],
    ids=["two flakes", "thick flakes", "fibers"],
)
def test_flakes_against_published_walks(layers, reflected, transmitted):
    # two and more collisions, standard error 5e-4
    transport = lj.AddingDoubling(nodes=24, modes=2, orders="multiple")
    found = lj.albedo(Stack(layers), lj.direction(0.5, 0.3), transport)
    np.testing.assert_allclose(np.ravel(found), [reflected, transmitted], atol=4 * 5e-4)


@pytest.mark.parametrize(
    "medium",
    [
        Medium(3.0, phase=HenyeyGreenstein(0.9)),
        Medium(1e4, phase=HenyeyGreenstein(0.5)),
        Medium(0.1, phase=lj.SGGX("surface", 0.05)),
        Medium(2.0, phase=FIBERS),
        pytest.param(Medium(2.0, phase=FLAKES), marks=pytest.mark.slow),
    ],
    ids=["haze", "thick", "thin mirrors", "fibers in the plane", "tilted flakes"],
)
def test_lossless_media_lose_nothing(medium):
    stack = Stack([medium])
    wi = jnp.concatenate([directions(40), lj.direction(jnp.asarray([0.0, 1.57, 1.58, np.pi]), 0.3)])
    transport = lj.AddingDoubling(nodes=16, modes=1, ordinates=(8, 8))
    reflected, transmitted = lj.albedo(stack, wi, transport)
    np.testing.assert_allclose(reflected + transmitted + lj.unscattered(stack, wi), 1.0, atol=1e-6)


@pytest.mark.slow  # `test_stiff` is quicker
@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.5])
def test_lossless_interfaces_lose_nothing(alpha):
    stack = Stack([Interface(1.5, alpha), Medium(1.0, phase=HenyeyGreenstein(0.3)), Interface(1.0, alpha)])
    transport = lj.AddingDoubling(nodes=16, modes=1, facet_multiple_scattering=True)
    reflected, transmitted = lj.albedo(stack, directions(40), transport)
    np.testing.assert_allclose(reflected + transmitted, 1.0, atol=1e-9)


STACKS = {
    "haze": Stack([Medium([2.0, 0.5], [0.95, 0.5], HenyeyGreenstein(0.6))]),
    "flakes with Fresnel on paint": Stack(
        [Medium(1.0, 0.9, lj.SGGX("surface", 0.4), f0=0.1)], lj.OrenNayar([0.6, 0.2], 0.4)
    ),
    "coated metal": Stack([Interface(1.5, 0.2), Medium(0.3, 0.5)], lj.Conductor(0.3, 3.0, 0.3)),
    "rough glass": Stack([Medium(0.2), Interface(1.5, 0.3), Medium(0.5, 0.9), Interface(1.2, 0.3)]),
    "fibers over tilted flakes": Stack([Medium(0.5, 0.9, FIBERS), Medium(1.0, 0.95, FLAKES)], Lambertian(0.5)),
}


SLOW = ("flakes with Fresnel on paint", "coated metal", "rough glass", "fibers over tilted flakes")
"""The others hold one medium in modes."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in STACKS],
    ids=str,
)
def solved(request):
    stack = STACKS[request.param]
    return stack, lj.prepare(stack, lj.AddingDoubling(nodes=24, modes=24))


def test_agrees_with_the_walk(solved):
    stack, prepared = solved
    wi, wo = (directions(60, stack.base is None, seed) for seed in (1, 2))  # of one shape in all tests
    values = lj.evaluate(prepared, wi, wo)[:10]
    wi, wo = wi[:10], wo[:10]
    walked, errors = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=8192), key=jax.random.key(3))
    # ordinates at their default leave 1 % of a typical value
    allowed = np.maximum(4 * errors, 0.01 * np.maximum(walked, jnp.mean(walked)))
    assert np.all(np.abs(values - walked) <= allowed), (values - walked) / allowed


def test_is_reciprocal_and_never_negative(solved):
    stack, prepared = solved
    wi, wo = (directions(60, stack.base is None, seed) for seed in (4, 5))
    there, back = lj.evaluate(prepared, wi, wo), lj.evaluate(prepared, wo, wi)
    below = next((layer.ior for layer in reversed(stack.layers) if isinstance(layer, Interface)), 1.0)

    def squared(w):
        return jnp.where(w[:, 2:] > 0, 1.0, below) ** 2 if stack.base is None else 1.0

    np.testing.assert_allclose(there / squared(wo), back / squared(wi), rtol=1e-9, atol=1e-12)
    assert np.all(there >= 0)


def test_orders_add_up_and_first_solves_nothing():
    stack = Stack([Interface(1.5, 0.3), Medium(0.5, 0.9)], Lambertian(0.5))
    wi, wo = directions(20, seed=6), directions(20, seed=7)
    parts = {
        orders: lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=8, modes=4, orders=orders))
        for orders in ("all", "first", "multiple")
    }
    np.testing.assert_allclose(parts["first"] + parts["multiple"], parts["all"], rtol=1e-12)
    assert lj.prepare(stack, lj.AddingDoubling(orders="first")).state.tables is None


def test_first_order_of_media_is_single_scattering():
    stack = STACKS["flakes with Fresnel on paint"]
    wi, wo = directions(20, False, 6), directions(20, False, 7)
    first = lj.evaluate(stack, wi, wo, lj.AddingDoubling(orders="first"))
    np.testing.assert_allclose(first, lj.evaluate(stack, wi, wo, lj.SingleScattering()), rtol=1e-12)


@pytest.mark.slow
def test_along_the_normal_there_is_one_value():
    """Of fibers in the plane too, however the normal is approached; by the walk within 4 errors and 1 %."""
    stack = Stack([Medium(2.0, 0.95, FIBERS)])
    wi = lj.direction(0.9, 0.4)
    wo = lj.direction(jnp.array([0.0, 1e-7, 1e-7, 1e-7]), jnp.array([0.0, 0.3, 1.2, 2.5]))
    values = np.asarray(lj.evaluate(stack, wi, wo, lj.AddingDoubling()))[:, 0]
    np.testing.assert_allclose(values, values[0], rtol=1e-5)
    walk = lj.RandomWalk(paths=1 << 14)
    estimate, error = lj.evaluate_with_error(stack, wi, wo[0], walk, key=jax.random.key(0))
    assert abs(values[0] - estimate[0]) < 4 * error[0] + 0.01 * estimate[0]


def test_light_sent_straight_back_is_a_matter_of_two_streams():
    """A lossless slab that turns it back reflects tau / (1 + tau), however wide the nodes are apart."""
    slab = Stack([Medium(0.1, 1.0, HenyeyGreenstein(-0.999))])
    reflected, _ = lj.albedo(slab, lj.direction(0.0, 0.0), lj.AddingDoubling(nodes=6, modes=1))
    np.testing.assert_allclose(reflected, 0.1 / 1.1, rtol=5e-3)


@pytest.mark.slow
def test_only_stacks_with_an_axis_pay_for_ordinates():
    transport = lj.AddingDoubling(nodes=6, modes=4, ordinates=(4, 4))
    assert lj.prepare(STACKS["haze"], transport).state.tables.azimuths is None
    assert lj.prepare(STACKS["fibers over tilted flakes"], transport).state.tables.azimuths == 4
    upright = Stack([Medium(1.0, 0.9, lj.SGGX("surface", 0.4, axis=(0.0, 0.0, 2.0)))])
    assert lj.prepare(upright, transport).state.tables.azimuths is None


@pytest.mark.slow
def test_the_error_estimate_covers_the_error():
    stack = STACKS["haze"]
    wi, wo = directions(60, seed=8), directions(60, seed=9)
    values, errors = lj.evaluate_with_error(stack, wi, wo, lj.AddingDoubling(nodes=6, modes=8))
    truth = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=20, modes=30))
    assert np.sqrt(np.mean((values - truth) ** 2)) <= np.sqrt(np.mean(errors**2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "tolerance"),
    [
        (Stack([Medium([0.5, 0.2], [0.8, 0.5], HenyeyGreenstein(0.2))]), 0.02),
        *((STACKS["haze"], tolerance) for tolerance in (0.02, 1e-3)),
    ],
    ids=["thin haze", "haze", "haze, closely"],
)
def test_tolerance_picks_the_resolution(stack, tolerance):
    wi, wo = directions(60, seed=8), directions(60, seed=9)
    values = lj.evaluate(stack, wi, wo, lj.AddingDoubling(tolerance=tolerance))
    truth = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=20, modes=30))
    assert np.max(np.abs(values - truth) / (truth + 0.1 * truth.mean())) <= tolerance
    with pytest.raises(ValueError, match=r"AddingDoubling.tolerance.*outside jit"):
        jax.jit(lambda t: lj.evaluate(Stack([Medium(t)]), wi, wo, lj.AddingDoubling(tolerance=tolerance)))(1.0)


@pytest.mark.parametrize(("nodes", "compared"), [(2, [(3, 2)]), (3, [(2, 1), (4, 2)])])
def test_errors_are_told_by_other_resolutions(nodes, compared):
    """The coarser one, if there is one, and the finer."""
    found = lj.AddingDoubling(nodes=nodes, modes=1, ordinates=(2, 4)).comparison_transports()
    assert [(one.nodes, one.modes) for one in found] == compared


@pytest.mark.slow
def test_a_tolerance_is_not_reached_by_what_shines_beside(monkeypatch):
    """Next to a peak that is known in closed form any error of the rest is small: that counts by itself."""
    monkeypatch.setattr(
        "layerjax.transport.adding_doubling.transport.resolutions",
        lambda stack: [Resolution(2, 1, (2, 4)), Resolution(3, 2, (2, 4))],
    )
    stack = Stack([Medium(1e-3, 0.9, lj.SGGX("surface", 0.05))])
    with pytest.raises(ValueError, match=r"0\.01 is not reached"):
        lj.choose_transport(stack, transport=lj.AddingDoubling(tolerance=0.01))


def test_a_stack_that_reflects_nothing_reaches_any_tolerance():
    black = Stack([Medium(1.0, 0.0)], lj.Lambertian(0.0))
    assert lj.choose_transport(black, transport=lj.AddingDoubling(tolerance=1e-6)).nodes == 8


@pytest.mark.slow
def test_tolerance_of_a_concrete_stack_holds_within_jit():
    """Directions that are traced are read off tables, unless they are known: to four thirds of the tolerance."""
    stack = Stack([lj.Interface(1.5, 0.2), Medium(1.0, 0.95, HenyeyGreenstein(0.5))], lj.Lambertian(0.3))
    wi, wo = lj.direction([0.3, 0.8], 0.0), lj.direction([0.2, 0.7], [1.0, 3.0])
    transport, known = lj.AddingDoubling(tolerance=0.03), known_directions(wi, wo)
    values = lj.evaluate(stack, wi, wo, transport)
    within = jax.jit(lambda wi, wo, known: evaluate_known(stack, wi, wo, transport, known=known))
    np.testing.assert_allclose(within(wi, wo, None), values, rtol=0.04)
    np.testing.assert_allclose(within(wi, wo, known), values, rtol=0.04)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"nodes": 1}, "nodes"),
        ({"nodes": 1025}, "nodes"),
        ({"modes": 0}, "modes"),
        ({"modes": 10**400}, "modes"),
        ({"ordinates": (4, 5)}, "ordinates"),
        ({"ordinates": (4, 2000)}, "ordinates"),
        ({"tolerance": 2.0}, "tolerance"),
        ({"orders": "second"}, "orders"),
        ({"facet_multiple_scattering": "none"}, "facet_multiple_scattering"),
    ],
)
def test_bad_options_are_named(options, name):
    with pytest.raises(ValueError, match=rf"AddingDoubling\.{name}: .*"):
        lj.AddingDoubling(**options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["haze", "rough glass"])
def test_samples_have_the_albedo_as_mean_weight(name):
    stack = STACKS[name]
    prepared = lj.prepare(stack, lj.AddingDoubling(nodes=16, modes=16))
    for theta in (0.6, 2.3):
        wi = lj.direction(jnp.full(20_000, theta), 0.4)
        wo, density, weight = lj.sample(prepared, wi, jax.random.key(5))
        np.testing.assert_allclose(density, lj.pdf(prepared, wi, wo), rtol=1e-6)
        near, far = lj.albedo(prepared, wi[0])
        same = (wo[:, 2:] * wi[:, 2:]) > 0
        for energy, part in ((near, jnp.where(same, weight, 0.0)), (far, jnp.where(same, 0.0, weight))):
            error = part.std(axis=0) / np.sqrt(len(part))
            # 2e-3: the resolution of the solution itself
            np.testing.assert_array_less(np.abs(part.mean(axis=0) - energy), 4 * error + 2e-3)


def test_a_batch_of_stacks_under_vmap_and_map():
    wi, wo = directions(5, seed=1), directions(5, seed=2)
    transport = lj.AddingDoubling(nodes=6, modes=4)

    def values(thickness):
        return lj.evaluate(Stack([Medium(thickness, 0.9, HenyeyGreenstein(0.3))]), wi, wo, transport)

    many = jnp.asarray([0.0, 1e-3, 1.0, 1e4])
    one_by_one = jnp.stack([jax.jit(values)(thickness) for thickness in many])
    np.testing.assert_allclose(jax.vmap(values)(many), one_by_one, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(jax.lax.map(values, many), one_by_one, rtol=1e-9, atol=1e-15)
    concrete = lj.evaluate(Stack([Medium(1.0, 0.9, HenyeyGreenstein(0.3))]), wi, wo, transport)
    np.testing.assert_allclose(concrete, one_by_one[2], rtol=1e-9)
