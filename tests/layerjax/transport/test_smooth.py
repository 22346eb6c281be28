"""Smooth interfaces and mirrors: closed forms, energies, derivatives, draws, and the walk beside the solver."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss

import layerjax as lj
from layerjax.transport.adding_doubling.operators import Layer, Parts, add

SOLVER = lj.AddingDoubling(nodes=12, modes=12)
ANGLES = np.deg2rad([0.0, 30.0, 60.0, 80.0])
HAZE = lj.Medium(0.6, [0.9, 0.7], lj.HenyeyGreenstein(0.4))
METAL = (0.2, 3.9)
STACKS = {
    "varnish": lj.Stack([lj.Interface(1.5)], lj.Lambertian([0.7, 0.2])),
    "hazy pane": lj.Stack([lj.Interface(1.5), HAZE, lj.Interface(1.0)]),
    "coated metal": lj.Stack([lj.Interface(1.5)], lj.Conductor(*METAL, alpha=0.3)),
    "haze on a mirror": lj.Stack([HAZE], lj.Conductor(*METAL)),
    "rough coat on a mirror": lj.Stack([lj.Interface(1.5, 0.4), HAZE], lj.Conductor(*METAL)),
    "smooth coat on a mirror": lj.Stack([lj.Interface(1.5), HAZE], lj.Conductor(*METAL)),
    "rough face below": lj.Stack([lj.Interface(1.5), HAZE, lj.Interface(1.2, 0.4)]),
    "haze around rough and smooth": lj.Stack([HAZE, lj.Interface(1.3, 0.4), HAZE, lj.Interface(1.6), HAZE]),
    "two coats": lj.Stack([HAZE, lj.Interface(1.3), HAZE, lj.Interface(1.7), HAZE], lj.Lambertian(0.5)),
    "step down": lj.Stack([lj.Interface(1.5), HAZE, lj.Interface(1.1), HAZE, lj.Interface(1.4)]),
}
QUICK = ("varnish",)


def cases(names, quick=QUICK):
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in names]


def directions(stack, thetas=ANGLES[:3]):
    """Lights on all sides that there are, and viewers off their planes."""
    sides = (1.0,) if stack.base is not None else (1.0, -1.0)
    lights = [lj.direction(theta, 0.3) * jnp.asarray([1.0, 1.0, side]) for theta in thetas for side in sides]
    viewers = [lj.direction(theta, 2.5) * jnp.asarray([1.0, 1.0, side]) for theta in thetas for side in sides]
    return jnp.stack(lights)[:, None], jnp.stack(viewers)


def fresnel(cosine, ior):
    """Textbook reflectance, for the test alone."""
    squared = 1.0 - (1.0 - cosine**2) / ior**2
    t = np.sqrt(np.maximum(squared, 0.0))
    s, p = (cosine - ior * t) / (cosine + ior * t), (ior * cosine - t) / (ior * cosine + t)
    return np.where(squared > 0.0, 0.5 * (s * s + p * p), 1.0)


def internal_reflectance(ior):
    """Of diffuse light from inside; beyond the critical angle it is 1."""
    x, w = leggauss(60)
    u = 0.5 * (1.0 + x) / ior  # the cosine outside over the index: sin dsin = u du
    return 1.0 - np.sum(0.5 * w / ior * 2.0 * u * (1.0 - fresnel(ior * u, ior)))


def unit(z, phi):
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z + 0.0 * phi], axis=-1)


@pytest.mark.parametrize("ior", [1.5, 1.05, 2.4])
def test_a_varnish_is_saundersons(ior):
    """f = T_i T_o rho / (pi n^2 (1 - rho K)) (Saunderson 1942), and its albedo."""
    rho = np.array([0.0, 0.3, 0.9])
    stack = lj.Stack([lj.Interface(ior)], lj.Lambertian(rho))
    wi, wo = lj.direction(0.5, 0.1), lj.direction(jnp.asarray(ANGLES), 2.0)
    kept = internal_reflectance(ior)
    entering = 1.0 - fresnel(np.cos(0.5), ior)
    level = entering * rho / (1.0 - rho * kept)
    expected = level / (np.pi * ior**2) * (1.0 - fresnel(np.cos(ANGLES), ior))[:, None]
    found, error = lj.evaluate_with_error(stack, wi, wo, SOLVER)
    assert np.all(np.abs(found - expected) <= error + 1e-12)
    assert np.all(error <= 1e-3 * expected + 1e-12)
    np.testing.assert_allclose(lj.albedo(stack, wi, SOLVER)[0], level * (1.0 - kept), rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(lj.specular(stack, wi)[0][0], 1.0 - entering, rtol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_absorbing_plate_between_two_media(side):
    """All turns within it as a sum, from either side, beyond the critical angle too."""
    n, below, depth = 1.7, 1.2, np.array([0.0, 0.4])
    stack = lj.Stack([lj.Interface(n), lj.Medium(depth, 0.0), lj.Interface(below)])
    cosine = np.array([1.0, 0.7, 0.5, 0.1])
    wi = unit(side * cosine, np.zeros(4))
    first, last = (1.0, below) if side > 0 else (below, 1.0)
    inside = np.sqrt(1.0 - (first / n) ** 2 * (1.0 - cosine**2))
    near, far = fresnel(cosine, n / first), fresnel(inside, last / n)
    passes = np.exp(-depth / inside[:, None])
    turns = (near * far)[:, None] * passes**2
    series = sum(turns**k for k in range(400))
    transmitted = ((1.0 - near) * (1.0 - far))[:, None] * passes * series
    reflected = near[:, None] + ((1.0 - near) ** 2 * far)[:, None] * passes**2 * series
    found = lj.specular(stack, wi)
    np.testing.assert_allclose(found[0], reflected, rtol=1e-10)
    np.testing.assert_allclose(found[1], transmitted, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose((found[0] + found[1])[:, 0], 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("stack", "modes", "error"),
    [
        (lj.Stack([lj.Interface(1.64)], lj.Conductor(1.5, 1.7, 0.125)), 32, 2e-5),
        pytest.param(
            lj.Stack([lj.Interface(1.5), lj.Medium(1.0, 0.9, lj.SGGX("surface", 0.2))], lj.Lambertian(0.3)),
            24,
            2e-5,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["metal", "flakes"],
)
def test_azimuths_resolve_light_that_a_smooth_coat_reflects_totally(stack, modes, error):
    """Eight times the modes have six times the azimuths. At equal distances they were off by 2e-4 and 3e-4."""
    pairs = lj.direction(np.deg2rad([30.0, 55.0]), 0.0), lj.direction(np.deg2rad([[30.0], [55.0]]), 0.0)
    found, fine = (lj.evaluate(stack, *pairs, lj.AddingDoubling(nodes=12, modes=m)) for m in (modes, 8 * modes))
    np.testing.assert_allclose(found, fine, rtol=error)


def test_lobes_of_a_smooth_furnace():
    """Deepest reflection by deepest reflection, for indices 1.3, 1.0, 1.3, 1.0, 1.3 over a mirror: as published, to the
    3e-7 that those figures are from k equal faces in a row, which reflect k F / (1 + (k - 1) F)."""
    published = {
        0.0: [0.0170132, 0.0164440, 0.0159029, 0.0153880, 0.0148978, 0.9203540],
        60.0: [0.0533995, 0.0479854, 0.0433553, 0.0393642, 0.0359002, 0.7799954],
        75.0: [0.2013362, 0.1338512, 0.0954256, 0.0714700, 0.0555288, 0.4423882],
    }
    layers = [lj.Interface(n) for n in (1.3, 1.0, 1.3, 1.0, 1.3)]
    for degrees, lobes in published.items():
        wi = lj.direction(degrees, 0.0, degrees=True)
        deepest = [float(lj.specular(lj.Stack(layers[: k + 1]), wi)[0][0]) for k in range(5)]
        passed = float(lj.specular(lj.Stack(layers), wi)[1][0])
        np.testing.assert_allclose([*np.diff([0.0, *deepest]), passed], lobes, atol=4e-7)
        level, faces = fresnel(np.cos(np.deg2rad(degrees)), 1.3), np.arange(1, 6)
        np.testing.assert_allclose(deepest, faces * level / (1.0 + (faces - 1) * level), rtol=1e-12)


@pytest.mark.parametrize("name", cases(STACKS, ("varnish", "hazy pane")))
def test_lossless_stacks_lose_nothing(name):
    """Scattered and specular energies sum to 1 where no medium, metal or base absorbs."""
    white = lj.Medium(0.6, 1.0, lj.HenyeyGreenstein(0.4))
    layers = [white if isinstance(layer, lj.Medium) else layer for layer in STACKS[name].layers]
    base = None if STACKS[name].base is None else lj.Lambertian(1.0)
    stack = lj.Stack(layers, base)
    wi = directions(stack, [*ANGLES, 1.5])[0][:, 0]
    transport = lj.AddingDoubling(nodes=16, modes=1, facet_multiple_scattering=True)
    total = sum(lj.albedo(stack, wi, transport)) + sum(lj.specular(stack, wi))
    # shares are interpolated between nodes; those of rough faces with a smooth one outside them change faster
    rough = any(isinstance(layer, lj.Interface) and not layer.is_smooth for layer in layers)
    np.testing.assert_allclose(total, 1.0, atol=3e-3 if rough else 5e-5)


@pytest.mark.parametrize("name", cases(STACKS))
def test_the_walk_agrees(name):
    """Values, energies and what is specular, from either side: different code but for Fresnel's equations."""
    stack = STACKS[name]
    wi, wo = directions(stack)
    found, error = lj.evaluate_with_error(stack, wi, wo, lj.AddingDoubling())
    walked, noise = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=1 << 14), key=jax.random.key(0))
    assert np.all(np.abs(found - walked) <= 5.0 * noise + error + 1e-3 * np.abs(found) + 1e-6)
    solved = lj.albedo(stack, wi[:, 0])
    counted = lj.goniophotometer(stack, wi[:, 0], key=jax.random.key(1), paths=1 << 15)
    for side, energy in enumerate(solved):
        slack = 5.0 * counted.albedo_error[:, side] + 3e-3  # energies between nodes: to 4e-3 at worst
        assert np.all(np.abs(energy - counted.albedo[:, side]) <= slack)
    specular = sum(lj.specular(stack, wi[:, 0]))
    assert np.all(np.abs(specular - counted.unscattered) <= 5.0 * counted.unscattered_error + 1e-5)


