"""Several measurements in one likelihood: against least squares in closed form, and against each alone."""

from dataclasses import replace

import numpy as np
import pytest

import fits
from tests.helpers.models import LINE, LOBE_STACK, design, line, lobe, measured, noisy_lobe
from tests.helpers.refusals import refuses

SIGMA = {"first": 0.05, "second": 0.02}
COUNTS = {"first": 100, "second": 40}
TRUE = {"first": (1.0, 0.5), "second": (0.2, 0.5)}  # two lines with one slope
PRIOR = fits.Normal(0.4, 0.01)
SLOPE, OFFSET = "['b']", "['a']"


def data(name):
    noise = np.random.default_rng(len(name)).standard_normal((COUNTS[name], 1))
    return measured((design(COUNTS[name]) @ TRUE[name])[:, None] + SIGMA[name] * noise, SIGMA[name])


def problem(name, slope=LINE["b"], **given):
    return fits.Problem(LINE | {"b": slope}, data(name), line, **given)


def least_squares(prior):
    """Slope and the two offsets in closed form, with their covariance."""
    rows, targets = [], []
    for name, offsets in zip(TRUE, np.eye(2), strict=True):
        cosine = design(COUNTS[name])[:, 1:]
        rows.append(np.hstack([cosine, np.tile(offsets, (len(cosine), 1))]) / SIGMA[name])
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
    assert joint.degrees_of_freedom == sum(COUNTS.values()) - 3
    residuals = np.concatenate([joint.part(name).residuals for name in TRUE])
    assert joint.chi_square == pytest.approx(np.sum(residuals**2))
    assert joint.log_likelihood == pytest.approx(sum(joint.part(name).log_likelihood for name in TRUE))
    # the prior of what is shared counts once
    slope = fits.Free(0.1, -1.0, 3.0, PRIOR)
    found = fits.fit(fits.Joint({name: problem(name, slope) for name in TRUE}, shared=[SLOPE]), starts=1)
    expected, covariance = least_squares(prior=True)
    np.testing.assert_allclose(found.vector[order(found)], expected, atol=1e-5)
    np.testing.assert_allclose(found.covariance[np.ix_(order(found), order(found))], covariance, rtol=1e-6)


def test_a_part_is_a_fit_of_its_own(joint):
    first = joint.part("first")
    assert (set(first.values), first.values[SLOPE]) == ({OFFSET, SLOPE}, joint.values[SLOPE])
    assert first.standard_errors[OFFSET] == joint.standard_errors[f"first.{OFFSET}"]
    np.testing.assert_allclose(first.predicted[:, 0], design(COUNTS["first"]) @ [first.stack["a"], first.stack["b"]])
    assert first.minima[0].values == first.values
    refuses("part 'third' is not one of first, second", joint.part, "third")
    # it predicts with what all of them say
    at = fits.slices(incidence=(10,))
    columns = np.stack([at.wo[:, 2], np.ones(len(at)), np.zeros(len(at))], axis=-1)
    _, covariance = least_squares(prior=False)
    sd = np.sqrt(np.sum(columns @ covariance * columns, axis=-1))
    np.testing.assert_allclose(fits.predict(first, at, draws=4000).sd[:, 0], sd, rtol=0.06)  # of 4000 draws by weight


def test_what_takes_the_other_of_whole_and_part(joint):
    """What asks the data anew takes the whole, what shows or keeps one measurement a part."""
    for ask in (fits.sample, fits.evidence, fits.cross_validate):
        refuses(f"{ask.__name__}: 'first' is a part of a joint fit", ask, joint.part("first"))
    refuses("cross_validate: it takes a fit of one measurement by itself, not a joint", fits.cross_validate, joint)
    chain = np.tile(joint.vector, (20, 2, 1))
    posterior = fits.Posterior(joint, chain, chain[..., 0], np.ones(3), 1.0, converged=True)
    for ask in (
        lambda: fits.compare({"one": joint, "other": joint}),
        lambda: posterior.inference_data,
        lambda: fits.report(joint, path="never written"),
        lambda: fits.save_fit(joint, "never written"),
        lambda: fits.predict(joint, fits.slices(incidence=(10,))),
    ):
        refuses(r"of a joint fit it takes a part: fit.part\(...\) of first, second", ask)


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


def test_what_is_new_in_one_measurement_is_not_shared():
    """Names of a discrepancy begin as those of levels of noise do."""
    noise = fits.Noise(relative=fits.Free(0.1, 0.01, 1.0))
    both = fits.Joint({name: problem(name, noise=noise) for name in TRUE}, shared=["noise", SLOPE])
    changed = both.with_problems({"first": replace(both.parts["first"], noise=replace(noise, discrepancy=True))})
    added = set(changed.names) - set(both.names)
    assert [name.startswith("first.noise.discrepancy.") for name in added] == [True] * 4


def test_each_measurement_is_differentiated_by_its_own_parameters():
    alone = fits.Problem(LOBE_STACK, noisy_lobe(0), lobe)
    several = fits.Joint(dict.fromkeys(("a", "b", "c"), alone), shared=["['alpha']"])
    (known,) = alone.linearise(alone.start)
    assert len(known.slopes) == len(alone.names)
    assert len(several.names) == 3 * len(alone.names) - 2
    for own in several.linearise(several.start):
        np.testing.assert_array_equal(own.slopes, known.slopes)


def test_refused(joint):
    whole, (first, second) = joint.problem, joint.problem.parts.values()
    fixed, other = problem("second", 0.5), problem("second", fits.Free(0.1, -1.0, 2.0))
    named = problem("second", objective="cosine_l2")
    for call, message in (
        (lambda: fits.Joint({"a": first}), r"Joint.parts is \['a'\]; it must name at least two problems"),
        (lambda: fits.Joint({"a": first, "b": second}, ["scale"]), "no problem has a free parameter 'scale'"),
        (lambda: fits.Joint({"a": first, "b": fixed}, [SLOPE]), r"\['b'\] is not free in 'b'; it must be in every"),
        (lambda: fits.Joint({"a": first, "b": other}, [SLOPE]), r"\['b'\] has other bounds or another prior in 'b'"),
        (lambda: fits.Joint({"a": first, "b": named}), "objective is 'cosine_l2'; it must be 'likelihood'"),
        (lambda: fits.fit(whole, data("first")), "data is given beside a Joint"),
        (lambda: fits.fit(whole, transport=line), "transport is given beside a Joint"),
    ):
        refuses(message, call)
