"""Several measurements in one likelihood: against least squares in closed form, and against each alone."""

from dataclasses import replace

import numpy as np
import pytest

import fits
from tests.helpers.models import LINE, LOBE_STACK, design, line, lobe, measured, noisy_lobe

SIGMA = {"first": 0.05, "second": 0.02}
COUNTS = {"first": 100, "second": 40}
TRUE = {"first": (1.0, 0.5), "second": (0.2, 0.5)}  # two lines with one slope
PRIOR = fits.Normal(0.4, 0.01)
SLOPE, OFFSET = "['b']", "['a']"


def data(name):
    noise = np.random.default_rng(len(name)).standard_normal((COUNTS[name], 1))
    return measured((design(COUNTS[name]) @ TRUE[name])[:, None] + SIGMA[name] * noise, SIGMA[name])


FLAT = fits.Uniform()


def problem(name, prior=FLAT):
    return fits.Problem({"a": fits.Free(0.9, -1.0, 3.0), "b": fits.Free(0.1, -1.0, 3.0, prior)}, data(name), line)


def least_squares(prior):
    """Slope and the two offsets in closed form, with their covariance."""
    rows, targets = [], []
    for index, name in enumerate(TRUE):
        offset, cosine = design(COUNTS[name]).T
        columns = np.zeros((COUNTS[name], 3))
        columns[:, 0], columns[:, 1 + index] = cosine, offset
        rows.append(columns / SIGMA[name])
        targets.append(data(name).values[:, 0] / SIGMA[name])
    if prior:
        rows.append(np.array([[1.0, 0.0, 0.0]]) / PRIOR.sd)
        targets.append([PRIOR.mean / PRIOR.sd])
    a, b = np.concatenate(rows), np.concatenate(targets)
    covariance = np.linalg.inv(a.T @ a)
    return covariance @ a.T @ b, covariance


@pytest.fixture(scope="module")
def joint():
    return fits.fit(fits.Joint({name: problem(name) for name in TRUE}, shared=[SLOPE]), starts=2)


def order(found):
    return [found.problem.names.index(name) for name in (SLOPE, f"first.{OFFSET}", f"second.{OFFSET}")]


def test_it_is_least_squares(joint):
    expected, covariance = least_squares(prior=False)
    at = order(joint)
    np.testing.assert_allclose(joint.vector[at], expected, atol=1e-6)
    np.testing.assert_allclose(joint.covariance[np.ix_(at, at)], covariance, rtol=1e-6)
    np.testing.assert_allclose(joint.errors[at], np.sqrt(np.diagonal(covariance)), rtol=1e-6)
    assert joint.degrees_of_freedom == sum(COUNTS.values()) - 3
    residuals = np.concatenate([joint.part(name).residuals for name in TRUE])
    assert joint.chi_square == pytest.approx(np.sum(residuals**2))
    assert joint.log_likelihood == pytest.approx(sum(joint.part(name).log_likelihood for name in TRUE))
    # the prior of what is shared counts once
    found = fits.fit(fits.Joint({name: problem(name, PRIOR) for name in TRUE}, shared=[SLOPE]), starts=1)
    expected, covariance = least_squares(prior=True)
    np.testing.assert_allclose(found.vector[order(found)], expected, atol=1e-5)
    np.testing.assert_allclose(found.covariance[np.ix_(order(found), order(found))], covariance, rtol=1e-6)


def test_a_part_is_a_fit_of_its_own(joint):
    first = joint.part("first")
    assert set(first.values) == {OFFSET, SLOPE}
    assert first.values[SLOPE] == joint.values[SLOPE]
    assert first.standard_errors[OFFSET] == joint.standard_errors[f"first.{OFFSET}"]
    np.testing.assert_allclose(first.predicted[:, 0], design(COUNTS["first"]) @ [first.stack["a"], first.stack["b"]])
    assert first.minima[0].values == first.values
    with pytest.raises(ValueError, match="part 'third' is not one of first, second"):
        joint.part("third")


def test_what_takes_the_other_of_whole_and_part(joint):
    """What asks the data anew takes the whole, what shows or keeps one measurement a part."""
    first = joint.part("first")
    for ask in (fits.sample, fits.evidence, fits.cross_validate):
        with pytest.raises(ValueError, match=f"{ask.__name__}: 'first' is a part of a joint fit"):
            ask(first)
    with pytest.raises(ValueError, match="cross_validate: it takes a fit of one measurement by itself, not a joint"):
        fits.cross_validate(joint)
    chain = np.tile(joint.vector, (20, 2, 1))
    posterior = fits.Posterior(joint, chain, chain[..., 0], np.ones(3), 1.0, converged=True)
    for ask in (
        lambda: fits.compare({"one": joint, "other": joint}),
        lambda: posterior.inference_data,
        lambda: fits.report(joint, path="never written"),
        lambda: fits.save_fit(joint, "never written"),
        lambda: fits.predict(joint, fits.slices(incidence=(10,))),
    ):
        with pytest.raises(ValueError, match=r"of a joint fit it takes a part: fit.part\(...\) of first, second"):
            ask()