@pytest.mark.parametrize("name", cases(STACKS, ("hazy pane",)))
@pytest.mark.parametrize(
    "transport",
    [
        pytest.param(lj.AddingDoubling(), id="solver"),
        pytest.param(lj.RandomWalk(paths=64), id="walk", marks=pytest.mark.slow),
    ],
)
def test_draws_are_worth_all_of_the_light(name, transport):
    """Weights have the mean of both energies; deltas are where they should be, as often as is said, at their energy."""
    stack, count = STACKS[name], 4000
    for light in directions(stack, [0.6])[0][:, 0]:
        wi = jnp.broadcast_to(light, (count, 3))
        wo, density, weight = lj.sample(stack, wi, jax.random.key(2), transport)
        specular = lj.specular(stack, light)
        solver = lj.AddingDoubling()
        energy = sum(lj.albedo(stack, light, solver)) + sum(specular)
        mean, error = weight.mean(axis=0), weight.std(axis=0) / np.sqrt(count)
        assert np.all(np.abs(mean - energy) <= 5.0 * error + 5e-3 * energy)
        indices = [float(face.ior) for face in stack.layers if isinstance(face, lj.Interface)]
        below = 1.0 if stack.base is not None else indices[-1]
        ratio = below if light[2] > 0 else 1.0 / below
        z = np.sqrt(max(0.0, 1.0 - (1.0 - float(light[2]) ** 2) / ratio**2))
        rays = [[-light[0], -light[1], light[2]], [-light[0] / ratio, -light[1] / ratio, -np.sign(light[2]) * z]]
        for ray, part in zip(rays, specular, strict=True):
            along = np.linalg.norm(wo - np.asarray(ray), axis=1) < 1e-9
            if float(part.max()) == 0.0:
                continue
            chance = float(density[along][0])
            assert np.allclose(density[along], chance)
            assert abs(along.mean() - chance) < 5.0 * np.sqrt(chance / count)
            np.testing.assert_allclose(weight[along][0] * chance, part, rtol=1e-9)
        if isinstance(transport, lj.AddingDoubling) and stack.base is not None:
            apart = np.linalg.norm(wo - np.asarray(rays[0]), axis=1) >= 1e-9
            np.testing.assert_allclose(lj.pdf(stack, wi, wo, transport)[apart], density[apart], rtol=1e-6)


