"""Maps of stacks: every texel is the stack that stands there, alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax._shapes import map_shape
from layerjax.evaluate import evaluate_known
from layerjax.transport.known_directions import known_directions

N = 5
RNG = np.random.default_rng(7)
ALPHA, IOR, G = RNG.uniform(0.1, 0.6, N), RNG.uniform(1.2, 1.9, N), RNG.uniform(-0.5, 0.7, N)
DEPTH, ALBEDO = RNG.uniform(0.1, 2.0, (N, 1)), RNG.uniform(0.2, 0.9, (N, 3))
AXIS = RNG.normal(size=(N, 3))
WI, WO = (lj.direction(RNG.uniform(0.0, 1.4, N), phi) for phi in (0.0, 2.9))


def media(k):
    flakes = lj.SGGX("surface", ALPHA[k], AXIS[k])
    layers = [lj.Medium(DEPTH[k], ALBEDO[k], flakes, 0.04), lj.Medium(0.3, 0.9, lj.HenyeyGreenstein(G[k]))]
    return lj.Stack(layers, lj.Lambertian([0.5, 0.2, 0.1]))


def haze(k):
    return lj.Stack([lj.Medium(DEPTH[k], ALBEDO[k], lj.HenyeyGreenstein(G[k]))])


def coated(k):
    return lj.Stack([lj.Interface(IOR[k], ALPHA[k])], lj.Conductor([0.2, 0.9, 1.1], 3.0, ALPHA[k]))


def varnished(k):
    return lj.Stack([lj.Interface(IOR[k], 0.3), lj.Medium(DEPTH[k], 0.7)], lj.Lambertian(ALBEDO[k]))


def dyed(k):
    return lj.Stack([lj.Interface(1.5, ALPHA[k]), lj.Medium(DEPTH[k], 0.0)], lj.Lambertian(ALBEDO[k]))


def slab(k):
    return lj.Stack([lj.Interface(IOR[k], ALPHA[k]), lj.Interface(1.0, 0.2)])


SOLVER = lj.AddingDoubling(nodes=4, modes=4, ordinates=(3, 4))
CASES = {
    "SingleScattering": (media, lj.SingleScattering()),
    "SingleScattering, light passes": (haze, lj.SingleScattering()),
    "SpongeCake": (media, lj.SpongeCake()),
    "WeidlichWilkie": (dyed, lj.WeidlichWilkie()),
    "ENDF": (coated, lj.ENDF()),
    "Statistical": (coated, lj.Statistical()),
    "AddingDoubling": (varnished, SOLVER),
    "AddingDoubling, light passes": (slab, SOLVER),
    "AddingDoubling, ordinates": (media, SOLVER),
}


LONG = ("SpongeCake", "Statistical", "AddingDoubling, light passes", "AddingDoubling, ordinates")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in CASES])
def test_a_map_is_its_texels(name):
    """To rounding: the programs add in another order. What a slab's two indices are is known of a single stack, which
    shares panels of nodes where they agree: there, of one that is traced as texels are."""
    stack_of, transport = CASES[name]
    whole = stack_of(slice(None))
    assert map_shape(whole) == (N,)
    values = lj.evaluate(whole, WI, WO, transport)
    alone = jax.jit(lambda *given: evaluate_known(*given[:3], transport, known=given[3])) if stack_of is slab else None
    single = jnp.stack(
        [
            lj.evaluate(stack_of(k), WI[k], WO[k], transport)
            if alone is None
            else alone(stack_of(k), WI[k], WO[k], known_directions(WI[k], WO[k]))
            for k in range(N)
        ]
    )
    assert values.shape == single.shape
    np.testing.assert_allclose(values, single, rtol=1e-9, atol=1e-12 * float(jnp.abs(single).max()))


def test_random_walks_of_a_map():
    whole, walk = haze(slice(None)), lj.RandomWalk(paths=4096)
    values = lj.evaluate(whole, WI, WO, walk, key=jax.random.key(1))
    for k in range(N):
        value, error = lj.evaluate_with_error(haze(k), WI[k], WO[k], walk, key=jax.random.key(100 + k))
        assert (jnp.abs(values[k] - value) < 5.0 * jnp.sqrt(2.0) * error).all()


@pytest.mark.parametrize("transport", [lj.SingleScattering(), pytest.param(lj.SpongeCake(), marks=pytest.mark.slow)])
def test_everything_takes_maps(transport):
    whole = haze(slice(None))
    wo, density, weight = lj.sample(whole, WI, jax.random.key(0), transport)
    near, far = lj.albedo(whole, WI, transport, nodes=8)
    straight = lj.unscattered(whole, WI)
    assert (wo.shape, density.shape, weight.shape) == ((N, 3), (N,), (N, 3))
    for k in range(N):
        stack = haze(k)
        np.testing.assert_allclose(lj.pdf(stack, WI[k], wo[k], transport), density[k], rtol=1e-9)
        value = lj.evaluate(stack, WI[k], wo[k], transport)
        np.testing.assert_allclose(value * jnp.abs(wo[k, 2]) / density[k], weight[k], rtol=1e-9)
        expected = lj.albedo(stack, WI[k], transport, nodes=8)
        np.testing.assert_allclose((near[k], far[k]), expected, rtol=1e-9, atol=1e-14)
        np.testing.assert_allclose(straight[k], lj.unscattered(stack, WI[k]), rtol=1e-12)
    np.testing.assert_allclose(lj.pdf(whole, WI, wo, transport), density, rtol=1e-9)


@pytest.mark.parametrize("shape", [(N, 3), (3,), (4, 1, 3), (4, N, 3)])
def test_directions_broadcast_against_the_map(shape):
    whole, transport = haze(slice(None)), lj.SingleScattering()
    wi = lj.direction(RNG.uniform(0.0, 1.4, shape[:-1]), 0.0)
    wo = lj.direction(jnp.asarray(0.7), 2.0)
    values = lj.evaluate(whole, wi, wo, transport)
    assert values.shape == (*np.broadcast_shapes((N,), shape[:-1]), 3)
    wide = jnp.broadcast_to(wi, (*values.shape[:-1], 3))
    for k in range(N):
        np.testing.assert_allclose(values[..., k, :], lj.evaluate(haze(k), wide[..., k, :], wo, transport), rtol=1e-9)


def test_a_picture_with_one_light():
    """Of two axes; a leaf may have an axis of 1 where all along it share a number."""
    rough = jnp.linspace(0.1, 0.5, 6).reshape(2, 3)
    stack = lj.Stack([lj.Interface(1.5, rough)], lj.Lambertian(jnp.ones((2, 1, 1)) * 0.5))
    wi, wo = lj.direction(0.5, 0.0), lj.direction(jnp.linspace(0.0, 1.0, 3), 3.0)
    values = lj.evaluate(stack, wi, wo, lj.WeidlichWilkie())
    assert values.shape == (2, 3, 1)
    alone = lj.Stack([lj.Interface(1.5, rough[1, 2])], lj.Lambertian(0.5))
    np.testing.assert_allclose(values[1, 2], lj.evaluate(alone, wi, wo[2], lj.WeidlichWilkie()), rtol=1e-9)


@pytest.mark.parametrize("transport", [lj.WeidlichWilkie(), pytest.param(SOLVER, marks=pytest.mark.slow)])
def test_gradients_are_those_of_texels_and_work_under_jit(transport):
    def loss(alpha):
        stack = lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian([0.8, 0.4, 0.2]))
        return jnp.sum(lj.evaluate(stack, WI, WO, transport) ** 2)

    def alone(alpha, k):
        stack = lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian([0.8, 0.4, 0.2]))
        return jnp.sum(lj.evaluate(stack, WI[k], WO[k], transport) ** 2)

    gradient = jax.jit(jax.grad(loss))(jnp.asarray(ALPHA))
    for k in range(2):
        np.testing.assert_allclose(gradient[k], jax.grad(alone)(jnp.asarray(ALPHA[k]), k), rtol=1e-8)


def test_memory_does_not_grow_with_texels_times_quadrature():
    """Beyond inputs and results a program needs as much for a million texels as for a hundred thousand."""
    wi, wo = lj.direction(0.5, 0.0), lj.direction(0.4, 3.0)

    def needed(texels):
        stack = lj.Stack([lj.Medium(jnp.ones((texels, 1)), 0.9, lj.HenyeyGreenstein(0.3))], lj.Lambertian(0.5))
        program = jax.jit(lambda stack: lj.evaluate(stack, wi, wo, lj.SpongeCake())).lower(stack).compile()
        return program.memory_analysis().temp_size_in_bytes / texels

    assert needed(1_000_000) < 64  # inputs padded to whole chunks, and results before they are cut: 8 bytes each


def test_chunks_that_do_not_fill():
    texels = 2048 + 1
    alpha = jnp.linspace(0.1, 0.6, texels)
    stack = lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian(0.5))
    wi, wo = lj.direction(0.5, 0.0), lj.direction(0.4, 3.0)
    values = lj.evaluate(stack, wi, wo, lj.WeidlichWilkie())
    alone = lj.Stack([lj.Interface(1.5, alpha[-1])], lj.Lambertian(0.5))
    assert values.shape == (texels, 1)
    np.testing.assert_allclose(values[-1], lj.evaluate(alone, wi, wo, lj.WeidlichWilkie()), rtol=1e-9)


@pytest.mark.slow
def test_an_axis_that_is_the_normal_stays_so():
    """Media that are symmetric about it are solved in modes, in a map as well."""

    def stack_of(k):
        return lj.Stack([lj.Medium(1.0, 0.8, lj.SGGX("fiber", ALPHA[k], (0.0, 0.0, 2.0)))], lj.Lambertian(0.5))

    values = lj.evaluate(stack_of(slice(None)), WI, WO, SOLVER)
    np.testing.assert_allclose(values[2], lj.evaluate(stack_of(2), WI[2], WO[2], SOLVER), rtol=1e-9)


def test_a_map_of_layers_that_are_nowhere():
    """What differs from texel to texel is known not to be there: every texel is the bare base."""
    stack = lj.Stack([lj.Medium(jnp.zeros((N, 1)), 0.5)], lj.Lambertian(0.5))
    values = lj.evaluate(stack, WI[0], WO[0], lj.SingleScattering())
    np.testing.assert_allclose(values, jnp.full((N, 1), 0.5 / jnp.pi), rtol=1e-12)


REFUSED = {
    "layers[0].albedo: shape (3,) given in a map of shape (3,): texels or channels?": lambda: lj.Stack(
        [lj.Medium(1.0, [0.1, 0.2, 0.3], lj.HenyeyGreenstein(jnp.zeros(3)))]
    ),
    "base.albedo: shape (2, 3) given, where layers[0].ior makes it a map of 2 axes: (H, W, 1) is": lambda: lj.Stack(
        [lj.Interface(jnp.full((2, 3), 1.5), 0.1)], lj.Lambertian(jnp.ones((2, 3)))
    ),
    "layers[0].alpha: shape (3,) given, where layers[0].ior makes it a map of 2 axes: (H, W) is": lambda: lj.Stack(
        [lj.Interface(jnp.full((2, 3), 1.5), jnp.full(3, 0.1))]
    ),
    "disagree on the shape of the map: layers[0].ior has (2,), layers[0].alpha has (3,)": lambda: lj.Stack(
        [lj.Interface(jnp.full(2, 1.5), jnp.full(3, 0.1))]
    ),
    "does not broadcast against directions of shape (4, 3)": lambda: lj.evaluate(
        coated(slice(None)), WI[:4], WO[0], lj.ENDF()
    ),
    "evaluate_with_error takes one stack; layers[0].ior of shape (5,)": lambda: lj.evaluate_with_error(
        coated(slice(None)), WI, WO, SOLVER
    ),
    "prepare takes one stack; layers[0].ior of shape (5,)": lambda: lj.prepare(coated(slice(None))),
    "goniophotometer takes one stack": lambda: lj.goniophotometer(coated(slice(None)), WI[0], key=jax.random.key(0)),
    "layers: SpongeCake puts 3 media together": lambda: lj.evaluate(
        lj.Stack(haze(slice(None)).layers * 3), WI, WO, lj.SpongeCake()
    ),
    "AddingDoubling.tolerance: 0.01 is for one stack": lambda: lj.evaluate(
        coated(slice(None)), WI, WO, lj.AddingDoubling(tolerance=0.01)
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_is_no_map_is_refused(message):
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the message is compared below, brackets and all)
        REFUSED[message]()
    assert message in str(error.value)


def test_no_texels_and_no_directions():
    stack, none = coated(slice(None)), jnp.zeros((0, 1, 3))
    assert lj.evaluate(stack, none, WO[0], lj.ENDF()).shape == (0, N, 3)
    assert lj.sample(stack, none, jax.random.key(0), lj.ENDF())[0].shape == (0, N, 3)
