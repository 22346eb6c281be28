"""Mixtures: means by area of their parts, whatever is asked and however light is carried."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from fits.problem.parameters import Free

BARE = lj.Stack([], lj.Conductor([0.2, 0.4, 1.0], 3.0, 0.3))
COATED = lj.Stack([lj.Interface(1.5, 0.2)], lj.Conductor(0.2, 3.0, 0.3))
DUST, FELT = (lj.Stack([lj.Medium(0.7, 0.8, lj.SGGX("surface", alpha))]) for alpha in (0.3, 0.6))
PAINT = lj.Stack([lj.Interface(1.5, 0.3)], lj.Lambertian([0.2, 0.3, 0.4]))
SOLVER, CHEAP = lj.AddingDoubling(nodes=4, modes=3), lj.WeidlichWilkie()
WI = lj.direction(jnp.array([0.2, 0.9, 0.4]), 0.3)
WO = lj.direction(jnp.array([0.5, 0.3, 2.3]), 3.0)
OTHER_COATED = lj.Stack([lj.Interface(1.3, 0.4)], lj.Conductor(0.6, 2.0, 0.2))
OTHER_PAINT = lj.Stack([lj.Interface(1.3, 0.2)], lj.Lambertian([0.6, 0.5, 0.1]))
HAZE, FOG = (
    lj.Stack([lj.Medium(depth, albedo, lj.HenyeyGreenstein(0.3))], lj.Lambertian([0.2, 0.3, 0.4]))
    for depth, albedo in ((0.7, 0.8), (0.2, 0.95))
)
PARTS = [
    (lj.SingleScattering(), DUST, BARE),
    (lj.SpongeCake(), DUST, FELT),
    (lj.Statistical(), PAINT, OTHER_PAINT),
    (lj.ENDF(), COATED, OTHER_COATED),
    (lj.WeidlichWilkie(), COATED, BARE),
    (SOLVER, HAZE, FOG),
]
"""Two of one structure share their programs; parts of two structures are of the transports that compile least."""
SLOW = lj.Statistical | lj.ENDF | lj.AddingDoubling


@pytest.mark.parametrize(
    ("transport", "one", "other"),
    [
        pytest.param(*given, id=type(given[0]).__name__, marks=[pytest.mark.slow] * isinstance(given[0], SLOW))
        for given in PARTS
    ],
)
def test_everything_is_the_mean_of_the_parts(transport, one, other) -> None:
    mixed = lj.Mixture({"one": one, "other": other}, [0.3, 0.7])
    prepared = lj.prepare(mixed, transport)
    calls = [
        lambda of: lj.evaluate(of, WI, WO, transport),
        lambda of: jnp.stack(lj.albedo(of, WI[:1], transport, nodes=8)),
        lambda of: lj.pdf(of, WI, WO, transport),
    ]
    for call in calls:
        expected = 0.3 * call(one) + 0.7 * call(other)
        np.testing.assert_allclose(call(mixed), expected, rtol=1e-12, atol=1e-15)
    prepared_parts = [lj.prepare(part, transport) for part in (one, other)]
    expected = sum(w * lj.evaluate(part, WI, WO) for w, part in zip((0.3, 0.7), prepared_parts, strict=True))
    np.testing.assert_allclose(lj.evaluate(prepared, WI, WO), expected, rtol=1e-12, atol=1e-15)


def test_light_that_passes_straight_is_the_mean() -> None:
    mixed = lj.Mixture({"dust": DUST, "paint": PAINT}, {"paint": 0.25, "dust": 0.75})
    np.testing.assert_allclose(lj.unscattered(mixed, WI), jnp.broadcast_to(0.75 * lj.unscattered(DUST, WI), (3, 3)))
    assert mixed.channels == 3


@pytest.mark.slow
def test_walks_are_drawn_for_each_part_by_itself() -> None:
    mixed = lj.Mixture({"haze": HAZE, "fog": FOG}, [0.4, 0.6])
    walk, wi, wo, solver = lj.RandomWalk(paths=2048), WI[:2], WO[:2], lj.AddingDoubling(nodes=8, modes=6)
    values, errors = lj.evaluate_with_error(mixed, wi, wo, walk, key=jax.random.key(1))
    truth, numerical = lj.evaluate_with_error(mixed, wi, wo, solver)
    assert np.all(np.abs(values - truth) < 4.0 * errors + numerical)
    own = [lj.evaluate_with_error(part, wi, wo, walk, key=jax.random.key(2))[1] for part in (HAZE, FOG)]
    # standard errors are themselves known to a few percent by so many paths
    np.testing.assert_allclose(errors, np.hypot(0.4 * own[0], 0.6 * own[1]), rtol=0.1)
    keyed = lj.evaluate_with_error(mixed, wi, wo, solver, key=jax.random.key(1))
    np.testing.assert_array_equal(keyed[1], numerical)  # of one that draws nothing a key changes nothing
    with pytest.raises(ValueError, match="key: RandomWalk draws random numbers"):
        lj.evaluate(mixed, wi, wo, walk)


def test_a_key_is_that_of_the_same_part_inside_of_transformations() -> None:
    """JAX puts names in order."""
    mixed = lj.Mixture({"paint": PAINT, "bare": BARE}, [0.3, 0.7])
    inside = jax.tree.map(lambda leaf: leaf, mixed)
    assert list(inside.parts) != list(mixed.parts)
    draws = [of.weighted_values(lambda part, own: (type(part.base), own), jax.random.key(0)) for of in (mixed, inside)]
    assert draws[0] == draws[1]


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_derivatives_by_weights_are_differences(weight: float) -> None:
    def value(w):
        return lj.evaluate(lj.Mixture({"one": COATED, "other": BARE}, [w, None]), WI[0], WO[0], CHEAP)

    expected = lj.evaluate(COATED, WI[0], WO[0], CHEAP) - lj.evaluate(BARE, WI[0], WO[0], CHEAP)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(value)(weight), expected, rtol=1e-10)


def test_transformations_and_precision() -> None:
    mixed = lj.Mixture({"one": COATED, "other": BARE}, [0.2, 0.8])

    def values(mixture, wi, wo):
        return lj.evaluate(mixture, wi, wo, CHEAP)

    expected = values(mixed, WI, WO)
    np.testing.assert_allclose(jax.jit(values)(mixed, WI, WO), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.vmap(values, (None, 0, 0))(mixed, WI, WO), expected, rtol=1e-9)
    single = values(mixed, WI.astype(jnp.float32), WO.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, rtol=1e-3)


def test_mixtures_of_mixtures() -> None:
    inner = lj.Mixture({"one": DUST, "other": FELT}, [0.5, 0.5])
    outer = lj.Mixture({"inner": inner, "bare": BARE}, [None, 0.2])
    flat = lj.Mixture({"one": DUST, "other": FELT, "bare": BARE}, [0.4, 0.4, None])
    found, expected = (lj.evaluate(mixed, WI, WO, lj.SingleScattering()) for mixed in (outer, flat))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
def test_maps_of_weights_and_of_parts() -> None:
    shares = np.linspace(0.0, 1.0, 6).reshape(2, 3)
    alphas = np.linspace(0.1, 0.6, 3)[None] * np.ones((2, 1))
    transport = lj.SingleScattering()

    def rust(alpha) -> lj.Stack:
        return lj.Stack([lj.Medium(0.7, 0.8, lj.SGGX("surface", alpha))], lj.Lambertian([0.2, 0.1, 0.05]))

    mixed = lj.Mixture({"rust": rust(alphas), "metal": BARE}, [shares, None])
    found = lj.evaluate(mixed, WI[0], WO[0], transport)
    reflected = lj.albedo(mixed, WI[0], transport, nodes=8)[0]
    wo, density, weight = lj.sample(mixed, jnp.broadcast_to(WI[0], (5, 1, 1, 3)), jax.random.key(0), transport)
    assert (wo.shape, density.shape, weight.shape) == ((5, 2, 3, 3), (5, 2, 3), (5, 2, 3, 3))
    np.testing.assert_allclose(lj.pdf(mixed, WI[0], wo, transport), density, rtol=1e-9)
    for row, column in np.ndindex(2, 3):
        texel = lj.Mixture({"rust": rust(alphas[row, column]), "metal": BARE}, [shares[row, column], None])
        np.testing.assert_allclose(found[row, column], lj.evaluate(texel, WI[0], WO[0], transport), rtol=1e-9)
        np.testing.assert_allclose(reflected[row, column], lj.albedo(texel, WI[0], transport, nodes=8)[0], rtol=1e-9)
    narrow = lj.Mixture({"rust": rust(alphas[:1]), "metal": BARE}, [shares, None])
    np.testing.assert_allclose(lj.evaluate(narrow, WI[0], WO[0], transport), found, rtol=1e-12)


def test_the_transport_of_all_parts_is_the_finest() -> None:
    matte = lj.Stack([], lj.Lambertian(0.5))
    sharp = lj.Stack([lj.Interface(1.5, 0.05)], lj.Conductor(0.2, 3.0, 0.05))
    assert lj.choose_transport(lj.Mixture({"a": matte, "b": matte}, [0.5, 0.5])) == lj.SingleScattering()
    found, own = (lj.choose_transport(one) for one in (lj.Mixture({"a": matte, "b": sharp}, [0.5, 0.5]), sharp))
    assert found == own


@pytest.mark.parametrize(
    ("parts", "weights", "message"),
    [
        ({}, [], "Mixture.weights: 0 given for 0 parts"),
        ({"a": BARE}, [0.5, 0.5], "Mixture.weights: 2 given for 1 parts; each part must have one"),
        ({"a": BARE, "b": PAINT}, [0.5, 0.6], "Mixture.weights sum to 1.1; they must sum to 1"),
        ({"a": BARE, "b": PAINT, "c": DUST}, [0.5, 0.6, None], "sum to 1.1; they must sum to at most 1, with one"),
        ({"a": BARE, "b": PAINT}, [None, None], "Mixture.weights: 2 are None; at most one may be"),
        ({"a": BARE, "b": PAINT}, [-0.1, 1.1], r"Mixture.weights\['a'\]: -0.1 is outside \[0, 1\]"),
        ({"a": BARE, "b": PAINT}, ["half", None], r"Mixture.weights\['a'\]: 'half' is not a number"),
        ({"a": BARE, "b": PAINT}, {"a": 0.5, "d": 0.5}, "Mixture.weights are of a, d; they must be of a, b"),
        ({"a": BARE, "b": PAINT}, [Free(0.5, 0.0, 1.0), 0.5], "one has to be free of choice: None"),
        ({"a": BARE, "a b": PAINT}, [0.5, 0.5], "Mixture.parts: 'a b' is no name"),
        ({"base": BARE}, [1.0], "Mixture.parts: 'base' is no name; .* not one of weights, parts, layers, base"),
        ({"a": BARE, "b": BARE.base}, [0.5, 0.5], r"Mixture.parts\['b'\]: .* is not a Stack or a Mixture"),
        (
            {"a": BARE, "b": lj.Stack([], lj.Lambertian([0.1, 0.2]))},
            [0.5, 0.5],
            "disagree on the number of channels: a.base.ior has 3, b.base.albedo has 2",
        ),
        (
            {"a": lj.Stack([], lj.Lambertian(np.full((4, 5, 1), 0.5))), "b": PAINT},
            [np.full((4, 4), 0.5), None],
            "disagree on the shape of the map: a.base.albedo has",
        ),
    ],
)
def test_what_is_no_mixture_is_refused(parts, weights, message) -> None:
    with pytest.raises(ValueError, match=message):
        lj.Mixture(parts, weights)


def test_a_family_of_mixtures_is_no_mixture() -> None:
    free = Free(0.5, 0.0, 1.0)
    family = lj.Mixture({"a": lj.Stack([], lj.Lambertian(free)), "b": PAINT}, [free, None])
    with pytest.raises(ValueError, match=r"a.base.albedo, weights.a not given a value"):
        lj.evaluate(family, WI, WO)


@pytest.mark.parametrize("height", [pytest.param(-0.84, marks=pytest.mark.slow), 0.84])
def test_draws_are_those_of_the_albedo(height: float) -> None:
    """From below one part reflects nothing: what is drawn of it must not count for the other. Prepared or not."""
    mixed = lj.Mixture(
        {"paint": lj.Stack([], lj.Lambertian(0.4)), "veil": lj.Stack([lj.Medium(0.5, 0.5)])}, [0.3, None]
    )
    count = 40_000
    wi = jnp.broadcast_to(jnp.array([np.sqrt(1.0 - height**2), 0.0, height]), (count, 3))
    wo, density, weight = lj.sample(mixed, wi, jax.random.key(0), lj.SingleScattering())
    expected = sum(lj.albedo(mixed, wi[0], lj.SingleScattering()))
    assert abs(weight.mean() - expected[0]) < 4.0 * weight.std() / np.sqrt(count)
    again = lj.sample(lj.prepare(mixed, lj.SingleScattering()), wi, jax.random.key(0))
    for one, other in zip(again, (wo, density, weight), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