EXACT = {
    "varnish": STACKS["varnish"],
    "dyed": lj.Stack(
        [lj.Medium(0.3, 0.0), lj.Interface(1.5), lj.Medium([0.2, 0.7], 0.0), lj.Interface(1.7)], lj.Lambertian(0.5)
    ),
    "step down": lj.Stack([lj.Interface(1.6), lj.Medium(0.3, 0.0), lj.Interface(1.2)], lj.Lambertian(0.8)),
}


@pytest.mark.parametrize("name", cases(EXACT))
def test_statistics_of_smooth_coats_on_a_diffuse_base_are_exact(name):
    """Nothing has a width: values, energies and draws are those of the solver."""
    stack, count = EXACT[name], 4000
    wi, wo = directions(stack)
    found, error = lj.evaluate_with_error(stack, wi, wo, SOLVER)
    values = lj.evaluate(stack, wi, wo, lj.Statistical())
    assert np.all(np.abs(values - found) <= error + 2e-4 * found)
    lights = wi[:, 0]
    energy = lj.albedo(stack, lights, lj.Statistical())[0]
    np.testing.assert_allclose(energy, lj.albedo(stack, lights, SOLVER)[0], rtol=1e-3)
    weight = lj.sample(stack, jnp.broadcast_to(lights[1], (count, 3)), jax.random.key(0), lj.Statistical())[2]
    whole = energy[1] + lj.specular(stack, lights[1])[0]
    assert np.all(np.abs(weight.mean(axis=0) - whole) <= 5.0 * weight.std(axis=0) / np.sqrt(count))


