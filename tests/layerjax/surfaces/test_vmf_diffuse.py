"""VMF Diffuse against numbers computed elsewhere: the cross-section by quadrature to 11 digits, the model by an own
transcription of the paper, energies by quadrature; and over its whole box."""

from functools import partial
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.surfaces.vmf_diffuse.coefficients import first_order, second_order, third_order
from layerjax.surfaces.vmf_diffuse.flakes import concentration
from layerjax.surfaces.vmf_diffuse.paper import scattering_orders
from tests.helpers.cases import haze
from tests.helpers.derivatives import with_slopes
from tests.helpers.sampling import DRAWS, SIGNIFICANCE, chi_square

POINTS = 8_000


def alone(albedo, roughness, form="paper"):
    return lj.Stack([], lj.VMFDiffuse(albedo, roughness, form))


def along(cosine, phi=0.0):
    return lj.direction(jnp.arccos(jnp.asarray(cosine)), phi)


def test_roughness_to_concentration():
    alpha = np.array([0.25, 0.9])
    np.testing.assert_allclose(concentration((1 - jnp.exp(-alpha)) ** 2), 2 / alpha**2, rtol=1e-13)
    np.testing.assert_array_equal(concentration(jnp.array([1.0])), [0.0])
    assert concentration(jnp.array(0.0)) == concentration(jnp.array(1e-8))


def test_coefficients():
    (c100, c101, _, c103), (_, _, c112), (c120, c121) = first_order(jnp.asarray(0.5))
    (_, (_, c211, _)), ((*_, c304), (c310, _, _)) = second_order(jnp.asarray(0.5)), third_order(jnp.asarray(0.5))
    found = [c100, c101, c103, c112, c120, c121, c211, c304, c310]
    expected = [1.00117647, 0.82978858, -0.19555556, 0.54375, 0.17142857, -0.03379269, -0.00515841, -0.03126143]
    np.testing.assert_allclose(found, [*expected, 0.00201293], atol=5e-9)


# r, u_i, u_o, phi; f1, f2, f3; the "paper" form at albedo 0.5, 0.9, 1; the "literal" one at 0.9
VALUES = [
    (0.1, 0.8, 0.6, 0.0, 0.3219946, 0.0181567, 0.0020452, 0.1657921, 0.3059929, 0.3421964, 0.3059929),
    (0.1, 0.15, 0.2, 2.5, 0.1172087, 0.0299191, 0.0014321, 0.0662631, 0.1307663, 0.1485599, 0.1307663),
    (0.3, 0.3, 0.9, 0.7, 0.2670630, 0.0428236, 0.0208714, 0.1473867, 0.3003085, 0.3554219, 0.3003054),
    (0.5, 0.8, 0.6, 0.0, 0.2384345, 0.0319105, 0.0387882, 0.1333941, 0.2983424, 0.3841354, 0.2983646),
    (0.5, 0.8, 0.6, pi / 2, 0.1677089, 0.0468407, 0.0343760, 0.1012123, 0.2435664, 0.3239279, 0.2435886),
    (0.5, 0.8, 0.6, pi, 0.1061300, 0.0617710, 0.0299639, 0.0736039, 0.1970224, 0.2728671, 0.1970446),
    (0.7, 0.8, 0.6, pi, 0.0746939, 0.0531235, 0.0277454, 0.0554596, 0.1719955, 0.2665110, 0.1721760),
    (1.0, 1.0, 1.0, 0.0, 0.1012273, 0.0105620, 0.0223447, 0.0566093, 0.1683597, 0.2925088, 0.1700054),
    (1.0, 0.3, 0.9, 0.7, 0.1180956, 0.0255769, 0.0263490, 0.0692449, 0.1937004, 0.3135230, 0.1951950),
]


def test_values_against_a_transcription():
    r, ui, uo, phi, *columns = np.array(VALUES).T
    wi, wo = along(ui, 0.3 + phi), along(uo, 0.3)

    @jax.jit
    @jax.vmap
    def found(r, wi, wo):
        values = lj.evaluate(alone([0.5, 0.9, 1.0], r), wi, wo)
        literal = lj.evaluate(alone(0.9, r, "literal"), wi, wo)
        return jnp.concatenate([jnp.stack(scattering_orders(split(wi), split(wo), r)), values, literal])

    np.testing.assert_allclose(found(r, wi, wo), np.array(columns).T, rtol=1e-5, atol=5.1e-8)  # 7 digits are printed


# r, c; four and more orders together: "paper", "literal"
HIGHER_ORDERS = [
    (0.5, 0.9, 0.02962727, 0.02964948),
    (1.0, 0.9, 0.04986369, 0.05143078),
    (0.5, 1.0, 0.07500224, 0.07497449),
]


