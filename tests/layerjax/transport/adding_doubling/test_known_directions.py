"""Light followed along the directions asked for: against tables of a finer grid, and what is asked in odd ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.evaluate import evaluate_known
from layerjax.transport.known_directions import MOST_PAIRS, known_directions

SOLVER = lj.AddingDoubling(nodes=8, modes=10)
FINE = lj.AddingDoubling(nodes=24, modes=24)
HAZE = lj.Medium(0.5, [0.9, 0.5], lj.HenyeyGreenstein(0.6))
STACKS = {
    "paint": lj.Stack([lj.Interface(1.5, 0.2), lj.Medium(1.0, 0.95, lj.HenyeyGreenstein(0.5))], lj.Lambertian(0.6)),
    "metal": lj.Stack([lj.Interface(1.5, 0.3), HAZE], lj.Conductor(0.2, 3.9, 0.4)),
    "below 1": lj.Stack([lj.Interface(0.75, 0.3)], lj.Lambertian(0.8)),
    "vmf": lj.Stack([lj.Interface(1.5, 0.3, "vmf")], lj.OrenNayar(0.5, 0.4)),
    "slab": lj.Stack([lj.Interface(1.5, 0.7), HAZE, lj.Interface(1.2, 0.8)]),
}


def pairs(stack):
    """Both sides where light passes, in and out of the plane, azimuths turned, and the pole."""
    sides = (0.0,) if stack.base is not None else (0.0, np.pi)
    theta_i = np.abs(np.radians([[side] for side in np.degrees(sides)]) - np.radians([0.0, 30.0, 65.0])).ravel()
    theta_o = np.abs(np.array([[side] for side in sides]) - np.radians([10.0, 30.0, 70.0])).ravel()
    i, o, phi = (part.ravel() for part in np.meshgrid(theta_i, theta_o, [0.0, 1.0, 2.9], indexing="ij"))
    return np.asarray(lj.direction(i, 0.4 + 0.0 * i)), np.asarray(lj.direction(o, phi))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paint", "below 1", "metal", "vmf"])
def test_agrees_with_tables_of_a_finer_grid(name):
    stack = STACKS[name]
    wi, wo = pairs(stack)
    followed = np.asarray(lj.evaluate(stack, wi, wo, SOLVER))
    tables = np.asarray(lj.evaluate(lj.prepare(stack, FINE), wi, wo))
    np.testing.assert_array_less(np.abs(followed - tables), 4e-3 * (tables + 0.1 * tables.mean()))


def test_multiple_scattering_on_facets_agrees_with_tables():
    """Tables of 12 nodes differ from those of 24 by 7e-6."""
    stack = lj.Stack([lj.Interface(1.5, 0.5)], lj.Lambertian(0.5))
    solver = lj.AddingDoubling(nodes=12, modes=8, facet_multiple_scattering=True)
    wi, wo = lj.direction([0.5, 0.9], [0.0, 0.3]), lj.direction([0.4, 0.7], [2.0, 1.0])
    followed, tables = lj.evaluate(stack, wi, wo, solver), lj.evaluate(lj.prepare(stack, solver), wi, wo)
    np.testing.assert_allclose(followed, tables, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("medium", [lj.Medium(50.0, 0.5, lj.HenyeyGreenstein(0.2)), HAZE])
def test_what_leaves_a_medium_below_does_not_come_back(medium):
    """An open medium under an interface, seen from above alone, is followed too: against tables."""
    wi, wo = pairs(STACKS["paint"])

    def stack(ior, alpha):
        return lj.Stack([lj.Interface(ior, alpha), medium])

    tables = np.asarray(lj.evaluate(lj.prepare(stack(1.3, 0.3), FINE), wi, wo))
    followed = np.asarray(lj.evaluate(stack(1.3, 0.3), wi, wo, SOLVER))
    np.testing.assert_array_less(np.abs(followed - tables), 4e-3 * (tables + 0.1 * tables.mean()))
    run = jax.jit(jax.vmap(lambda x: lj.evaluate(stack(*x), wi, wo, SOLVER)[:, 0]))
    t = np.linspace(-1.0, 1.0, 41)
    for step in (np.array([0.02, 0.0]), np.array([0.0, 0.02])):
        found = np.asarray(run(np.array([1.3, 0.3]) + t[:, None] * step))
        rough = found - np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, found, 5)).T
        assert np.abs(rough / found).max() < 1e-5  # a hundredth of the error of these tables


@pytest.mark.slow
def test_agrees_with_the_walk_through_a_slab():
    """Where light that passes both interfaces straight is narrower than the grid: tables are off by 2 % there."""
    stack = STACKS["slab"]
    wi, wo = (w[::9] for w in pairs(stack))
    followed = lj.evaluate(stack, wi, wo, SOLVER)
    walked, error = lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=1 << 14), key=jax.random.key(1))
    np.testing.assert_array_less(np.abs(followed - walked), 4.5 * error + 0.01 * (walked + 0.1 * walked.mean()))


@pytest.mark.slow
def test_traced_directions_that_are_known():
    """The same values inside a program that takes the directions as arguments."""
    stack = STACKS["paint"]
    wi, wo = pairs(stack)
    known = known_directions(wi, wo)
    traced = jax.jit(lambda wi, wo, known: evaluate_known(stack, wi, wo, SOLVER, known=known))(wi, wo, known)
    np.testing.assert_allclose(traced, lj.evaluate(stack, wi, wo, SOLVER), rtol=1e-10)


def test_directions_that_others_are_known_of_are_refused():
    wi, wo = pairs(STACKS["paint"])
    with pytest.raises(ValueError, match=r"known: it is of directions of shapes \(2,\) and \(2,\), wi and wo have"):
        evaluate_known(STACKS["paint"], wi, wo, SOLVER, known=known_directions(wi[:2], wo[:2]))


@pytest.mark.slow
def test_shapes_and_directions_without_light():
    stack = lj.Stack([lj.Interface(1.5, 0.7)])
    wi, wo = (w[::5].copy() for w in pairs(stack))
    wo[0] = [1.0, 0.0, 0.0]
    every = lj.evaluate(stack, wi[:, None], wo, SOLVER)
    assert every.shape == (len(wi), len(wo), 1)
    assert np.all(every[:, 0] == 0)
    np.testing.assert_allclose(every[2, 3], lj.evaluate(stack, wi[2], wo[3], SOLVER), rtol=1e-10)
    sides = {side: lj.evaluate(stack, wi[:, None], wo, SOLVER, side=side) for side in ("reflection", "transmission")}
    above, crosses = (wi[:, None, 2] > 0) & (wo[:, 2] > 0), wi[:, None, 2] * wo[:, 2] < 0
    np.testing.assert_allclose(sides["reflection"], np.where(above[..., None], every, 0.0), rtol=1e-10)
    np.testing.assert_allclose(sides["transmission"], np.where(crosses[..., None], every, 0.0), rtol=1e-10)
    assert lj.evaluate(stack, wi[:0], wo[:0], SOLVER).shape == (0, 1)


@pytest.mark.slow
def test_reciprocity_through_a_slab():
    stack = STACKS["slab"]
    wi, wo = pairs(stack)
    index = np.array([[1.0, 1.2][int(z < 0)] for z in np.concatenate([wi, wo])[:, 2]]).reshape(2, -1, 1) ** 2
    there, back = lj.evaluate(stack, wi, wo, SOLVER), lj.evaluate(stack, wo, wi, SOLVER)
    np.testing.assert_allclose(there / index[1], back / index[0], rtol=1e-7)


def test_many_directions_are_not_looked_at():
    wi = np.asarray(lj.direction(np.full(3, 0.3), np.zeros(3)))
    assert known_directions(wi, wi) is not None
    assert known_directions(np.broadcast_to(wi[:1], (MOST_PAIRS + 1, 3)), wi[:1]) is None
    many = np.asarray(lj.direction(np.linspace(0.0, 1.5, 1000), np.zeros(1000)))
    assert known_directions(many, wi[:1]) is None
    assert jax.jit(lambda w: jnp.asarray(known_directions(w, w) is None))(wi)


@pytest.mark.slow
def test_derivatives_by_the_directions_of_a_map():
    """Those of light that is scattered more than once as well: against differences."""
    wi, wo = lj.direction([0.3, 0.9], 0.1), lj.direction([0.7, 0.2], 1.0)

    @jax.jit
    @jax.value_and_grad
    def total(wi):
        stack = lj.Stack([lj.Interface(1.5, 0.2)], lj.Lambertian(jnp.asarray([[0.5], [0.6]])))
        return lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=4, modes=3)).sum()

    slopes = total(wi)[1]
    for at in np.ndindex(2, 3):
        step = jnp.zeros_like(wi).at[at].set(1e-5)
        difference = (total(wi + step)[0] - total(wi - step)[0]) / 2e-5
        np.testing.assert_allclose(slopes[at], difference, rtol=1e-6, atol=1e-9)
    for edge in (0.0, np.pi / 2 - 1e-6, np.pi / 2):
        assert np.isfinite(total(lj.direction([0.3, edge], 0.1))[1]).all()


def vary(x):
    medium = lj.Medium(x[2], x[3], lj.HenyeyGreenstein(x[4]))
    return lj.Stack([lj.Interface(x[0], x[1]), medium], lj.Lambertian(x[5]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "reverse"),
    [(np.float64, False), (np.float64, True), (np.float32, True)],
)
def test_derivatives_of_all_parameters(dtype, reverse):
    """Forward and reverse, against differences; 2e-3 in single precision, where doubling replaces eigenvectors."""
    wi, wo = (w.astype(dtype) for w in pairs(STACKS["paint"]))
    x = np.array([1.5, 0.2, 1.0, 0.95, 0.5, 0.6], dtype)

    def values(x):
        return lj.evaluate(vary(x), wi, wo, lj.AddingDoubling(nodes=5, modes=5))[:, 0]

    @jax.jit
    def run(x):
        return jax.jacfwd(lambda x: (values(x),) * 2, has_aux=True)(x)[::-1]

    found, jacobian = run(x)
    assert found.dtype == dtype
    if reverse:
        weight = np.linspace(0.5, 1.5, len(wi)).astype(dtype)
        gradient = jax.jit(jax.grad(lambda x: values(x) @ weight))(x)
        np.testing.assert_allclose(gradient, weight @ jacobian, rtol=1e-8 if dtype == np.float64 else 1e-3)
    if dtype == np.float64:
        step = 1e-4 * np.eye(6)
        for k in range(6):
            difference = (run(x + step[k])[0] - run(x - step[k])[0]) / 2e-4
            size = np.abs(difference).max()
            np.testing.assert_allclose(jacobian[:, k], difference, atol=2e-6 * size)


@pytest.mark.slow
def test_values_are_smooth_in_every_parameter():
    """A thousandth of the box changes what is left of a straight line by less than a tenth of the error, 1e-3."""
    wi, wo = pairs(STACKS["paint"])
    run = jax.jit(jax.vmap(lambda x: lj.evaluate(vary(x), wi, wo, lj.AddingDoubling(nodes=5, modes=5))[:, 0]))
    box = np.array([[1.1, 2.5], [0.05, 0.8], [0.1, 4.0], [0.5, 1.0], [-0.5, 0.8], [0.1, 0.9]])
    middle = np.array([1.5, 0.2, 1.0, 0.9, 0.5, 0.6])
    for k, (low, high) in enumerate(box):
        x = np.tile(middle, (9, 1))
        x[:, k] += np.linspace(-1e-3, 1e-3, 9) * (high - low)
        found = np.asarray(run(x)) / np.asarray(run(x)).mean(axis=0)
        t = np.linspace(-1, 1, 9)
        rough = found - np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, found, 2)).T
        assert np.abs(rough).max() < 1e-4, k