def roughened(stack, alpha):
    """The same stack, its smooth surfaces rough by this width."""

    def rough(part):
        smooth = isinstance(part, lj.Interface | lj.Conductor) and part.is_smooth
        return dataclasses.replace(part, alpha=alpha) if smooth else part

    return lj.Stack([rough(layer) for layer in stack.layers], rough(stack.base))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coated metal", "rough coat on a mirror", "rough face below", "hazy pane"])
def test_statistics_of_smooth_stacks_are_those_of_narrow_ones(name):
    """Both parts of the energy; and draws are worth them."""
    stack, count, transport = STACKS[name], 20_000, lj.Statistical()
    for light in directions(stack, [0.6])[0][:, 0]:
        energies, specular = lj.albedo(stack, light, transport), lj.specular(stack, light)
        narrow = lj.albedo(roughened(stack, 1e-4), light, transport)
        for part, delta, all_of_it in zip(energies, specular, narrow, strict=True):
            np.testing.assert_allclose(part + delta, all_of_it, atol=3e-3)
        weight = lj.sample(stack, jnp.broadcast_to(light, (count, 3)), jax.random.key(0), transport)[2]
        whole = sum(energies) + sum(specular)
        assert np.all(np.abs(weight.mean(axis=0) - whole) <= 5.0 * weight.std(axis=0) / np.sqrt(count) + 2e-3)


@pytest.mark.parametrize("orders", [pytest.param("first", marks=pytest.mark.slow), "all"])
def test_draws_of_mirrors_and_of_single_orders(orders):
    """A mirror alone has nothing but its delta; deltas are of no single order, and bias nothing."""
    transport, count = lj.AddingDoubling(nodes=8, modes=8, orders=orders), 20_000
    for stack in (lj.Stack([], lj.Conductor(*METAL)), STACKS["varnish"], STACKS["hazy pane"]):
        wi = lj.direction(1.0, 0.2)
        weight = lj.sample(stack, jnp.broadcast_to(wi, (count, 3)), jax.random.key(0), transport)[2]
        if orders == "all":
            energy = sum(lj.albedo(stack, wi, transport)) + sum(lj.specular(stack, wi))
        else:  # no albedo of single orders is given where there are interfaces
            cosine = jax.random.uniform(jax.random.key(1), (count, 2))
            z, phi = jnp.sqrt(1.0 - cosine[:, 0]), 2.0 * np.pi * cosine[:, 1]
            flat = jnp.asarray(unit(np.asarray(z), np.asarray(phi)))
            sides = (1.0,) if stack.base is not None else (1.0, -1.0)
            energy = sum(
                np.pi * lj.evaluate(stack, wi, flat * jnp.asarray([1.0, 1.0, side]), transport).mean(axis=0)
                for side in sides
            )
        error = weight.std(axis=0) / np.sqrt(count)
        # energies between nodes: to 4e-3 at worst; that of single orders is a mean of draws itself
        slack = 4e-3 if orders == "all" else 4.0 / np.sqrt(count)
        assert np.all(np.abs(weight.mean(axis=0) - energy) <= 5.0 * error + slack * energy + 1e-9)