def test_higher_orders():
    r, c, *columns = np.array(HIGHER_ORDERS).T
    wi, wo = along(0.6), along(0.8, 2.0)

    @jax.jit
    @jax.vmap
    def found(r, c):
        f1, f2, f3 = scattering_orders(split(wi), split(wo), r)
        less = c * (f1 + c * (f2 + c * f3))
        return jnp.stack([lj.evaluate(alone(c, r, form), wi, wo)[0] - less for form in ("paper", "literal")])

    np.testing.assert_allclose(found(r, c), np.array(columns).T, atol=1e-8)


# r, c; directional albedo at cosines 1, 0.5, 0.2
ENERGIES = [
    (0.1, 0.5, 0.47820, 0.48058, 0.47742),
    (0.3, 0.9, 0.87608, 0.87022, 0.85169),
    (0.5, 0.5, 0.32371, 0.32524, 0.33707),
    (0.5, 0.9, 0.76813, 0.77702, 0.78957),
    (0.7, 0.9, 0.66277, 0.69336, 0.73168),
    (1.0, 0.9, 0.51691, 0.57944, 0.64495),
    (0.1, 1.0, 0.99113, 0.99732, 0.99118),
    (0.3, 1.0, 1.05773, 1.04060, 1.00152),
    (0.5, 1.0, 1.02209, 1.02228, 1.01787),
    (1.0, 1.0, 0.89848, 0.95894, 1.01409),
]


def test_directional_albedo():
    r, c, *expected = np.array(ENERGIES).T
    rough = np.array([1e-3, 0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95])
    white, grey = (np.full(len(rough), albedo) for albedo in (1.0, 0.95))
    wi = along([1.0, 0.5, 0.2, 1e-3])
    run = jax.jit(jax.vmap(lambda r, c: lj.albedo(alone(c, r), wi)[0][:, 0]))
    found = run(np.concatenate([r, rough, rough]), np.concatenate([c, white, grey]))
    np.testing.assert_allclose(found[: len(r), :3], np.array(expected).T, atol=1e-5)
    # beyond those: what the fit makes of white flakes, and that darker ones lose light
    whites = np.concatenate([found[len(r) : len(r) + len(rough)], found[: len(r)][c == 1]])
    assert ((whites > 0.89) & (whites < 1.15)).all()
    assert (found[len(r) + len(rough) :] < 1).all()


@pytest.mark.parametrize(("form", "dtype"), [("paper", jnp.float64), ("literal", jnp.float32)])
def test_no_roughness_is_lambertian(form, dtype):
    wi, wo = (lj.direction(theta, 0.4).astype(dtype) for theta in (1.5, 0.2))
    value = lj.evaluate(alone([0.2, 1.0], 0.0, form), wi, wo)
    np.testing.assert_allclose(value, np.array([0.2, 1.0]) / np.pi, rtol=2 * jnp.finfo(dtype).eps)


def test_approach_to_full_roughness():
    # from 0.1104 to 0.1012 between r = 0.99 and 1: the logarithm of 1 - r
    r = jnp.array([0.99, 0.999, 0.9999, 1 - 1e-6, 1.0])
    up = tuple(jnp.full(5, x) for x in (0.0, 0.0, 1.0))
    f1, _, _ = jax.jit(jax.vmap(scattering_orders))(up, up, r)
    np.testing.assert_allclose(f1, [0.110439, 0.105899, 0.103995, 0.102514, 0.101227], atol=5e-7)


def draw(seed):
    """Parameters and directions over the box, close to a half of them on edges."""
    random = np.random.default_rng(seed)

    def mixed(values, *edges):
        return np.where(random.random(POINTS) < 0.4, random.choice(edges, POINTS), values)

    r = np.where(random.random(POINTS) < 0.3, 10.0 ** random.uniform(-9, 0, POINTS), random.random(POINTS))
    r = mixed(r, 0.0, 1.0, 1e-30, 1e-12, 1e-8, 1e-4, 0.0901, 1 - 1e-7, 1 - 1e-16)
    albedo = mixed(random.random(POINTS), 0.0, 1.0, 1e-8, 0.342, 1 - 1e-7, 1 - 1e-16)

    def anywhere():
        cosine = mixed(random.uniform(2e-9, 1.0, POINTS), 1.0, 1e-6, 1e-4, 2e-9)
        sine, phi = np.sqrt((1 - cosine) * (1 + cosine)), random.uniform(-np.pi, np.pi, POINTS)
        return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)

    wi, wo = anywhere(), anywhere()
    wo[::7], wo[1::7] = wi[::7], wi[1::7] * [-1, -1, 1]
    return {"albedo": albedo, "roughness": r}, wi, wo


