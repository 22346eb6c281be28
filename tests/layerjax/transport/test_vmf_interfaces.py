"""Interfaces and conductors with von Mises-Fisher normals: energies, transports, samplers, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.problem.stack_file import material_to_dict, stack_from_dict
from layerjax.directions import split
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from layerjax.transport.automatic import automatic
from tests.helpers.interfaces import integrated_energies, pairs
from tests.helpers.sampling import chi_square
from tests.helpers.vmf_walks import Face, coated_energies, mean_and_error

DRAWS = 200_000
STEP = 1e-5
MIRROR = (0.01, 20.0)  # of index 1 reflects 0.9999 of the light, under an index of 1.5 as much


def width(kappa):
    return (2.0 / kappa) ** 0.5


ALPHAS = [width(1e8), width(1e4), width(30.0), 1.0, width(1e-2)]


def face(ior, kappa):
    return lj.Interface(ior, width(kappa), distribution="vmf")


def metal(kappa, index=MIRROR):
    return lj.Conductor(*index, width(kappa), distribution="vmf")


@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_energies_of_an_interface(ior):
    for index, (theta, kappa) in enumerate([(0.0, 20.0), (0.6, 2.0), (1.2, 20.0), (1.2, 0.05), (1.5, 5.0)]):
        found = integrated_energies(lj.direction(theta, 0.4), jnp.asarray(ior), jnp.asarray(width(kappa)), "vmf", 200)
        facets = Face(kappa, np.random.default_rng(index))
        w = np.broadcast_to([np.sin(theta), 0.0, np.cos(theta)], (DRAWS, 3))
        truth = [mean_and_error(facets.reflects(w, ior)[1]), mean_and_error(facets.crosses(w, ior)[1])]
        for value, (mean, error) in zip(found, truth, strict=True):
            # wide normals end at the horizon with an edge, which the rule sees as 3e-3 of the energy
            assert abs(value - mean) < 4 * error + 2e-4 + (4e-3 * mean if kappa < 1 else 0.0)


def test_energies_of_a_conductor():
    """The quadrature of `lj.albedo`, from 0 to grazing light, against draws, and at half the points."""
    for kappa in (0.02, 3.0, 100.0, 1e4):
        theta = np.array([0.0, 0.7, 1.3, 1.55])
        wi = lj.direction(theta, 0.3)
        energy, _ = lj.albedo(lj.Stack([], metal(kappa)), wi, nodes=24)
        coarse, _ = lj.albedo(lj.Stack([], metal(kappa)), wi, nodes=12)
        np.testing.assert_allclose(energy, coarse, atol=6e-4)
        for index, angle in enumerate(theta):
            w = np.broadcast_to([np.sin(angle), 0.0, np.cos(angle)], (DRAWS, 3))
            mean, error = mean_and_error(Face(kappa, np.random.default_rng(index)).mirrors(w)[1])
            assert abs(energy[index, 0] - mean) < 4 * error + 3e-4  # the metal keeps 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(("kappa", "theta"), [(0.05, 0.7), (3.0, 0.7), (3.0, 1.5), (60.0, 1.5)])
def test_a_conductor_is_sampled_as_it_says(kappa, theta):
    stack, wi = lj.Stack([], metal(kappa)), lj.direction(theta, 0.4)
    wo, _, weight = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(11))
    above = wo[:, 2] > 0
    probability, total = chi_square(wo[above], lambda w: jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w), 0.0))
    assert probability > 1e-4
    np.testing.assert_allclose(total, np.mean(above), atol=5e-3)
    assert np.isfinite(weight).all()
    energy, _ = lj.albedo(stack, wi)
    assert abs(np.mean(weight) - energy[0]) < 4.5 * np.std(weight) / np.sqrt(DRAWS) + 3e-4


@pytest.mark.slow
@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_an_interface_is_sampled_as_it_says(ior):
    alpha, ior = jnp.asarray(width(4.0)), jnp.asarray(ior)
    direction = lj.direction(1.1, 0.3)
    wi = split(jnp.broadcast_to(direction, (DRAWS, 3)))
    wo, leaves = interface_sample(wi, ior, alpha, *jax.random.uniform(jax.random.key(2), (3, DRAWS)), "vmf")

    @jax.jit
    def values(wi, wo):
        above = wo[2] > 0
        upper, lower = (wo[0], wo[1], jnp.where(above, wo[2], 0.5)), (wo[0], wo[1], jnp.where(above, -0.5, wo[2]))
        reflected = interface_reflection(wi, upper, ior, alpha, "vmf")
        f = jnp.where(above, reflected, interface_transmission(wi, lower, ior, alpha, "vmf"))
        return f, interface_pdf(f, wi, wo, ior, alpha, "vmf")

    f, density = values(wi, wo)
    weight = jnp.where(leaves & (density > 0), f * jnp.abs(wo[2]) / jnp.where(density > 0, density, 1.0), 0.0)
    expected = integrated_energies(direction, ior, alpha, "vmf", 200)
    for side, value in zip((wo[2] > 0, wo[2] < 0), expected, strict=True):
        x = jnp.where(side, weight, 0.0)
        assert abs(x.mean() - value) < 4.5 * x.std() / np.sqrt(DRAWS) + 1e-4
    drawn = jnp.stack(wo, axis=-1)[leaves]
    probability, total = chi_square(drawn, lambda w: values(split(jnp.broadcast_to(direction, w.shape)), split(w))[1])
    assert probability > 1e-4
    np.testing.assert_allclose(total, np.mean(leaves), atol=5e-3)


def test_reciprocity():
    wi, wo, ior, alpha = pairs(np.random.default_rng(3), 20_000, ALPHAS)
    forth = interface_reflection(wi, wo, ior, alpha, "vmf")
    np.testing.assert_allclose(forth, interface_reflection(wo, wi, ior, alpha, "vmf"), rtol=1e-12)
    below, turned = (wo[0], wo[1], -wo[2]), (wi[0], wi[1], -wi[2])
    keep = np.abs(ior - 1) > 1e-3  # nearer to 1 the rounding of 1 / ior itself moves the lobe
    forth = interface_transmission(wi, below, ior, alpha, "vmf") / ior
    back = interface_transmission(wo, turned, 1 / ior, alpha, "vmf") * ior
    # exp(-kappa (1 - cos)) carries the rounding of its exponent, which is below 700
    rtol = 1e-12 / (np.abs(ior - 1) + 1e-3) + 1e-13 / alpha + 1e-9
    np.testing.assert_array_less((np.abs(forth - back) - rtol * forth)[keep], 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "what"),
    [
        (np.float32, "values"),
        (np.float64, "values"),
        (np.float32, "draws"),
    ],
)
def test_values_and_gradients_are_finite(dtype, what):
    """From both sides of the critical angle (ior < 1 is light from inside), kappa from 1e-2 to 1e8."""
    random = np.random.default_rng(8)
    wi, wo, ior, alpha = pairs(random, 10_000, ALPHAS, dtype)
    u = tuple(random.random((3, 10_000)).astype(dtype))

    def everything(wi, wo, ior, alpha, u):
        below = (wo[0], wo[1], -wo[2])
        reflected = interface_reflection(wi, wo, ior, alpha, "vmf")
        passed = interface_transmission(wi, below, ior, alpha, "vmf")
        base = lj.Conductor(0.2, 3.0, alpha, distribution="vmf")
        if what == "values":
            return jnp.stack([reflected, passed, *base.evaluate(wi, wo)])
        drawn, _ = interface_sample(wi, ior, alpha, *u, "vmf")
        densities = [interface_pdf(*each, ior, alpha, "vmf") for each in ((reflected, wi, wo), (passed, wi, below))]
        return jnp.stack([*densities, base.pdf(wi, wo), *drawn])

    def both(wi, wo, ior, alpha, u):
        values, back = jax.vjp(lambda *changed: everything(*changed, u), wi, wo, ior, alpha)
        return values, back(jnp.ones_like(values))

    values, slopes = jax.jit(jax.vmap(both))(wi, wo, ior, alpha, u)
    for leaf in jax.tree.leaves((values, slopes)):
        assert np.isfinite(leaf).all()
    assert (values[:, :3] >= 0).all()
    wide = (alpha > 0.5) & (wi[2] > 0.05) & (wo[2] > 0.05)
    assert (values[wide, 0] > 0).mean() > 0.6  # 0 where the index is 1


@pytest.mark.slow
def test_gradients_of_a_conductor_agree_with_differences():
    wi, wo = lj.direction(0.7, 0.2), lj.direction(0.5, 2.9)

    def value(alpha):
        return lj.evaluate(lj.Stack([], lj.Conductor(0.2, 3.0, alpha, distribution="vmf")), wi, wo)[0]

    def compared(alpha):
        return jax.grad(value)(alpha), (value(alpha + 1e-5) - value(alpha - 1e-5)) / 2e-5

    np.testing.assert_allclose(*jax.jit(jax.vmap(compared))(jnp.array([0.2, 1.0, 5.0])), rtol=1e-6)


REFUSED = {
    "layers[0].distribution: Statistical carries": ([face(1.5, 50.0)], lj.Lambertian(0.5), lj.Statistical()),
    "base.distribution: Statistical carries": ([lj.Interface(1.5, 0.1)], metal(50.0), lj.Statistical()),
    "layers[1].distribution: WeidlichWilkie carries": (
        [lj.Interface(1.5, 0.1), face(1.2, 50.0)],
        lj.Lambertian(0.5),
        lj.WeidlichWilkie(),
    ),
    "AddingDoubling(facet_multiple_scattering=True) carries": (
        [face(1.5, 5.0)],
        None,
        lj.AddingDoubling(facet_multiple_scattering=True),
    ),
    "RandomWalk(facet_multiple_scattering=True) carries": (
        [],
        metal(5.0),
        lj.RandomWalk(facet_multiple_scattering=True),
    ),
    "layers[0]: SpongeCake carries no Interface": ([face(1.5, 5.0)], None, lj.SpongeCake()),
}


@pytest.mark.parametrize("message", REFUSED)
def test_transports_without_vmf_name_the_layer_and_who_carries_it(message):
    layers, base, transport = REFUSED[message]
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the message is compared below, brackets and all)
        lj.prepare(lj.Stack(layers, base), transport)
    assert message in str(error.value)
    assert "AddingDoubling and RandomWalk" in str(error.value)


def test_widths_have_the_range_of_their_distribution():
    for make in (lambda *a: lj.Interface(1.5, *a), lambda *a: lj.Conductor(0.2, 3.0, *a)):
        assert float(make(15.0, "vmf").alpha) == 15.0
        with pytest.raises(ValueError, match=r"\.alpha: 2 is outside \[0\.0001, 1\]"):
            make(2.0)
        with pytest.raises(ValueError, match=r"\.alpha, vmf: 16 is outside \[0\.0001, 15\]"):
            make(16.0, "vmf")
        with pytest.raises(ValueError, match=r"\.distribution: 'gauss' is not one of 'ggx', 'beckmann', 'vmf'"):
            make(0.1, "gauss")


def test_automatic_takes_a_transport_that_carries_them():
    coated, bare = lj.Stack([face(1.5, 50.0)], lj.Lambertian(0.5)), lj.Stack([], metal(50.0))
    assert type(automatic(coated, coated)) is lj.AddingDoubling
    assert type(automatic(bare, bare)) is lj.SingleScattering


def test_files_say_which():
    stack = lj.Stack([face(1.5, 50.0), lj.Interface(1.2, 0.3)], metal(1e-2))
    tables = material_to_dict(stack)
    assert [layer["distribution"] for layer in tables["layers"]] == ["vmf", "ggx"]
    back = stack_from_dict(tables)
    assert back.layers[0].distribution == back.base.distribution == "vmf"
    assert float(back.base.alpha) == pytest.approx(width(1e-2))
    free = {"start": 2.0, "low": 0.1, "high": 14.0}
    layer = {"kind": "Interface", "ior": 1.5, "alpha": free, "distribution": "vmf"}
    assert stack_from_dict({"layers": [layer]}).layers[0].alpha == fits.Free(2.0, 0.1, 14.0)
    with pytest.raises(ValueError, match=r"layers\[0\]\.alpha\.start is 2.0, must be a number in \[0\.0001, 1\]"):
        stack_from_dict({"layers": [layer | {"distribution": "ggx"}]})


def test_one_bounce_energies_of_the_walk_in_numpy():
    """Guo et al. 2015's one-bounce energy without masking, by a walk of 8e6 paths of another program."""
    known = [(1.5, 1e4, 1e3, 60, 0.773319), (1.5, 100.0, 100.0, 30, 0.847674), (1.5, 1e3, 30.0, 0, 0.780035)]
    for eta, top, base, degrees, expected in [*known, (2.0, 1e4, 10.0, 45, 0.216190)]:
        mean, error = coated_energies(np.deg2rad(degrees), eta, top, base, 1, DRAWS, 1, masked=False)[1]
        assert abs(mean - expected) < 4 * error + 4e-4


