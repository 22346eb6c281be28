"""WeidlichWilkie against the paper's formula written out in numpy, its limits, its sampler, and the whole box."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square, density_of

WW = lj.WeidlichWilkie()


GLAZE = lj.Medium(1.0, 0.0)  # made outside jit, where the albedo stays a known 0


def glaze(thickness):
    """A medium that only absorbs."""
    return eqx.tree_at(lambda medium: medium.thickness, GLAZE, jnp.asarray(thickness))


METAL = lj.Conductor([0.2, 0.9, 1.1], [3.9, 2.5, 2.4], 0.25)
STACKS = {
    "metal": lj.Stack([lj.Interface(1.5, 0.3), glaze([0.1, 0.4, 1.0])], METAL),
    "two coats": lj.Stack(
        [glaze(0.2), lj.Interface(1.8, 0.15), lj.Medium(0.3, 0.0, lj.SGGX("fiber", 0.4)), lj.Interface(1.3, 0.5)], METAL
    ),
    "paint": lj.Stack([lj.Interface(1.5, 0.2), glaze([0.2, 0.1, 0.0])], lj.Lambertian([0.8, 0.5, 0.2])),
    "rough diffuse": lj.Stack([lj.Interface(1.4, 0.6)], lj.OrenNayar(0.7, 0.8)),
    "under water": lj.Stack([lj.Interface(0.75, 0.4)], METAL),
}


def dot(a, b):
    return np.sum(a * b, axis=-1)


def masked(w, alpha):
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / w[..., 2] ** 2 - 1)))


def facets(wi, wo, alpha):
    """Walter 2007, Eqs. 20, 33 and 34 without Fresnel; and the masking."""
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    tan2 = 1 / h[..., 2] ** 2 - 1
    density = alpha**2 / (np.pi * h[..., 2] ** 4 * (alpha**2 + tan2) ** 2)
    masking = masked(wi, alpha) * masked(wo, alpha)
    return density * masking / (4 * wi[..., 2] * wo[..., 2]), masking, h


def fresnel(c, index):
    """Textbook reflectance; index may be complex."""
    t = np.sqrt(1 - (1 - c**2) / np.asarray(index, complex) ** 2)
    s, p = (c - index * t) / (c + index * t), (index * c - t) / (index * c + t)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


def refracted(w, h, ior):
    """Snell: the part across the facet shrinks by 1/ior; upward."""
    across = (w - dot(w, h)[..., None] * h) / ior
    squared = 1 - dot(across, across)
    return across + np.sqrt(np.maximum(squared, 0))[..., None] * h, squared > 0


def reference(layers, base, wi, wo, above=1.0):
    """The model's equation, as the recursion that the paper states, for three channels."""
    if not layers:
        if isinstance(base, lj.Conductor):
            lobe, _, h = facets(wi, wo, float(base.alpha))
            index = (np.asarray(base.ior) + 1j * np.asarray(base.k)) / above
            return lobe[:, None] * fresnel(dot(wi, h)[:, None], index)
        # a diffuse base has tests of its own
        return np.broadcast_to(lj.evaluate(lj.Stack([], base), wi, wo), (len(wi), 3))
    top, rest = layers[0], layers[1:]
    if isinstance(top, lj.Medium):
        area = [1.0, 1.0] if isinstance(top.phase, lj.HenyeyGreenstein) else [fiber_area(w, 0.4) for w in (wi, wo)]
        path = area[0] / wi[:, 2] + area[1] / wo[:, 2]
        return np.exp(-np.asarray(top.thickness) * path[:, None]) * reference(rest, base, wi, wo, above)
    lobe, masking, h = facets(wi, wo, float(top.alpha))
    ior = float(top.ior) / above
    (inner_i, enters), (inner_o, leaves) = refracted(wi, h, ior), refracted(wo, h, ior)
    passes = enters & leaves & (inner_i[:, 2] > 0) & (inner_o[:, 2] > 0)
    inner_i, inner_o = (np.where(passes[:, None], w, [0.6, 0.0, 0.8]) for w in (inner_i, inner_o))
    level = fresnel(dot(wi, h), ior)
    out = 1 - fresnel(dot(inner_o, h), 1 / ior)  # T21
    share = np.where(passes, (1 - level) * ((1 - masking) + out * masking), 0)
    return (level * lobe)[:, None] + share[:, None] * reference(rest, base, inner_i, inner_o, float(top.ior))