def test_weights_of_draws_have_derivatives():
    def total(n):
        stack = lj.Stack([lj.Interface(n)], lj.Lambertian(0.5))
        wi = jnp.broadcast_to(lj.direction(0.4, 0.0), (8, 3))
        return lj.sample(stack, wi, jax.random.key(0), lj.AddingDoubling(nodes=4, modes=2))[2].sum()

    backward = jax.grad(total)(1.5)
    assert np.isfinite(backward)
    np.testing.assert_allclose(backward, jax.jacfwd(total)(1.5), rtol=1e-8)


def test_grazing_light_from_below_in_single_precision():
    """The derivative by the index below, which is that of the light, too."""

    def reflected(index, dtype):
        stack = lj.Stack([lj.Interface(1.5), lj.Interface(index)])
        return lj.specular(stack, jnp.asarray([1.0, 0.0, -1e-5], dtype))[0][0]

    single, double = (float(jax.grad(reflected)(jnp.asarray(0.7, d), d)) for d in (jnp.float32, jnp.float64))
    np.testing.assert_allclose(single, double, rtol=2e-2)


def test_a_mixture_draws_the_deltas_of_its_parts():
    gloss = lj.Stack([lj.Interface(1.5)], lj.Lambertian(0.5))
    spots = lj.Mixture({"paint": lj.Stack([], lj.Lambertian(0.5)), "gloss": gloss}, [0.25, 0.75])
    wi = lj.direction(1.2, 0.2)
    mirrored = lj.specular(spots, wi)[0]
    np.testing.assert_allclose(mirrored, 0.75 * lj.specular(gloss, wi)[0], rtol=1e-12)
    wo, density, weight = lj.sample(spots, jnp.broadcast_to(wi, (20_000, 3)), jax.random.key(0), SOLVER)
    energy = lj.albedo(spots, wi, SOLVER)[0] + mirrored
    assert abs(weight.mean() - energy) < 5.0 * weight.std() / np.sqrt(20_000)
    along = np.linalg.norm(wo - jnp.asarray([-wi[0], -wi[1], wi[2]]), axis=1) < 1e-9
    np.testing.assert_allclose(along.mean(), density[along][0], atol=5e-3)


@pytest.mark.parametrize("name", cases(STACKS))
def test_derivatives_are_those_of_differences(name):
    """By every index, thickness and albedo, forward and backward; single precision has them, too. An index that is that
    of another region is left out: differences that small are those of polynomials, which are no derivatives there."""
    stack = STACKS[name]
    wi, wo = directions(stack, [0.5])
    leaves, structure = jax.tree.flatten(stack)

    def total(*leaves):
        given = jax.tree.unflatten(structure, leaves)
        values = lj.evaluate(given, wi, wo, SOLVER)
        return jnp.sum(values) + sum(jnp.sum(part) for part in lj.specular(given, wi[:, 0]))

    every = tuple(range(len(leaves)))
    backward, forward = (of(total, every)(*leaves) for of in (jax.grad, jax.jacfwd))
    for k, (leaf, slope) in enumerate(zip(leaves, backward, strict=True)):
        np.testing.assert_allclose(slope, forward[k], rtol=1e-8, atol=1e-10)
        if leaf.ndim == 0 and leaf == 1.0:
            continue
        step = 1e-5

        def moved(by, k=k, leaf=leaf):
            return float(total(*leaves[:k], leaf + by, *leaves[k + 1 :]))

        difference = (moved(step) - moved(-step)) / (2.0 * step)
        np.testing.assert_allclose(np.sum(slope), difference, rtol=2e-3, atol=2e-5)
    single = [leaf.astype(jnp.float32) for leaf in leaves]
    assert all(np.all(np.isfinite(slope)) for slope in jax.grad(total, every)(*single))