COPPER = 0.2 + 3.9j  # dark enough for what is trapped under the interface to die out in few bounces
CASES = [(1.5, 100.0, 100.0, 30), (2.0, 1e4, 10.0, 45), (1.5, 3.0, 2.0, 75), (1.5, 30.0, None, 20)]


@pytest.mark.slow
@pytest.mark.parametrize(("eta", "top", "base", "degrees"), CASES)
def test_both_references_have_the_energy_of_the_walk_in_numpy(eta, top, base, degrees):
    theta, paths, coarse = np.deg2rad(degrees), 50_000, (eta, top, base, degrees) == CASES[0]
    parts = coated_energies(theta, eta, top, base, 40, DRAWS // 2, 1, COPPER)
    truth, error = sum(mean for mean, _ in parts), sum(e * e for _, e in parts) ** 0.5
    stack = lj.Stack([face(eta, top)], lj.Lambertian(1.0) if base is None else metal(base, (0.2, 3.9)))
    wi = lj.direction(theta, 0.3)
    walked, _ = lj.albedo(stack, wi, lj.RandomWalk(paths=paths), key=jax.random.key(1))
    # what a path carries differs from the mean by less than 1, rms
    assert abs(walked[0] - truth) < 4 * np.hypot(error, 1.0 / np.sqrt(paths))
    solved, _ = lj.albedo(stack, wi, lj.AddingDoubling(nodes=16, modes=16) if coarse else lj.AddingDoubling())
    assert abs(solved[0] - truth) < 4 * error + 1e-3


STACKS = {
    "both distributions": lj.Stack([lj.Interface(1.4, 0.2), lj.Medium(0.3, 0.9), face(1.7, 20.0)], lj.Lambertian(0.5)),
    "slab": lj.Stack([face(1.5, 50.0), lj.Medium(0.3, 0.9), face(1.0, 10.0)]),
    "less inside": lj.Stack([face(0.6, 50.0)], metal(10.0, (0.2, 3.9))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STACKS)
def test_walk_and_solver_agree(name):
    """Values at pairs on both sides where light passes; the solver's own error is 1 % at its default resolution."""
    stack, sides = STACKS[name], (0.0, np.pi) if STACKS[name].base is None else (0.0,)
    wi = lj.direction(jnp.array([0.2, 0.9, 1.35]), 0.3)
    for side in sides:
        wo = lj.direction(jnp.abs(side - jnp.array([0.5, 1.1, 0.8])), 2.8)
        solved = lj.evaluate(stack, wi, wo, lj.AddingDoubling())
        walked, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=100_000), key=jax.random.key(3))
        np.testing.assert_array_less(np.abs(solved - walked), 4 * error + 0.01 * walked)