def fiber_area(w, alpha):
    return np.sqrt(1 - w[:, 2] ** 2 + (alpha * w[:, 2]) ** 2)


def hemisphere(number, seed, least=0.02):
    random = np.random.default_rng(seed)
    z, phi = random.uniform(least, 1, number), random.uniform(-np.pi, np.pi, number)
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)


@pytest.mark.parametrize("name", STACKS)
def test_the_formula_as_printed_and_reciprocity(name):
    stack = STACKS[name]
    wi, wo = hemisphere(2000, 1), hemisphere(2000, 2)
    values = lj.evaluate(stack, wi, wo, WW)
    expected = reference(stack.layers, stack.base, wi, wo)
    np.testing.assert_allclose(np.broadcast_to(values, expected.shape), expected, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(lj.evaluate(stack, wo, wi, WW), values, rtol=1e-11, atol=1e-14)
    assert not lj.evaluate(stack, wi * [1, 1, -1], wo, WW).any()
    assert not lj.evaluate(stack, wi * [1, 1, -1], wo * [1, 1, -1], WW).any()
    assert not lj.evaluate(stack, wi, wo, WW, side="transmission").any()
    np.testing.assert_array_equal(lj.evaluate(stack, wi, wo, WW, side="reflection"), values)


@pytest.mark.parametrize(("theta", "ior"), [(0.0, 1.5), (1.0, 1.5), (1.4, 2.0), (0.5, 0.8), (1.2, 0.8)])
def test_smooth_coat_over_a_mirror(theta, ior):
    # F + (1 - F)^2 exp(-2 tau / c') F_base cos^2 / cos'^2: the last factor is what the missing Jacobian leaves over
    tau = np.array([0.0, 0.3, 1.0])
    stack = lj.Stack([lj.Interface(ior, 1e-3), glaze(tau)], lj.Conductor(0.2, 3.9, 1e-3))
    reflected, transmitted = lj.albedo(stack, lj.direction(theta, 0.3), WW, nodes=64)
    c = np.cos(theta)
    level, squared = fresnel(c, ior), 1 - (1 - c**2) / ior**2
    inner = np.sqrt(squared) if squared > 0 else 1.0
    deep = (1 - level) ** 2 * np.exp(-2 * tau / inner) * fresnel(inner, (0.2 + 3.9j) / ior) * (c / inner) ** 2
    # the lobes are narrow (alpha^2 = 1e-6 with a tail of its order times a logarithm)
    np.testing.assert_allclose(reflected, level + (deep if squared > 0 else 0.0), rtol=2e-4)
    assert not transmitted.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", STACKS)
def test_samples_weights_and_albedo(name):
    stack = STACKS[name]
    prepared = lj.prepare(stack, WW)
    x, w = np.polynomial.legendre.leggauss(300)
    z, phi = 0.5 * (x + 1)[:, None], 2 * np.pi * (np.arange(600) + 0.5) / 600
    everywhere, weights = lj.direction(np.arccos(z), phi), (0.5 * w[:, None] * z * 2 * np.pi / 600)[..., None]
    for wi in (lj.direction(0.6, 0.4), lj.direction(1.35, 2.0)):
        wo, density, weight = lj.sample(prepared, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(7))
        up = np.asarray(wo[:, 2] > 0)
        probability, total = chi_square(wo[up], lambda w, wi=wi: lj.pdf(prepared, wi, w))
        assert probability > SIGNIFICANCE
        np.testing.assert_allclose(total, np.mean(up), atol=4e-3)
        found = density_of(wo, lambda w, wi=wi: lj.pdf(prepared, wi, w))
        np.testing.assert_allclose(density[:100], found[:100], rtol=1e-9)
        reflected, _ = lj.albedo(prepared, wi)
        mean, error = np.mean(weight, axis=0), np.std(weight, axis=0) / np.sqrt(DRAWS)
        cut = 4e-2 if name == "under water" else 3e-4  # total reflection cuts lobes off where no rule looks for it
        np.testing.assert_array_less(np.abs(mean - reflected), 4.5 * error + cut * mean)
        expected = np.sum(lj.evaluate(prepared, wi, everywhere) * weights, axis=(0, 1))
        np.testing.assert_allclose(reflected, expected, rtol=cut)
        np.testing.assert_array_less(np.abs(mean - expected), 4.5 * error + 2e-3 * mean)


@pytest.mark.slow
def test_it_differs_from_the_truth_as_the_paper_that_improves_on_it_says():
    # a mirror under clear coats loses energy (Belcour 2018, Fig. 12)
    layers = [lj.Interface(ior, 1e-3) for ior in (1.3, 1.0, 1.3, 1.0, 1.3)]
    mirror = lj.Stack(layers, lj.Conductor(0.01, 20.0, 1e-3))
    head_on, slanted = (lj.albedo(mirror, lj.direction(theta, 0.0), WW)[0] for theta in (0.0, 1.2))
    step = ((1.3 - 1) / (1.3 + 1)) ** 2
    through = (1 - step) ** 2
    expected = step * sum(through**k for k in range(5)) + through**5 * fresnel(1.0, (0.01 + 20j) / 1.3)
    np.testing.assert_allclose(head_on, expected, rtol=1e-4)
    assert slanted < 0.8 < head_on < 1.0


def test_what_is_not_there_costs_nothing():
    wi, wo = lj.direction(jnp.linspace(0.1, 1.4, 50), 0.0), lj.direction(jnp.linspace(0.2, 1.3, 50), 2.0)

    def program(layers, **options):
        stack = lj.Stack(layers, lj.Lambertian(0.5))
        return count(lambda wi, wo: lj.evaluate(stack, wi, wo, WW, **options), wi, wo)

    coat = lj.Interface(1.5, 0.2)
    bare, clear, tinted = program([]), program([coat]), program([coat, glaze(0.5)])
    assert bare["sqrt"] == bare["exponential"] == clear["exponential"] == 0 < tinted["exponential"]
    assert program([coat, glaze(0.0)]) == clear
    assert sum(bare.values()) < 12
    assert sum(clear.values()) < sum(tinted.values()) < sum(program([coat, glaze([0.1, 0.5, 0.9])]).values())
    assert not any(program([coat], side="transmission").values())


REFUSED = {
    r"base: WeidlichWilkie needs an opaque base": lj.Stack([lj.Interface(1.5, 0.1)]),
    r"layers\[1\]: WeidlichWilkie carries no Medium that scatters.*AddingDoubling and RandomWalk do": lj.Stack(
        [lj.Interface(1.5, 0.1), lj.Medium(1.0, [0.0, 0.1, 0.0])], METAL
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_it_cannot_carry_is_refused_by_name(message):
    with pytest.raises(ValueError, match=message):
        lj.prepare(REFUSED[message], WW)


def test_a_traced_albedo_is_refused_and_a_medium_of_thickness_0_is_not():
    def value(albedo, thickness):
        stack = lj.Stack([lj.Medium(thickness, albedo)], METAL)
        return lj.evaluate(stack, lj.direction(0.5, 0.0), lj.direction(0.4, 3.0), WW)[0]

    with pytest.raises(ValueError, match="known to be 0"):
        jax.jit(value)(0.0, 1.0)
    assert np.isfinite(jax.grad(value, 1)(0.0, 1.0))
    assert value(0.7, 0.0) > 0


POINTS = 20_000
BOX = {
    "coated metal": lambda p: lj.Stack(
        [lj.Interface(p["ior"], p["alpha"]), glaze(p["thickness"]), lj.Interface(p["below"], p["rough"])],
        lj.Conductor(p["n"], p["k"], p["smooth"]),
    ),
    "coat on rough diffuse": lambda p: lj.Stack(
        [glaze(p["thickness"]), lj.Interface(p["ior"], p["alpha"])], lj.OrenNayar(p["albedo"], p["roughness"])
    ),
}


def draw(seed):
    random = np.random.default_rng(seed)

    def mixed(low, high, *exact, log=False):
        values = np.exp(random.uniform(np.log(max(low, 1e-8)), np.log(high), POINTS))
        values = values if log else random.uniform(low, high, POINTS)
        return np.where(random.random(POINTS) < 0.25, random.choice([low, high, *exact], POINTS), values)

    ranges = {name: mixed(1e-4, 1.0, log=True) for name in ("alpha", "rough", "smooth")}
    ranges |= {name: mixed(0.25, 4.0, 1.0, 1.5, log=True) for name in ("ior", "below")}
    ranges |= {"thickness": mixed(0.0, 1e4, 1e-6, 1.0, log=True), "albedo": mixed(0.0, 1.0)}
    ranges |= {"n": mixed(0.01, 10.0, 1.0, log=True), "k": mixed(0.0, 20.0, 1e-8), "roughness": mixed(0.0, 1.0)}

    def anywhere():
        cosine, phi = mixed(-0.2, 1.0, 1e-6, 0.0, 1e-3), random.uniform(-np.pi, np.pi, POINTS)
        sine = np.sqrt(1.0 - cosine**2)
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)

    wi, wo = anywhere(), anywhere()
    wo[0::10], wo[1::10] = wi[0::10], wi[1::10] * [-1, -1, 1]  # retro, mirror
    wo[4::40], wi[14::40] = [0, 0, 1], [0, 0, 1]
    return ranges, wi, wo


@pytest.mark.parametrize(
    ("name", "dtype", "mode"),
    [
        ("coat on rough diffuse", np.float64, "forward"),
        pytest.param("coated metal", np.float32, "reverse", marks=pytest.mark.slow),
        pytest.param("coated metal", np.float64, "forward", marks=pytest.mark.slow),
        pytest.param("coat on rough diffuse", np.float32, "reverse", marks=pytest.mark.slow),
    ],
)
def test_values_gradients_and_weights_are_finite(name, dtype, mode):
    make = BOX[name]
    parameters, wi, wo = jax.tree.map(lambda x: x.astype(dtype), draw(11))

    @jax.jit
    @jax.vmap
    def everything(parameters, wi, wo, key):
        def value(parameters, wi, wo):
            return jnp.sum(lj.evaluate(make(parameters), wi, wo, WW))

        derivative = jax.grad if mode == "reverse" else jax.jacfwd
        gradients = derivative(value, (0, 1, 2))(parameters, wi, wo)
        return value(parameters, wi, wo), gradients, lj.sample(make(parameters), wi, key, WW)

    value, gradients, drawn = everything(parameters, wi, wo, jax.random.split(jax.random.key(1), POINTS))
    assert value.dtype == dtype
    assert (value >= 0).all()
    for leaf in jax.tree.leaves((value, gradients, drawn)):
        assert np.isfinite(leaf).all()
    both = (wi[:, 2] > 1e-3) & (wo[:, 2] > 1e-3) & (parameters["thickness"] < 1.0)
    assert (value[both] > 0).mean() > 0.95  # finite because it is computed, not because it is 0


@pytest.mark.slow
def test_tangent_and_unnormalised_directions_give_no_nan():
    odd = jnp.array([[1.0, 0, 0], [0, 0, 0], [2, 2, 2], [1, 0, 1e-30], [0, 0, 1e-8], [0, 0, -3], [1e-20, 0, 1e-20]])
    for dtype in (jnp.float32, jnp.float64):
        wi, wo = odd[:, None].astype(dtype), odd[None].astype(dtype)
        value = jax.value_and_grad(lambda wi, wo: jnp.sum(lj.evaluate(STACKS["metal"], wi, wo, WW)), (0, 1))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(value)(wi, wo)))


@pytest.mark.slow
def test_gradients_agree_with_central_differences():
    def value(p):
        layers = [lj.Interface(p[0], p[1]), glaze(p[2]), lj.Interface(p[3], p[4])]
        stack = lj.Stack(layers, lj.Conductor(p[5], p[6], p[7]))
        return lj.evaluate(stack, lj.direction(p[8], 0.2), lj.direction(p[9], 2.9), WW)[0]

    p = jnp.array([1.5, 0.3, 0.4, 1.3, 0.2, 0.9, 2.5, 0.35, 0.6, 0.9])
    step = 1e-5
    shifts = step * jnp.eye(p.size)
    at = jax.jit(jax.vmap(value))
    numeric = (at(p + shifts) - at(p - shifts)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(value))(p), numeric, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(p), numeric, rtol=1e-6, atol=1e-8)