def value(parameters, wi, wo, form="paper"):
    return lj.evaluate(alone(parameters["albedo"], parameters["roughness"], form), wi, wo)[0]


@pytest.mark.parametrize(
    ("dtype", "mode"),
    [
        (np.float32, "reverse"),
        *(pytest.param(*how, marks=pytest.mark.slow) for how in ((np.float64, "reverse"), (np.float32, "forward"))),
    ],
)
def test_values_and_gradients_are_finite(dtype, mode):
    where = jax.tree.map(lambda x: x.astype(dtype), draw(3))
    found, gradients = jax.jit(jax.vmap(with_slopes(value, (0, 1, 2), mode)))(*where)
    assert found.dtype == dtype
    for leaf in (found, *jax.tree.leaves(gradients)):
        assert np.isfinite(leaf).all()
    assert (found >= 0).all()
    visible = (where[0]["albedo"] > 0) & (where[1][:, 2] > 1e-3) & (where[2][:, 2] > 1e-3)
    assert (found[visible] > 0).mean() > 0.99


def test_reciprocity_and_single_precision():
    parameters, wi, wo = jax.tree.map(lambda x: x.astype(np.float32), draw(4))
    run = jax.jit(jax.vmap(value))
    single = run(parameters, wi, wo)
    parameters, wi, wo = jax.tree.map(lambda x: x.astype(np.float64), (parameters, wi, wo))
    forward, backward = run(parameters, wi, wo), run(parameters, wo, wi)
    np.testing.assert_allclose(forward, backward, rtol=1e-13)
    tame = (parameters["roughness"] < 0.999) & (np.minimum(wi[:, 2], wo[:, 2]) > 1e-5)
    # near grazing an order is the small difference of its azimuthal modes
    np.testing.assert_allclose(single[tame], forward[tame], rtol=5e-5, atol=5e-7)


@pytest.mark.slow
def test_gradients_against_differences():
    x = jnp.array([0.7, 0.35, 0.6, 1.1, 0.8])

    def f(x):
        return value({"albedo": x[0], "roughness": x[1]}, lj.direction(x[2], 0.0), lj.direction(x[3], x[4]))

    step, run = 1e-5, jax.jit(jax.vmap(jax.value_and_grad(f)))
    values, gradients = run(jnp.concatenate([x + step * jnp.eye(5), x - step * jnp.eye(5), x[None]]))
    np.testing.assert_allclose(gradients[-1], (values[:5] - values[5:10]) / (2 * step), rtol=1e-6, atol=1e-9)


def test_weights_of_samples_are_bounded():
    parameters, wi, _ = draw(5)
    keys = jax.random.split(jax.random.key(1), POINTS)
    draws = jax.jit(jax.vmap(lambda p, wi, key: lj.sample(alone(p["albedo"], p["roughness"]), wi, key)))
    wo, density, weight = draws(parameters, wi, keys)
    assert np.isfinite(weight).all()
    assert (density > 0)[wo[:, 2] > 1e-9].all()
    assert (weight[:, 0] <= 2.0 * parameters["albedo"]).all()
    assert (weight > 0)[(parameters["albedo"] > 0) & (wi[:, 2] > 1e-3)].mean() > 0.95


@pytest.mark.slow
def test_samples_follow_their_density():
    stack, wi = alone(0.9, 0.6), lj.direction(1.2, 0.4)
    wo, _, weight = lj.sample(stack, jnp.broadcast_to(wi, (DRAWS, 3)), jax.random.key(7))

    def density(w):
        return jnp.where(w[..., 2] > 0, lj.pdf(stack, wi, w), 0.0)

    above = wo[:, 2] > 0
    probability, total = chi_square(wo[above], density)
    assert probability > SIGNIFICANCE
    np.testing.assert_allclose(total, np.mean(above), atol=4e-3)
    error = np.std(weight) / np.sqrt(DRAWS)
    np.testing.assert_allclose(np.mean(weight), lj.albedo(stack, wi)[0][0], atol=4.5 * error)


def printed_mapping(k, r):
    """Section 5 as printed, in float64."""
    s = 0.64985 + 0.631112 * r + 1.38922 * r**2
    root = np.sqrt(1 - 2 * k + k**2 + 4 * s**2 * k**2)
    return (-1 + k + root) / (2 * s * k) * np.sqrt(r) + (1 - np.sqrt(r)) * k


