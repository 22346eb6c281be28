"""Problems: the likelihood against scipy.stats, as least squares, refusals; simulated values; the programs they run."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg  # noqa: F401 (what JAX's matrices are solved by)
from jax.experimental import io_callback
from scipy import integrate, stats
from threadpoolctl import threadpool_info, threadpool_limits

import layerjax as lj
from fits import Discrepancy, Free, Instrument, LogNormal, LogUniform, Noise, Normal, Problem, simulate, slices
from fits.optimise.options import options_from
from fits.problem import compilation
from fits.problem.compilation import Static, one_thread, run
from fits.problem.model import Model
from fits.problem.noise import information_weights, log_density, named_residual, tail_residual
from tests.helpers.models import design, line, measured
from tests.helpers.refusals import refuses

COUNT = 40
VALUES = np.random.default_rng(0).normal(0.5, 0.2, (COUNT, 1))
SIGMA = np.linspace(0.05, 0.2, COUNT)[:, None]
STACK = {"a": Free(0.3, 0.01, 2.0, LogUniform()), "b": Free(0.4, -1.0, 1.0, Normal(0.3, 0.5))}
NU = jnp.asarray(4.0)
TAILS = {"gaussian": stats.norm, "student": stats.t(4.0)}
PAINT = lj.Stack([], lj.Lambertian(Free(0.4, 0.0, 1.0)))
DATA = simulate(lj.Stack([], lj.Lambertian(0.6)), slices(incidence=[20], outgoing=[-40, 10, 70]), noise=0.1)
ALBEDO = np.array([0.2, 0.4, 0.6])
COLOURS = lj.Stack([], lj.Lambertian(ALBEDO))
NOISES = {
    "sigma": Noise(),
    "sigma and relative": Noise(relative=0.1, floor=0.02),
    "relative": Noise(relative=0.1, floor=0.02, use_sigma=False),
    "free": Noise(relative=Free(0.1, 0.0, 1.0), floor=Free(0.02, 1e-3, 1.0), use_sigma=False),
    "free student": Noise(relative=0.05, floor=Free(0.02, 1e-3, 1.0), tails="student", degrees_of_freedom=3.0),
}
WALK = lj.Stack([], lj.Lambertian(Free((0.4, 0.4), 0.0, 1.0, random_walk_sd=0.1)))
TWO = replace(DATA, values=np.repeat(DATA.values, 2, axis=1), sigma=None, channels=("a", "b"))
MANY = np.array([0.1, 0.2, 0.3])
BARE = lj.Stack([], lj.Lambertian(0.5))
MIXED = lj.Mixture(dict.fromkeys("abc", BARE), [Free(0.2, 0.0, 0.7), Free(0.2, 0.0, 0.5), None])
FLOOR, FLAT = Instrument(floor=1e-3), {"a": Free(0.3, 0.01, 2.0), "b": 0.1}
LINE_DATA, DARK = measured(VALUES), measured(1e-300 * np.ones_like(VALUES))


@pytest.mark.parametrize("z", [0.0, 1e-12, -1e-5, 0.019, 0.0201, -0.3, 2.0, 40.0, 1e6])
def test_densities_are_scipys_and_half_squares_of_residuals(z: float) -> None:
    for tails, reference in TAILS.items():
        expected = reference.logpdf(z) - np.log(0.3)
        assert float(log_density(jnp.asarray(z), jnp.asarray(0.3), tails, NU)) == pytest.approx(expected, rel=1e-12)
    residual = float(tail_residual(jnp.asarray(z), "student", NU))
    assert np.sign(residual) == np.sign(z)
    assert 0.5 * residual**2 == pytest.approx(2.5 * np.log1p(z**2 / 4), rel=1e-12)
    assert float(tail_residual(jnp.asarray(z), "gaussian", NU)) == z


@pytest.mark.parametrize("tails", TAILS)
def test_information_is_the_mean_square_score(tails: str) -> None:
    reference, step = TAILS[tails], 1e-5
    z = np.concatenate([np.linspace(0.0, 10.0, 4001), np.geomspace(10.0, 400.0, 4001)[1:]])
    mean = (reference.logpdf(z - step) - reference.logpdf(z + step)) / (2 * step)
    level = (reference.logpdf(z * np.exp(-step)) - reference.logpdf(z * np.exp(step))) / (2 * step) - 1.0
    expected = [2.0 * integrate.simpson(reference.pdf(z) * score**2, z) for score in (mean, level)]
    np.testing.assert_allclose(information_weights(tails, NU), expected, rtol=1e-4)


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)
def test_problem_against_a_likelihood_written_out(noise: Noise) -> None:
    """Log-likelihood and log-prior by scipy; the residuals give their sum up to one constant."""
    problem = Problem(STACK, measured(VALUES, SIGMA), line, noise, Free(1.0, 0.5, 2.0, LogNormal(1.0, 0.1)))
    assert problem.names[:3] == ("['a']", "['b']", "scale")
    offsets = []
    for vector in np.random.default_rng(1).uniform(problem.low, problem.high, (4, len(problem.names))):
        named = dict(zip(problem.names, vector, strict=True))
        predicted = named["scale"] * (design(COUNT) @ vector[:2])[:, None]
        relative, floor = (named.get(f"noise.{name}", getattr(noise, name) or 0.0) for name in ("relative", "floor"))
        sigma = np.sqrt((SIGMA**2 if noise.use_sigma else 0.0) + (relative * predicted) ** 2 + floor**2)
        law = stats.norm if noise.tails == "gaussian" else stats.t(3.0)
        each = law.logpdf((VALUES - predicted) / sigma) - np.log(sigma)
        np.testing.assert_allclose(problem.call(Model.log_likelihood_per_datum_at, vector, predicted), each, rtol=1e-10)
        assert float(problem.log_likelihood(vector)) == pytest.approx(each.sum(), rel=1e-12)
        priors = stats.norm.logpdf(named["['b']"], 0.3, 0.5) + stats.norm.logpdf(np.log(named["scale"]), 0, 0.1)
        half = 0.5 * float(np.sum(np.square(problem.residuals(vector))))
        offsets.append(half + each.sum() + priors)
    assert np.ptp(offsets) < 1e-9 * max(1.0, abs(offsets[0]))


def test_posterior_density_is_likelihood_prior_and_map() -> None:
    problem = Problem(STACK, measured(VALUES, SIGMA), line)
    vector = np.array([0.5, 0.2])
    prior = stats.loguniform(0.01, 2.0).logpdf(0.5) + stats.truncnorm(-2.6, 1.4, 0.3, 0.5).logpdf(0.2)
    share = np.array([np.log(0.5 / 0.01) / np.log(200.0), 1.2 / 2.0])
    slopes = np.array([0.5 * np.log(200.0), 2.0]) * share * (1 - share)
    expected = float(problem.log_likelihood(vector)) + prior + np.sum(np.log(slopes))
    u = np.log(share) - np.log1p(-share)
    assert float(problem.log_posterior_unconstrained(u)) == pytest.approx(expected, rel=1e-12)
    for far in (np.array([np.nan, 0.0]), np.array([np.inf, 0.0])):
        assert float(problem.log_posterior_unconstrained(far)) == -np.inf


def test_masked_samples_never_enter_and_noise_is_five_per_cent_by_default() -> None:
    spoiled, mask = VALUES.copy(), np.ones(COUNT, bool)
    spoiled[::4], mask[::4] = 1e6, False
    clean, masked = (Problem(STACK, measured(values, SIGMA, mask), line) for values in (VALUES, spoiled))
    vector = np.array([0.5, 0.2])
    assert clean.count == COUNT - COUNT // 4
    np.testing.assert_array_equal(clean.residuals(vector), masked.residuals(vector))
    predicted = (design(COUNT) @ vector)[:, None]
    expected = stats.norm.logpdf(VALUES, predicted, np.hypot(0.05 * predicted, 1e-4 * np.median(np.abs(VALUES))))
    assert float(Problem(STACK, measured(VALUES), line).log_likelihood(vector)) == pytest.approx(expected.sum())


def test_named_residuals() -> None:
    predicted, values, cosine = np.array([[0.3], [0.0]]), np.array([[0.2], [-0.01]]), np.array([[0.5], [0.8]])
    f, d = predicted * cosine, values * cosine
    expected = {"cosine_l2": f - d, "log1p_cos": np.log1p(f) - np.log1p(d), "cube_root": np.cbrt(f) - np.cbrt(d)}
    for name, reference in expected.items():
        ours = named_residual(name, *map(jnp.asarray, (predicted, values, cosine)))
        np.testing.assert_allclose(ours, reference, atol=0.011 if name == "cube_root" else 1e-12)
        slope = jax.jacfwd(lambda f, name=name: named_residual(name, f, jnp.asarray(values), jnp.asarray(cosine)))
        assert np.all(np.isfinite(slope(jnp.asarray(predicted))))


def lambert(stack: lj.Stack, wi: jax.Array, wo: jax.Array, gain: float = 1.0) -> jax.Array:
    return jnp.broadcast_to(gain * stack.base.albedo / jnp.pi, (len(wi), 1))


@dataclass(frozen=True)
class Plain:
    gain: float

    def __call__(self, stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lambert(stack, wi, wo, self.gain)


class Module(eqx.Module):
    gain: jax.Array
    __call__ = Plain.__call__


CALLABLES = {
    "lambda": (lambda stack, wi, wo: lambert(stack, wi, wo, 2.0), 2.0),
    "compiled": (jax.jit(lambert), 1.0),
    "partial": (partial(lambert, gain=0.5), 0.5),
    "bound method": (Plain(3.0).__call__, 3.0),
    "object": (Plain(3.0), 3.0),
    "equinox module": (Module(jnp.asarray(0.25)), 0.25),
}


@pytest.mark.parametrize(("transport", "gain"), CALLABLES.values(), ids=CALLABLES)
def test_any_callable_stands_for_a_transport(transport, gain: float) -> None:
    problem = Problem(PAINT, DATA, transport=transport)
    np.testing.assert_allclose(problem.predict([0.3]), np.full((3, 1), gain * 0.3 / np.pi), rtol=1e-12)
    seen = simulate(lj.Stack([], lj.Lambertian(0.3)), slices([20], [10]), transport=transport)
    np.testing.assert_allclose(seen.values, [[gain * 0.3 / np.pi]], rtol=1e-12)


def test_what_follows_from_a_problem() -> None:
    problem = Problem(PAINT, DATA, scale=Free(1.0, 0.5, 2.0))
    assert problem.names == ("base.albedo", "scale")
    assert (problem.count, problem.units) == (3, {"base.albedo": "1", "scale": "1"})
    np.testing.assert_array_equal([problem.low, problem.start, problem.high], [[0.0, 0.5], [0.4, 1.0], [1.0, 2.0]])
    assert problem.model is problem.model
    colours = lj.Stack([], base=lj.Lambertian(Free([0.1, 0.2, 0.3], 0.0, 1.0)))
    three = Problem(colours, measured(np.repeat(VALUES, 3, axis=1)))
    np.testing.assert_allclose(three.predict([0.1, 0.2, 0.3])[0], np.array([0.1, 0.2, 0.3]) / np.pi, rtol=1e-12)


def test_simulated_values_and_noise_are_as_stated_seeds_repeat_and_samples_without_light_are_masked():
    plain = simulate(COLOURS, slices(incidence=[20, 60]))
    np.testing.assert_allclose(plain.values, np.broadcast_to(ALBEDO / np.pi, plain.values.shape), rtol=1e-12)
    assert plain.sigma is None
    assert plain.mask.all()
    assert plain.channels == ("red", "green", "blue")
    data = simulate(COLOURS, slices(outgoing=np.linspace(-80, 80, 400)), noise=0.05, floor=0.01, seed=3)
    expected = np.sqrt((0.05 * ALBEDO / np.pi) ** 2 + 0.01**2)
    np.testing.assert_allclose(data.sigma, np.broadcast_to(expected, data.sigma.shape))
    z = (data.values - ALBEDO / np.pi) / data.sigma
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3  # a fixed seed: passes or fails for good
    first, again, other = (simulate(COLOURS, slices(), noise=0.1, seed=seed).values for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()
    data = simulate(COLOURS, slices(incidence=[30], outgoing=[10, 120]), noise=0.05)
    np.testing.assert_array_equal(data.mask, [True, False])  # nothing passes an opaque base


def named(noise: Noise) -> Problem:
    return Problem(FLAT, LINE_DATA, line, noise, objective="cube_root")


def rough(roughness: Free | np.ndarray) -> lj.Stack:
    return lj.Stack([], lj.OrenNayar(0.4, roughness))


def test_refused() -> None:
    for call, message in (
        (lambda: Noise(floor=Free(0.1, 0.0, 1.0)), r"Noise.floor.low is 0.0; it must be a number in \[1e-100, "),
        (lambda: Noise(relative=Free([0.1, 0.1], 0.0, 1.0)), "Noise.relative has 2 channels"),
        (lambda: Noise(floor=1e-200), r"Noise.floor is 1e-200; it must be a number in \[1e-100, 1e\+100\]"),
        (lambda: Noise(tails="cauchy"), "Noise.tails: 'cauchy' is not one of 'gaussian', 'student'"),
        (lambda: Noise(tails="student", discrepancy=True), "Noise.tails is 'student'; with model discrepancy it must"),
        (lambda: Noise(discrepancy=0.3), "Noise.discrepancy is 0.3; it must be true, false or Discrepancy"),
        (lambda: Discrepancy(amplitude=-0.1), r"discrepancy.amplitude is -0.1; it must be a number in \[1e-06, 1\]"),
        (lambda: Instrument(source_aperture=Free(1.0, 0.0, 2.0)), r"source_aperture is Free.* in \[0, 30\]"),
        (lambda: Instrument(tilt=Free(0.0, -20.0, 5.0)), r"tilt.low is -20.0; it must be a number in \[-10, 10\]"),
        (lambda: Instrument(gain_sd=True), "Instrument.gain_sd is True"),
        (lambda: options_from({"tolerance": 1.0}), r"\[options\] has an unknown key 'tolerance'; allowed: same_v"),
        (
            lambda: Problem(STACK, LINE_DATA, line, Noise(floor=1e-4), instrument=FLOOR),
            "Noise.floor and Instrument.floor",
        ),
        (lambda: Problem(MIXED, DATA), r"Mixture.weights: at their upper bounds they sum to 1.2; it must be at most"),
        (lambda: Problem(PAINT, DATA, lj.RandomWalk()), "RandomWalk is random; use a deterministic one"),
        (lambda: simulate(PAINT, slices(), lj.RandomWalk()), "RandomWalk is random"),
        (lambda: simulate(PAINT, slices(), noise=5), r"noise is 5; it must be a number in \[0, "),
        (lambda: Problem(PAINT, DATA, lj.AddingDoubling(tolerance=0.01)), "0.01 needs concrete parameters"),
        (lambda: Problem({"a": 0.1, "b": 0.2}, LINE_DATA, line), "nothing is free"),
        (lambda: Problem(STACK, measured(VALUES, mask=np.zeros(COUNT, bool)), line), "no sample is used"),
        (lambda: Problem(STACK, LINE_DATA, line, Noise(relative=0.0, floor=0.0)), "sigma could become 0"),
        (lambda: Problem(STACK, DARK, line), r"median of \|value\| is 1e-300 1/sr; .* in \[1e-96, 1e\+30\], or Noise"),
        (lambda: Problem(STACK, LINE_DATA, line, scale=-1.0), "scale is -1.0"),
        (lambda: Problem(STACK, LINE_DATA, line, objective="l1"), "objective: 'l1' is not one of 'likelihood', "),
        (lambda: Problem(STACK, LINE_DATA, line, objective="cube_root"), r"prior of \['b'\]: objective 'cube_root'"),
        (lambda: Problem(WALK, TWO, objective="cosine_l2"), "the prior of base.albedo: objective 'cosine_l2' weighs"),
        (lambda: named(Noise(relative=Free(0.1, 0.0, 1.0))), r"noise\.relative: objective 'cube_root' weighs neither"),
        (lambda: named(Noise(discrepancy=True)), r"noise\.discrepancy: objective 'cube_root' weighs neither"),
        (lambda: Problem(WALK, replace(TWO, values=TWO.values[:, :1], channels=("a",))), "it has 2 channels, the data"),
        (lambda: Problem(PAINT, DATA, transport="walk"), r'transport: .* is not a Transport or "auto"'),
        (lambda: Problem(rough(Free(MANY, 0.0, 1.0)), DATA), r"takes one stack; base.roughness of shape \(3,\) makes"),
        (lambda: simulate(rough(MANY), slices()), r"base.roughness of shape \(3,\)"),
    ):
        refuses(message, call)


def threads() -> set[int]:
    """Of the libraries by which matrices are solved."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def most(model: tuple[()]) -> jax.Array:
    return io_callback(lambda: np.int32(max(threads())), jax.ShapeDtypeStruct((), jnp.int32))


def test_matrices_are_solved_by_one_thread_and_the_others_come_back_after_the_last_call() -> None:
    arrays, static = eqx.partition((), eqx.is_array)
    with threadpool_limits(2), ThreadPoolExecutor(2) as pool:
        program = (arrays, Static(static))
        assert int(run(most, program)) == 1
        assert [int(seen) for seen in pool.map(lambda _: run(most, program), range(4))] == [1] * 4
        assert threads() == {2}
    first, second = one_thread(), one_thread()
    with threadpool_limits(2):
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts maps")
@pytest.mark.parametrize(("full", "traced"), [(0.0, 2), (1.0, 1)])
def test_programs_go_where_a_process_has_no_room_for_more(monkeypatch, full: float, traced: int) -> None:
    monkeypatch.setattr(compilation, "FULL", full)
    seen = []

    @jax.jit
    def program(x):
        seen.append(x)
        return 2.0 * x

    program(1.0)
    compilation.make_room()
    program(1.0)
    assert len(seen) == traced
