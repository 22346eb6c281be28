"""Fits against scipy's and against answers known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import layerjax as lj
from fits import Direction, Free, Noise, Normal, Problem, Uniform, evidence, fit, predict, simulate, slices
from fits.optimise.fit import start_points
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, BoxLevenbergMarquardt
from fits.problem.compilation import _program
from fits.reports import verdicts
from tests.helpers.models import COUNT, LINE, LOBE, LOBE_STACK, design, line, line_data, lobe, measured, noisy_lobe

DESIGN = design(COUNT)
A, B = "['a']", "['b']"


def regression(data, columns=DESIGN):
    return np.linalg.lstsq(columns, data.values[:, 0], rcond=None)[0]


def test_the_lobe_fit_is_scipys():
    data = noisy_lobe(0)
    lobe_fit = fit(LOBE_STACK, data, transport=lobe, starts=16)
    names = [name.strip("[']") for name in lobe_fit.problem.names]

    def residuals(vector):
        predicted = lobe(dict(zip(names, vector, strict=True)), data.wi, data.wo)
        return ((predicted - data.values) / data.sigma).ravel()

    reference = least_squares(residuals, [LOBE[name] for name in names], x_scale="jac", jac="3-point", gtol=1e-12)
    covariance = np.linalg.inv(reference.jac.T @ reference.jac)
    errors = np.sqrt(np.diagonal(covariance))
    assert lobe_fit.converged
    np.testing.assert_allclose((lobe_fit.vector - reference.x) / errors, 0.0, atol=1e-3)
    assert lobe_fit.chi_square == pytest.approx(2 * reference.cost, rel=1e-8)
    np.testing.assert_allclose(lobe_fit.errors, errors, rtol=1e-3)
    np.testing.assert_allclose(lobe_fit.correlation, covariance / np.outer(errors, errors), atol=2e-3)
    assert lobe_fit.reduced_chi_square == pytest.approx(1.0, abs=4 * np.sqrt(2 / 594))
    assert not lobe_fit.at_bound
    assert not any(combination.unconstrained for combination in lobe_fit.unidentified)
    # starts are counted
    counts = [minimum.count for minimum in lobe_fit.minima]
    assert [minimum.cost for minimum in lobe_fit.minima] == sorted(minimum.cost for minimum in lobe_fit.minima)
    assert 4 <= counts[0] <= sum(counts) <= 16
    assert f"{counts[0]} of 16 starts" in lobe_fit.status
    assert lobe_fit.minima[0].values == pytest.approx(lobe_fit.values)
    # and new data do not recompile
    before = _program(True)._cache_size()
    other = fit(LOBE_STACK, noisy_lobe(1), transport=lobe, starts=2, seed=3)
    assert _program(True)._cache_size() == before
    assert other.values != lobe_fit.values


def test_the_gradient_of_the_posterior_agrees_with_differences():
    problem, u = Problem(LOBE_STACK, noisy_lobe(0), lobe), np.linspace(-1.0, 1.0, 6)
    gradient = problem.call(lambda model, u: jax.grad(model.log_posterior_unconstrained)(u), u)
    # the error of central differences is about h^2 = 1e-8 relative, their rounding 1e-16 / h of the log-posterior
    for slope, step in zip(gradient, 1e-4 * np.eye(6), strict=True):
        up, down = (float(problem.log_posterior_unconstrained(u + sign * step)) for sign in (1.0, -1.0))
        np.testing.assert_allclose(slope, (up - down) / 2e-4, rtol=1e-6)


def test_optimistix_runs_the_solver_within_the_box():
    """Rosenbrock's valley, whose minimum lies in the box or beyond it, beside scipy."""
    for scale in (2.0, 0.8):

        def residuals(y, args, scale=scale):
            x = scale * y
            return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]), (x, x)

        start = jnp.array([0.1, 0.9])
        found = optx.least_squares(residuals, BoxLevenbergMarquardt(), start, has_aux=True, max_steps=200)
        expected = least_squares(lambda y, of=residuals: np.asarray(of(y, None)[0]), start, bounds=(0.0, 1.0))
        np.testing.assert_allclose(found.value, expected.x, atol=1e-4)
        np.testing.assert_allclose(found.aux[0], scale * found.value, rtol=1e-6)
        np.testing.assert_allclose(found.stats["state"].watched, scale * np.eye(2), rtol=1e-6)