def test_diffuse_albedo_as_printed():
    for r in (0.0, 0.1, 0.5, 1.0):
        k = np.array([0.01, 0.3, 0.5, 0.9, 1.0])
        surface = lj.VMFDiffuse.from_diffuse_albedo(k, r, "literal")
        np.testing.assert_allclose(surface.albedo, printed_mapping(k, r), rtol=1e-12)
        assert (surface.roughness, surface.form) == (r, "literal")
    assert lj.VMFDiffuse.from_diffuse_albedo(0.0, 0.5).albedo == 0.0
    # in float32, where the printed form loses a quarter of the value
    small = lj.VMFDiffuse.from_diffuse_albedo(np.float32(1e-4), np.float32(1.0)).albedo
    assert small.dtype == jnp.float32
    np.testing.assert_allclose(small, printed_mapping(1e-4, 1.0), rtol=1e-6)


@pytest.mark.slow
def test_diffuse_albedo_comes_back_when_it_is_solved_for():
    def solved(k, r):
        return lj.VMFDiffuse.from_diffuse_albedo(jnp.stack([jnp.asarray(k), 0.8, 0.95]), r, exact=True)

    for r in (0.01, 0.2, 0.6):
        surface = solved(0.05, r)
        np.testing.assert_allclose(lj.albedo(lj.Stack([], surface), along(1.0))[0], [0.05, 0.8, 0.95], atol=1e-4)
    assert solved(0.05, 1.0).albedo[2] == 1.0  # it reflects 0.90 at most
    h = 1e-5
    gradient = jax.grad(lambda k, r: solved(k, r).albedo[0], (0, 1))(0.4, 0.35)
    ends = [(solved(0.4 + h, 0.35), solved(0.4 - h, 0.35)), (solved(0.4, 0.35 + h), solved(0.4, 0.35 - h))]
    expected = [(there.albedo[0] - back.albedo[0]) / (2 * h) for there, back in ends]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("message", "make"),
    [
        ("VMFDiffuse.albedo: 1.5 is outside [0, 1]", lambda: lj.VMFDiffuse(1.5, 0.5)),
        ("VMFDiffuse.roughness: -0.1 is outside [0, 1]", lambda: lj.VMFDiffuse(0.5, -0.1)),
        *(
            (f"VMFDiffuse.form: '{form}' is not one of 'paper', 'literal', 'all_orders'", partial(make, 0.5, 0.5, form))
            for form in ("fast", "transport")
            for make in (lj.VMFDiffuse, lj.VMFDiffuse.from_diffuse_albedo)
        ),
        ("VMFDiffuse.albedo: 2 is outside [0, 1]", lambda: lj.VMFDiffuse.from_diffuse_albedo(2.0, 0.5)),
    ],
)
def test_bad_input_is_refused_by_name(message, make):
    with pytest.raises(ValueError) as error:  # noqa: PT011  (the message is compared below, brackets and all)
        make()
    assert message in str(error.value)


def test_as_a_base_in_closed_form():
    stack, base = lj.Stack([haze(0.4, 0.6, 0.0)], lj.VMFDiffuse([0.9, 0.3], 0.5)), alone([0.9, 0.3], 0.5)
    wi, wo = along(0.8, 0.3), along(0.5, 2.0)
    expected = np.exp(-0.6 * (1 / 0.8 + 1 / 0.5)) * lj.evaluate(base, wi, wo)
    for transport in (lj.SingleScattering(), lj.SpongeCake(), lj.WeidlichWilkie()):
        np.testing.assert_allclose(lj.evaluate(stack, wi, wo, transport), expected, rtol=1e-10)


@pytest.mark.slow
def test_references_agree_on_it_as_a_base():
    stack = lj.Stack([haze(0.4, 0.5, 0.9)], lj.VMFDiffuse(0.8, 0.6))
    wi, wo = along([0.9, 0.4, 0.6]), along([0.7, 0.6, 0.2], jnp.array([0.1, 1.6, 3.0]))
    values = lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=16, modes=12))
    walked, errors = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=4096), key=jax.random.key(3))
    np.testing.assert_array_less(np.abs(values - walked), 4 * errors + 0.005 * walked)


@pytest.mark.slow
def test_statistics_use_its_own_albedo():
    # what a black base lacks is the light that has met the base; the mean albedo in place of its own errs by 3 %
    wi, solver = along([1.0, 0.7, 0.4, 0.15]), lj.AddingDoubling(nodes=16, modes=1)

    def met(transport):
        stacks = [lj.Stack([haze(0.5, 0.4, 0.9)], lj.VMFDiffuse(c, 0.8)) for c in ([0.95, 0.4], [0.0, 0.0])]
        whole, black = (lj.albedo(stack, wi, transport)[0] for stack in stacks)
        return whole - black

    # the base is taken for a product of two albedos: 1.2 % at most here
    np.testing.assert_allclose(met(lj.Statistical()), met(solver), rtol=0.015)