def test_thin_panes_at_few_nodes():
    """Light goes to and fro often between the faces of a clear pane: that is no matter of interpolation."""
    stack = lj.Stack([lj.Interface(1.5), lj.Medium(0.02, 0.9), lj.Interface(1.0)])
    wi, wo = directions(stack, [0.2, 0.9, 1.4])
    coarse, fine = (
        [lj.evaluate(stack, wi, wo, transport), *lj.albedo(stack, wi[:, 0], transport)]
        for transport in (lj.AddingDoubling(nodes=n, modes=1) for n in (12, 24))
    )
    for one, other in zip(coarse, fine, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3)


def test_the_derivative_by_an_index_equal_to_that_outside():
    """Of values and albedo of a pane, forward and backward. Differences over larger steps, and nearer to grazing light,
    have errors of their own: values vary with the square root of the difference of the indices."""
    transport = lj.AddingDoubling(nodes=12, modes=1)
    w = jnp.stack([lj.direction(theta, 0.3) * jnp.asarray([1.0, 1.0, z]) for theta in (0.2, 1.0) for z in (1.0, -1.0)])

    @jax.jit
    def pane(below):
        stack = lj.Stack([lj.Interface(1.5), lj.Medium(0.6, 0.9), lj.Interface(below)])
        parts = lj.evaluate(stack, w[:, None], w, transport), *lj.albedo(stack, w, transport)
        return jnp.concatenate([part.ravel() for part in parts])

    step = 0.005
    difference = (pane(1.0 + step) - pane(1.0 - step)) / (2.0 * step)
    forward = jax.jacfwd(pane)(1.0)
    np.testing.assert_allclose(forward[:16], difference[:16], atol=2e-4)  # of 0.14
    np.testing.assert_allclose(forward[16:], difference[16:], atol=2.5e-3)  # of 0.46
    backward = jax.vjp(pane, 1.0)[1](difference)[0]
    np.testing.assert_allclose(backward, jnp.sum(difference * forward), rtol=1e-10)


@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
def test_the_ends_are_finite(dtype):
    """Equal indices, grazing and normal light, layers of no thickness and of a great one, total reflection."""
    cosines = np.array([1.0, 0.5, 1e-3, 1e-6])
    wi = jnp.asarray(unit(cosines, np.linspace(0.0, 2.0, 4)), dtype)[:, None]
    both = jnp.concatenate([wi, -wi])

    @jax.jit
    def total(numbers):
        n, m, thickness, albedo = numbers
        layers = [lj.Interface(n), lj.Medium(thickness, albedo), lj.Interface(m)]
        stack = lj.Stack(layers)
        values = lj.evaluate(stack, both, both[:, 0], lj.AddingDoubling(nodes=6, modes=4))
        return jnp.sum(values) + sum(jnp.sum(part) for part in lj.specular(stack, both))

    ends = itertools.product((1.0, 1.5, 4.0), (0.25, 1.0), (0.0, 1e4), (0.0, 1.0))
    for numbers in ends:
        value, slope = jax.value_and_grad(total)(jnp.asarray(numbers, dtype))
        assert np.isfinite(value)
        assert np.all(np.isfinite(slope)), numbers


def test_what_is_smooth_is_so_by_structure():
    assert lj.Interface(1.5).is_smooth
    assert lj.Interface(1.5, 0).alpha is None
    assert lj.Conductor(0.2, 3.9, np.zeros(3)).is_smooth
    assert not lj.Interface(1.5, 1e-4).is_smooth
    with pytest.raises(ValueError, match=r"Interface.alpha: 5e-05 is outside"):
        lj.Interface(1.5, 5e-5)
    wi = lj.direction(0.3, 0.0)
    with pytest.raises(ValueError, match=r"layers\[0\]: the lobe of a diffuse base needs a rough Interface"):
        lj.evaluate(STACKS["varnish"], wi, wi, lj.Statistical(diffuse="lobe"))
    for transport in (lj.ENDF(), lj.WeidlichWilkie(), lj.RandomWalk(orders="first")):
        with pytest.raises(ValueError, match=r"layers\[0\].alpha: .* carries no smooth Interface .*AddingDoubling"):
            lj.evaluate(STACKS["varnish"], wi, wi, transport)
    for transport in (lj.SingleScattering(), lj.SpongeCake()):
        with pytest.raises(ValueError, match=r"base.alpha: .* carries no smooth Conductor"):
            lj.evaluate(STACKS["haze on a mirror"], wi, wi, transport)
    assert np.all(np.asarray(lj.evaluate(STACKS["varnish"], wi, wi)) > 0.0)
    assert isinstance(lj.choose_transport(lj.Stack([], lj.Conductor(*METAL)), wi, wi), lj.AddingDoubling)