@pytest.mark.slow
def test_references_are_finite_over_the_box():
    """kappa from 1e-2 to 1e8 above and below, light that is refracted to either side of the critical angle."""
    dtype = np.float32
    wi = lj.direction(jnp.array([0.0, 0.6, 1.2, 1.56, 2.0, 3.1]), 0.3).astype(dtype)
    wo = lj.direction(jnp.array([0.0, 1.1, 1.57, 2.5]), 2.0).astype(dtype)[:, None]

    def values(ior, alpha, transport, key=None):
        stack = lj.Stack([lj.Interface(ior, alpha[0], "vmf"), lj.Interface(1.2, alpha[1], "vmf")])
        over_metal = lj.Stack([lj.Interface(ior, alpha[0], "vmf")], lj.Conductor(0.2, 3.0, alpha[1], "vmf"))
        both = [lj.evaluate(each, wi, wo, transport, key=key) for each in (stack, over_metal)]
        return both[0] + both[1]

    solver = lj.AddingDoubling(nodes=4, modes=4)
    slopes = jax.jit(jax.jacfwd(lambda ior, alpha: values(ior, alpha, solver), (0, 1)))
    walk = jax.jit(lambda ior, alpha: values(ior, alpha, lj.RandomWalk(paths=200, batch_size=200), jax.random.key(2)))
    for ior in (0.25, 1.5, 4.0):
        for kappas in ((1e-2, 1e8), (1e8, 1e8), (1e8, 1e-2), (5.0, 1e-2)):
            given = jnp.asarray(ior, dtype), jnp.sqrt(2.0 / jnp.asarray(kappas, dtype))
            for leaf in (*slopes(*given), walk(*given)):
                assert np.isfinite(leaf).all(), (ior, kappas)