def test_starts_are_seeded_and_fill_the_box():
    problem = Problem(LOBE_STACK, noisy_lobe(0), lobe)
    points, again, other = (start_points(problem, 33, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(points, again)
    np.testing.assert_allclose(problem.model.box.from_unit(jnp.asarray(points[0])), problem.start)
    assert np.all(np.abs(points[1:].mean(axis=0) - 0.5) < 0.03)  # random points: 0.05 standard deviations
    assert not np.array_equal(points[1:], other[1:])


def test_a_parameter_beyond_its_bound_is_held_there_and_one_near_it_is_not():
    """a is best at 1.5 but may not exceed 1: b is then the one-parameter regression, with its error."""
    data = line_data(truth=(1.5, 0.5))
    result = fit({"a": Free(0.5, 0.0, 1.0), "b": LINE["b"]}, data, transport=line, starts=4)
    x = DESIGN[:, 1]
    assert (result.at_bound, result.values[A]) == ((A,), 1.0)
    assert result.values[B] == pytest.approx(x @ (data.values[:, 0] - 1.0) / (x @ x), rel=1e-6)
    assert result.standard_errors[B] == pytest.approx(0.05 / np.sqrt(x @ x), rel=1e-6)
    assert np.isnan(result.standard_errors[A])
    assert "at a bound: ['a']" in result.status
    # an optimum 1e-4 of the box inside is an interior minimum
    optimum = regression(line_data())
    near = fit({"a": Free(0.5, -1.0, optimum[0] + 2e-4), "b": LINE["b"]}, line_data(), transport=line, starts=4)
    assert near.at_bound == ()
    np.testing.assert_allclose(near.vector, optimum, atol=1e-6)


@pytest.mark.parametrize("prior", [Uniform(), Normal(0.3, 0.2)])
def test_a_sum_leaves_a_direction_open_and_a_prior_closes_it(prior):
    """Only a plus b matters: it is known, a minus b is what the prior says, and no error comes out small."""

    def total(stack, wi, wo):
        return (stack["a"] + stack["b"] + 0 * wo[:, 2])[:, None]

    stack = {"a": Free(0.1, -2.0, 2.0, prior), "b": Free(0.1, -2.0, 2.0)}
    result = fit(stack, measured(np.full((COUNT, 1), 1.0), 0.01), transport=total, starts=4)
    assert result.vector.sum() == pytest.approx(1.0, rel=1e-6)
    (combination,) = result.unidentified  # also where it is the prior that decides
    assert combination.unconstrained
    assert np.abs(list(combination.weights.values())) == pytest.approx([np.sqrt(0.5)] * 2, rel=1e-4)
    if isinstance(prior, Normal):
        assert result.standard_errors[A] == pytest.approx(0.2, rel=1e-6)
        left = np.sqrt(2.0 * COST_TOLERANCE) * 0.2  # a step that promises less ends the fit
        assert result.values == pytest.approx({A: 0.3, B: 0.7}, abs=left)
    else:
        assert combination.error > 1e3
        assert combination.weights[A] * combination.weights[B] < 0.0
        assert result.condition_number > 1e6
        assert min(result.standard_errors.values()) > 0.5


@pytest.mark.parametrize("strength", [0.0, 1e-170])
def test_parameters_with_hardly_any_effect_are_not_determined_and_no_error_overflows(strength):
    """An influence of any size: a warning would be an error here."""

    def faint(stack, wi, wo):
        return line(stack, wi, wo) + stack["strength"] * (stack["c"] + stack["d"]) * wo[:, :1]

    free = {**LINE, "c": Free(0.5, 0.0, 1.0), "d": Free(0.5, 0.0, 1.0), "strength": strength}
    result = fit(free, line_data(), transport=faint, starts=2)
    assert (result.insensitive, result.standard_errors["['c']"]) == (("['c']", "['d']"), np.inf)
    assert result.standard_errors[A] == pytest.approx(0.05 * np.sqrt(np.linalg.inv(DESIGN.T @ DESIGN)[0, 0]), rel=1e-6)
    assert np.isfinite(result.covariance).all()
    assert result.at_bound == ()
    if not strength:
        assert result.condition_number == np.inf
        expected = [Direction(np.inf, {name: 1.0}, {name: np.inf}) for name in result.insensitive]
        assert sorted(map(repr, result.unidentified)) == sorted(map(repr, expected))
        assert verdicts.identifiability(result)["['c']"] == "insensitive: no effect on the data"


def test_free_noise_levels_are_recovered():
    """Maximum likelihood of a line with constant noise, in closed form."""
    data = measured(line_data(0.07, seed=2).values)
    level = Noise(relative=0.0, floor=Free(0.5, 1e-4, 2.0))
    result = fit(LINE, data, transport=line, noise=level, starts=8)
    assert result.converged
    np.testing.assert_allclose(result.vector[:2], regression(data), rtol=1e-5)
    sigma = np.sqrt(np.mean((data.values[:, 0] - DESIGN @ regression(data)) ** 2))
    assert result.values["noise.floor"] == pytest.approx(sigma, rel=1e-5)
    assert result.standard_errors["noise.floor"] == pytest.approx(sigma / np.sqrt(2 * COUNT), rel=1e-5)
    assert result.units["noise.floor"] == "1/sr"


def test_student_tails_shrug_off_outliers():
    spoiled = line_data().values.copy()
    spoiled[::20] += 3.0
    for tails in ("student", "gaussian"):
        found = fit(LINE, measured(spoiled, 0.05), transport=line, noise=Noise(tails=tails), starts=4)
        assert (abs(found.values[A] - 1.0) < 4 * found.standard_errors[A]) == (tails == "student")


def test_a_named_residual_is_no_posterior():
    data = line_data()
    result = fit(LINE, data, transport=line, objective="cosine_l2", starts=4)
    weighted = data.wi[:, 2:] * DESIGN
    found, sum_of_squares = np.linalg.lstsq(weighted, data.wi[:, 2] * data.values[:, 0], rcond=None)[:2]
    covariance = np.linalg.inv(weighted.T @ weighted) * sum_of_squares[0] / (COUNT - 2)
    np.testing.assert_allclose(result.vector, found, rtol=1e-6)
    np.testing.assert_allclose(result.errors, np.sqrt(np.diagonal(covariance)), rtol=1e-6)
    assert not result.is_posterior
    assert np.isnan(result.log_likelihood)


@pytest.mark.slow
@pytest.mark.parametrize("discrepancy", [False, True])
def test_fits_do_as_well_where_a_user_forbids_arrays_of_different_ranks_to_broadcast(discrepancy: bool) -> None:
    """That is of their own code; starts run in threads, which have settings of their own."""
    noise = Noise(relative=0.02, floor=1e-4, discrepancy=discrepancy)
    jax.clear_caches()  # nothing that was traced before is taken for this
    with jax.numpy_rank_promotion("raise"):
        found = fit(LINE, line_data(), transport=line, noise=noise, starts=3)
        assert found.values[A] == pytest.approx(1.0, abs=0.3)
        assert verdicts.summary(found)
        assert np.isfinite(evidence(found).log_evidence)
        assert np.all(np.isfinite(predict(found, slices([30.0]), draws=8).bsdf.mean))


def test_starts_that_fail_are_counted_and_not_believed():
    def broken(stack, wi, wo):
        return jnp.where(stack["a"] > 2.0, jnp.nan, line(stack, wi, wo))

    result = fit(LINE, line_data(), transport=broken, starts=16)
    assert result.converged
    assert 1 < result.minima[0].count < 16
    assert f"{16 - result.minima[0].count} of 16 starts failed" in result.status
    result = fit({"a": Free(2.5, 2.1, 3.0), "b": LINE["b"]}, line_data(), transport=broken, starts=2)
    assert not result.converged
    assert np.all(np.isinf(result.errors))
    assert result.status.startswith("not converged")


def test_a_medium_over_a_base_is_recovered():
    def stack(thickness, albedo, g, base):
        return lj.Stack([lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g))], lj.Lambertian(base))

    free = stack(Free(1.0, 0.05, 5.0), Free([0.5, 0.5], 0.0, 1.0), Free(0.0, -0.9, 0.9), Free(0.5, 0.0, 1.0))
    view, single, calls = slices(incidence=[10, 40, 60], azimuth=[0, 90]), lj.SingleScattering(), []
    data = simulate(stack(0.6, [0.9, 0.6], 0.3, 0.4), view, transport=single, noise=0.02, seed=3)
    result = fit(free, data, transport=single, starts=3, progress=lambda *call: calls.append(call))
    assert result.converged
    assert np.all(np.abs(result.vector - [0.6, 0.9, 0.6, 0.3, 0.4]) < 4 * result.errors)
    assert float(result.stack.base.albedo) == result.values["base.albedo"]
    assert [call[:3] for call in calls] == [("fit", done, 3) for done in (1, 2, 3)]


def test_what_is_known_of_the_stack_stays_known_in_a_fit():
    """A dye that scatters nothing: this transport refuses a medium whose albedo might be anything."""

    def coat(depth):
        return lj.Stack([lj.Interface(1.5, 0.2), lj.Medium(depth, 0.0)], lj.Conductor(0.2, 3.9, 0.3))

    geometry, transport = slices(incidence=(30,), outgoing=(-20, 20)), lj.WeidlichWilkie()
    problem = Problem(coat(Free(0.3, 0.0, 1.0)), simulate(coat(0.3), geometry, transport, noise=0.01), transport)
    exact = simulate(coat(0.3), geometry, transport).values
    np.testing.assert_allclose(problem.predict([0.3]), exact, rtol=1e-9)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(problem.build([0.3]).stack))