def test_a_part_predicts_with_what_all_of_them_say(joint):
    at = fits.slices(incidence=(10,))
    seen = fits.predict(joint.part("first"), at, draws=4000)
    columns = np.stack([at.wo[:, 2], np.ones(len(at)), np.zeros(len(at))], axis=-1)
    _, covariance = least_squares(prior=False)
    sd = np.sqrt(np.sum(columns @ covariance * columns, axis=-1))
    np.testing.assert_allclose(seen.sd[:, 0], sd, rtol=0.06)  # of 4000 draws by weight


def test_the_posterior_is_that_of_all(joint):
    found = fits.sample(joint, ess=1000, seed=1)
    expected, covariance = least_squares(prior=False)
    summary, errors = [found.summary()[joint.problem.names[k]] for k in order(joint)], np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose([one[4] for one in summary], errors, rtol=0.12)
    assert np.all(np.abs([one[3] for one in summary] - expected) < 5.0 * errors / np.sqrt(1000))
    part = found.part("second")
    assert part.names == joint.part("second").problem.names
    np.testing.assert_allclose(part.summary()[SLOPE], found.summary()[SLOPE], rtol=1e-12)
    assert part.inference_data.posterior_predictive["value"].shape[-2:] == (COUNTS["second"], 1)


@pytest.mark.slow
def test_measurements_that_share_nothing_are_each_alone():
    values = design(60) @ [0.9, 0.4]
    noise = np.random.default_rng(3).standard_normal((2, 60)) * [[0.03], [0.05]]
    noises = {
        "level": fits.Noise(relative=fits.Free(0.1, 0.001, 1.0, fits.LogNormal(0.05, 2.0))),
        "shared": fits.Noise(0.02, discrepancy=fits.Discrepancy(length_half=10.0, length_difference=10.0)),
    }
    problems = {
        name: fits.Problem(LINE, measured((values * (1 + part))[:, None]), line, assumed)
        for (name, assumed), part in zip(noises.items(), noise, strict=True)
    }
    together = fits.fit(fits.Joint(problems), starts=3)
    for name, one in problems.items():
        alone = fits.fit(LINE, one.data, transport=line, noise=one.noise, starts=3)
        np.testing.assert_allclose(together.part(name).vector, alone.vector, rtol=1e-4)
        np.testing.assert_allclose(together.part(name).errors, alone.errors, rtol=1e-3)
        np.testing.assert_allclose(together.part(name).residuals, alone.residuals, atol=1e-3)


def test_what_is_new_in_one_measurement_is_not_shared():
    """Errors that readings of one of them share have names that begin as those of levels of noise do."""
    noise = fits.Noise(relative=fits.Free(0.1, 0.01, 1.0))
    both = fits.Joint({name: fits.Problem(LINE, data(name), line, noise) for name in TRUE}, shared=["noise", SLOPE])
    changed = both.with_problems({"first": replace(both.parts["first"], noise=replace(noise, discrepancy=True))})
    added = set(changed.names) - set(both.names)
    assert len(added) == 4
    assert all(name.startswith("first.noise.discrepancy.") for name in added)


def test_each_measurement_is_differentiated_by_its_own_parameters():
    alone = fits.Problem(LOBE_STACK, noisy_lobe(0), lobe)
    several = fits.Joint(dict.fromkeys(("a", "b", "c"), alone), shared=["['alpha']"])
    (known,) = alone.linearise(alone.start)
    assert len(known.slopes) == len(alone.names)
    assert len(several.names) == 3 * len(alone.names) - 2
    for own in several.linearise(several.start):
        np.testing.assert_array_equal(own.slopes, known.slopes)


FIRST, SECOND = (problem(name) for name in TRUE)
FIXED = fits.Problem({"a": fits.Free(0.9, -1.0, 3.0), "b": 0.5}, data("second"), line)
OTHER = fits.Problem({"a": fits.Free(0.9, -1.0, 3.0), "b": fits.Free(0.1, -1.0, 2.0)}, data("second"), line)
NAMED = fits.Problem(LINE, data("second"), line, objective="cosine_l2")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fits.Joint({"a": FIRST}), r"Joint.parts is \['a'\]; it must name at least two problems"),
        (lambda: fits.Joint({"a": FIRST, "b": SECOND}, ["scale"]), "no problem has a free parameter 'scale'"),
        (lambda: fits.Joint({"a": FIRST, "b": FIXED}, [SLOPE]), r"\['b'\] is not free in 'b'; it must be in every"),
        (lambda: fits.Joint({"a": FIRST, "b": OTHER}, [SLOPE]), r"\['b'\] has other bounds or another prior in 'b'"),
        (lambda: fits.Joint({"a": FIRST, "b": NAMED}), "objective is 'cosine_l2'; it must be 'likelihood'"),
        (lambda: fits.fit(fits.Joint({"a": FIRST, "b": SECOND}), data("first")), "data is given beside a Joint"),
        (lambda: fits.fit(fits.Joint({"a": FIRST, "b": SECOND}), transport=line), "transport is given beside a Joint"),
    ],
)
def test_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