def test_maps_of_smooth_stacks():
    ior = np.array([1.3, 1.5, 1.8])
    wi, wo = lj.direction(0.4, 0.0), lj.direction(0.7, 2.0)
    single = [lj.Stack([lj.Interface(n)], lj.Lambertian(0.5)) for n in ior]
    many = lj.Stack([lj.Interface(ior)], lj.Lambertian(0.5))
    for call in (
        lambda stack: lj.evaluate(stack, wi, wo, SOLVER),
        lambda stack: lj.specular(stack, wi)[0],
        lambda stack: lj.albedo(stack, wi, SOLVER)[0],
    ):
        np.testing.assert_allclose(call(many), np.stack([call(stack) for stack in single]), rtol=1e-6)
    assert lj.sample(many, wi, jax.random.key(0), SOLVER)[0].shape == (3, 3)


@pytest.mark.slow
def test_a_narrow_interface_tends_to_a_smooth_one():
    """The energy that a narrow one reflects and transmits is that of both parts of a smooth one."""
    wi = lj.direction(jnp.asarray(ANGLES[:3]), 0.0)
    parts = []
    for alpha in (None, 1e-3):
        stack = lj.Stack([lj.Interface(1.5, alpha), HAZE, lj.Interface(1.0, alpha)])
        energies = lj.albedo(stack, wi, lj.AddingDoubling(nodes=16, modes=1))
        parts.append([a + b for a, b in zip(energies, lj.specular(stack, wi), strict=True)])
    np.testing.assert_allclose(parts[0], parts[1], atol=2e-3)


def test_mirrors_between_layers_are_all_turns():
    """Layers with diagonals, added, beside the dense operators that they stand for."""
    random = np.random.default_rng(0)
    size = 5

    def operator():
        return jnp.asarray(0.04 * random.random((1, 2, size, size)))

    def layer():
        operators = [Parts(operator(), operator()) for _ in range(4)]
        diagonals = [jnp.asarray(0.3 * random.random((1, 1, size))) for _ in range(4)]
        return Layer(*operators, *diagonals)

    def dense(parts, diagonal):
        return np.asarray(parts.total) + np.asarray(diagonal)[..., None] * np.eye(size)

    def whole(layer):
        return (
            dense(layer.reflect_top, layer.mirror_top),
            dense(layer.reflect_bottom, layer.mirror_bottom),
            dense(layer.transmit_down, layer.direct_down),
            dense(layer.transmit_up, layer.direct_up),
        )

    upper, lower = layer(), layer()
    (top_u, bottom_u, down_u, up_u), (top_l, bottom_l, down_l, up_l) = whole(upper), whole(lower)
    falling = np.linalg.solve(np.eye(size) - bottom_u @ top_l, down_u)
    rising = np.linalg.solve(np.eye(size) - top_l @ bottom_u, up_l)
    expected = (
        top_u + up_u @ top_l @ falling,
        bottom_l + down_l @ bottom_u @ rising,
        down_l @ falling,
        up_u @ rising,
    )
    added = add(upper, lower)
    for found, true in zip(whole(added), expected, strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-12)
    # one event and no mirror: the diagonals that pass, alone
    passed = [np.asarray(diagonal)[..., None, :] for diagonal in (upper.direct_down, upper.direct_up)]
    once = (
        np.asarray(upper.reflect_top.first)
        + np.swapaxes(passed[1], -1, -2) * np.asarray(lower.reflect_top.first) * passed[0]
    )
    np.testing.assert_allclose(added.reflect_top.first, once, rtol=1e-12)
