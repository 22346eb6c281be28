"""The public calls: shapes, types, chunks, preparation, compilation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax._batching import CHUNK_BYTES
from tests.helpers.cases import tilt3

SINGLE = lj.SingleScattering()

STACK = lj.Stack(tilt3(), lj.Lambertian([0.2, 0.5, 0.8]))


OPEN = lj.Stack(tilt3())


class Unevaluated(lj.SingleScattering):
    """Says when it is asked for values. resolutions: whether it has another one."""

    resolutions: bool = eqx.field(static=True, default=False)

    def coarser(self):
        return self if self.resolutions else None

    def evaluate_batch(self, *_):
        raise AssertionError("evaluated")


def directions(count, seed, dtype=np.float64):
    w = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(w / np.linalg.norm(w, axis=1, keepdims=True), dtype)


def test_shapes_broadcast_and_end_in_channels():
    wi, wo = directions(4, 0)[:, None], directions(5, 1)[None]
    assert lj.evaluate(STACK, wi, wo, SINGLE).shape == (4, 5, 3)
    assert lj.evaluate(OPEN, wi, wo, SINGLE).shape == (4, 5, 1)
    assert lj.evaluate(OPEN, wi[0, 0], wo[0, 0], SINGLE).shape == (1,)
    assert lj.pdf(STACK, wi, wo, SINGLE).shape == (4, 5)
    wo, density, weight = lj.sample(STACK, wi, jax.random.key(0), SINGLE)
    assert (wo.shape, density.shape, weight.shape) == ((4, 1, 3), (4, 1), (4, 1, 3))
    reflected, transmitted = lj.albedo(STACK, wi, SINGLE, nodes=4)
    assert reflected.shape == transmitted.shape == (4, 1, 3)
    assert lj.unscattered(OPEN, wi).shape == (4, 1, 1)


def test_an_empty_stack_is_nothing_at_all():
    empty = lj.Stack([])
    wi = directions(3, 0)
    assert (lj.evaluate(empty, wi, wi, SINGLE) == 0).all()
    assert (lj.unscattered(empty, wi) == 1).all()
    assert (lj.sample(empty, wi, jax.random.key(0), SINGLE)[2] == 0).all()
    assert all((share == 0).all() for share in lj.albedo(empty, wi, SINGLE))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_large_batches_run_in_chunks_with_the_same_result(dtype):
    chunk = CHUNK_BYTES // np.dtype(dtype).itemsize
    part = (2 * chunk + chunk // 3) // 14 * 2
    count = 7 * part  # two whole chunks and a rest
    wi, wo = directions(count, 2, dtype), directions(count, 3, dtype)
    whole = lj.evaluate(STACK, wi, wo, SINGLE)
    parts = [lj.evaluate(STACK, wi[i : i + part], wo[i : i + part], SINGLE) for i in range(0, count, part)]
    np.testing.assert_allclose(whole, np.concatenate(parts), rtol=50 * np.finfo(dtype).eps, atol=1e-30)
    assert whole.dtype == dtype

    def loss(stack, wi, wo):
        return jnp.sum(lj.evaluate(stack, wi, wo, SINGLE) ** 2)

    together = jax.grad(loss)(STACK, wi, wo)
    half = count // 2
    apart = [jax.grad(loss)(STACK, wi[part], wo[part]) for part in (slice(half), slice(half, None))]
    for a, b, c in zip(*map(jax.tree.leaves, (together, *apart)), strict=True):
        np.testing.assert_allclose(
            a, b + c, rtol=2000 * np.finfo(dtype).eps, atol=1e-5 if dtype == np.float32 else 1e-13
        )


def test_sampling_in_chunks_keeps_weights_and_densities_consistent():
    wi = jnp.broadcast_to(lj.direction(0.7, 0.2), (20_000, 3))
    wo, density, weight = lj.sample(STACK, wi, jax.random.key(3), SINGLE)
    some = slice(0, 20_000, 997)
    np.testing.assert_allclose(density[some], lj.pdf(STACK, wi[some], wo[some], SINGLE), rtol=1e-12)
    expected = lj.evaluate(STACK, wi[some], wo[some], SINGLE) * jnp.abs(wo[some, 2:]) / density[some, None]
    np.testing.assert_allclose(weight[some], expected, rtol=1e-12)


def test_the_directions_decide_the_precision():
    for dtype in (jnp.float32, jnp.float64):
        assert lj.evaluate(STACK, directions(2, 0, dtype), directions(2, 1, dtype), SINGLE).dtype == dtype
    assert lj.evaluate(STACK, [0, 0, 1], [0.0, 0.6, 0.8], SINGLE).dtype == jnp.float64


def test_preparing_changes_nothing():
    wi, wo = directions(10, 4), directions(10, 5)
    prepared = lj.prepare(OPEN, lj.SingleScattering())
    np.testing.assert_array_equal(lj.evaluate(prepared, wi, wo), lj.evaluate(OPEN, wi, wo, SINGLE))
    np.testing.assert_array_equal(lj.pdf(prepared, wi, wo), lj.pdf(OPEN, wi, wo, SINGLE))
    key = jax.random.key(0)
    np.testing.assert_array_equal(lj.sample(prepared, wi, key)[0], lj.sample(OPEN, wi, key, SINGLE)[0])


def test_sides_agree_where_they_are_asked_for():
    wi, wo = directions(200, 6), directions(200, 7)
    everything = lj.evaluate(OPEN, wi, wo, SINGLE)[:, 0]
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    across = wi[:, 2] * wo[:, 2] < 0
    for side, asked in (("reflection", above), ("transmission", across)):
        values = lj.evaluate(OPEN, wi, wo, SINGLE, side=side)[:, 0]
        np.testing.assert_allclose(values, jnp.where(asked, everything, 0.0), rtol=1e-12)
    with pytest.raises(ValueError, match="side: 'up' is not one of"):
        lj.evaluate(OPEN, wi, wo, SINGLE, side="up")


def test_errors_are_refused_before_anything_is_evaluated():
    wi, single, double = lj.direction(0.3, 0.0), Unevaluated(), Unevaluated(resolutions=True)
    with pytest.raises(ValueError, match="transport: Unevaluated has no resolution to vary and no standard error"):
        lj.evaluate_with_error(STACK, wi, wi, single)
    with pytest.raises(ValueError, match=r"stack: Unevaluated .* needs the Stack, not a Prepared"):
        lj.evaluate_with_error(lj.prepare(STACK, double), wi, wi)
    with pytest.raises(AssertionError, match="evaluated"):
        lj.evaluate_with_error(STACK, wi, wi, double)


def test_what_is_known_to_be_absent_changes_no_value():
    wi, wo = directions(50, 8), directions(50, 9)
    plain = lj.Stack([lj.Medium(0.7, 1.0, lj.SGGX("surface", 0.4), 0.0), lj.Medium(0.0), lj.Medium(0.4, 0.0)])
    simplified = lj.evaluate(plain, wi, wo, SINGLE)
    traced = jax.jit(lambda stack: lj.evaluate(stack, wi, wo, SINGLE))(plain)  # traced leaves cannot be simplified
    np.testing.assert_allclose(simplified, traced, rtol=1e-13)


def test_one_program_serves_all_values_of_a_structure():
    traced = []

    class Counted(lj.SingleScattering):
        def evaluate(self, *arguments):
            traced.append(1)
            return super().evaluate(*arguments)

    wi, wo = directions(7, 1), directions(7, 2)
    for alpha in (0.1, 0.2, 0.3, 0.4):
        stack = lj.Stack([lj.Medium(0.5, 0.9, lj.SGGX("fiber", alpha))], lj.Lambertian(0.1 * alpha))
        lj.evaluate(stack, wi, wo, transport=Counted())
    assert len(traced) == 1


def test_wrong_shapes_are_refused_by_name():
    with pytest.raises(ValueError, match=r"wo: shape \(2,\) given, \(\.\.\., 3\) needed"):
        lj.evaluate(OPEN, jnp.ones(3), jnp.ones(2), SINGLE)


def test_a_program_may_hold_a_call_of_which_all_is_known():
    """Its own compiler options, which JAX takes at the outermost program only, are of no harm there."""
    stack = lj.Stack([], lj.Lambertian(0.5))
    wi, wo = lj.direction(0.5, 0.0), lj.direction(0.6, 3.1)
    found = jax.jit(lambda x: x + lj.evaluate(stack, wi, wo, lj.SingleScattering()))(1.0)
    assert float(found[0]) == pytest.approx(1.0 + 0.5 / np.pi)