@pytest.mark.slow
def test_reverse_mode_of_a_varnish():
    """Against central differences of the same resolution."""
    transport = lj.AddingDoubling(nodes=4, modes=4)

    @jax.jit
    def both(x, wi, wo):
        def value(x):
            stack = lj.Stack([lj.Interface(x[0], x[1], "vmf")], lj.Lambertian(0.5))
            return lj.evaluate(stack, wi, wo, transport)[0]

        return jax.value_and_grad(value)(x)

    x, steps = np.array([1.5, 0.3]), STEP * np.eye(2)
    pair = lj.direction(0.5, 0.2), lj.direction(0.7, 2.0)  # given, not known: XLA folds what is known, at length
    (above, below), (_, slope) = (
        ([both(x + sign * step, *pair)[0] for step in steps] for sign in (1, -1)),
        both(x, *pair),
    )
    np.testing.assert_allclose(slope, (np.array(above) - below) / (2 * STEP), rtol=1e-4)


@pytest.mark.slow
def test_slopes_of_a_coat_are_those_of_a_fine_resolution():
    """At the resolution that is chosen for it: values to 1e-3, slopes by width and index to 1 %, and equal to
    differences."""
    wi, wo = lj.direction(np.deg2rad(20.0), 0.0), lj.direction(np.deg2rad([3.0, 25.0, 50.0, 60.0, 75.0]), np.pi)

    def program(nodes, modes):
        def values(alpha, ior):
            stack = lj.Stack([lj.Interface(ior, alpha, "vmf")], lj.Lambertian(0.5))
            found = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=nodes, modes=modes))[:, 0]
            return found, found

        return jax.jit(lambda *given: jax.jacfwd(values, (0, 1), has_aux=True)(*given))

    coarse, fine = program(6, 8), program(24, 32)
    for alpha in (0.1, 0.3, 1.0):
        for ior in (1.2, 1.5):
            slopes, found = coarse(alpha, ior)
            expected_slopes, expected = fine(alpha, ior)
            np.testing.assert_allclose(found, expected, rtol=1e-3)
            scale = np.max(np.abs(found))
            for slope, fine_slope, apart in zip(slopes, expected_slopes, STEP * np.eye(2), strict=True):
                ahead, back = (coarse(alpha + sign * apart[0], ior + sign * apart[1])[1] for sign in (1, -1))
                np.testing.assert_allclose(slope, (ahead - back) / (2 * STEP), rtol=0, atol=1e-4 * scale)
                np.testing.assert_allclose(slope, fine_slope, rtol=0, atol=0.01 * scale / max(alpha, 0.1))
