"""What data or an instrument cannot say: combinations of parameters, lobes that are not resolved, a width across."""

from dataclasses import replace

import numpy as np
import pytest

import fits
import layerjax as lj
from benchmarks.measuring.cones import mean_over_cones
from fits.optimise.uncertainty import unidentified_directions
from fits.reports import verdicts
from fits.reports.tables import parameter_table
from fits.reports.verdicts import finest_step, instrument_limits

SINGLE = lj.SingleScattering()
NOISE = 0.02
BRUSHED = {"base.alpha": 0.15, "base.alpha_y": 0.4, "base.tangent": 0.3}


def test_a_sum_that_alone_is_known_is_told_from_its_parts():
    """Rows (x + y) / 0.01 and (x - y) / 2 in boxes; x has 10 times the width of y in physical units, z is known."""
    root = np.array([[100.0, 100.0, 0.0], [0.5, -0.5, 0.0], [0.0, 0.0, 50.0]])
    (combination,) = unidentified_directions(root, ("x", "y", "z"), np.array([10.0, 1.0, 1.0]))
    assert combination.error == pytest.approx(np.sqrt(2.0))  # the row x - y of length 1 / sqrt(2)
    assert combination.unconstrained
    x, y = combination.weights["x"], combination.weights["y"]
    assert (list(combination.weights), [x * x, x * y]) == (["x", "y"], pytest.approx([0.5, -0.5]))
    # each alone: 1 / sqrt(100^2 + 0.5^2) boxes
    assert combination.conditional_errors == pytest.approx({"x": 0.1, "y": 0.01}, rel=1e-4)


def test_a_small_weight_that_makes_up_an_error_belongs():
    """z moves by a fiftieth along the open direction, yet owes it nearly all of its error."""
    along = np.array([0.6, 0.8, 0.02])
    along = along / np.linalg.norm(along)
    others = np.linalg.svd(along[None])[2][1:]
    root = np.vstack([along / 0.5, others / 1e-4])
    (combination,) = unidentified_directions(root, ("x", "y", "z"), np.ones(3))
    assert combination.error == pytest.approx(0.5)
    assert not combination.unconstrained
    assert combination.weights == pytest.approx({"y": along[1], "x": along[0], "z": along[2]})
    assert list(combination.weights) == ["y", "x", "z"]


def test_several_come_worst_first_and_fewer_data_than_parameters_are_no_trouble():
    found = unidentified_directions(np.array([[1.0, 0.0, 0.0], [0.0, 5.0, 0.0]]), ("x", "y", "z"), np.ones(3))
    assert [(one.error, list(one.weights)) for one in found] == [(np.inf, ["z"]), (1.0, ["x"]), (0.2, ["y"])]
    assert [one.conditional_errors[next(iter(one.weights))] for one in found] == [np.inf, 1.0, 0.2]
    # what is known to a tenth of its bounds is identified
    assert unidentified_directions(np.diag([10.5, 200.0]), ("x", "y"), np.ones(2)) == ()


def metal(alpha):
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha))


@pytest.mark.parametrize(
    ("alpha", "step", "detector", "limited"),
    [(0.1, 1.0, 0.0, False), (0.1, 10.0, 0.0, True), (0.005, 0.5, 4.0, True)],
)
def test_a_lobe_narrower_than_steps_or_aperture_is_limited(alpha, step, detector, limited):
    geometry, instrument = fits.slices([30.0], np.arange(-80.0, 80.5, step)), None
    data = fits.simulate(metal(alpha), geometry, SINGLE, 0.02, 1e-4)
    if detector:
        instrument = fits.Instrument(detector_aperture=detector)
        seen = mean_over_cones(metal(alpha), geometry.wi, geometry.wo, 0.0, detector)
        data = replace(data, values=seen * data.values / lj.evaluate(metal(alpha), geometry.wi, geometry.wo, SINGLE))
    free = metal(fits.Free(0.1, 1e-3, 1.0, fits.LogUniform()))
    found = fits.fit(free, data, transport=SINGLE, starts=4, instrument=instrument)
    limits = instrument_limits(found)
    assert bool(limits) == limited
    assert ("base.alpha is limited by the instrument" in verdicts.verdict(found).sentences[2]) == limited
    if limited:
        # GGX falls to a half where the tangent of the half vector is 0.6436 alpha; the viewer turns twice as fast
        half = np.tan(np.radians(max(detector, 2.0 * step) / 4.0)) / 0.6436
        assert limits["base.alpha"] == pytest.approx(half, rel=1e-3)
        row = parameter_table(found).rows[0]
        assert row[1:3] == (f"< {half:.2g}", "-")
        assert row[-1] == f"limited by the instrument: alpha below {half:.2g}"
    else:
        assert abs(found.values["base.alpha"] - alpha) < 4.0 * found.standard_errors["base.alpha"]


def test_the_finest_scan_about_the_mirror_counts():
    fine = np.concatenate([np.arange(-80.0, 20.0, 5.0), np.arange(20.0, 40.0, 0.25), np.arange(40.0, 81.0, 5.0)])
    behind = np.arange(-80.0, 20.0, 2.0)  # no measurement beyond the mirror direction
    for incidence, outgoing, step in (([10.0, 30.0], fine, 0.25), ([30.0], behind, 0.0)):
        data = fits.simulate(metal(0.3), fits.slices(incidence, outgoing), SINGLE)
        assert finest_step(data) == pytest.approx(step)


def test_parts_of_mixtures_have_limits_of_their_own():
    geometry = fits.slices([30.0], np.arange(-80.0, 81.0, 1.0))
    parts = {"smooth": metal(fits.Free(0.02, 1e-3, 0.1)), "rough": metal(fits.Free(0.3, 0.1, 1.0))}
    truth = lj.Mixture({"smooth": metal(0.005), "rough": metal(0.4)}, [0.2, 0.8])
    data = fits.simulate(truth, geometry, SINGLE, 0.01, 1e-4)
    found = fits.fit(lj.Mixture(parts, [0.2, 0.8]), data, transport=SINGLE, starts=4)
    assert list(instrument_limits(found)) == ["smooth.base.alpha"]


def brushed(alpha, alpha_y, tangent):
    return lj.Stack([], lj.Conductor(0.2, 3.0, alpha, alpha_y=alpha_y, tangent=tangent))


# a quarter turn of the tangent: beyond it the widths change places
FAMILY = brushed(fits.Free(0.3, 0.03, 1.0), fits.Free(0.3, 0.03, 1.0), fits.Free(0.0, -0.5, 1.0))


def fitted(wi, wo, values, sigma, family=FAMILY, **options):
    data = fits.Measurements(wi, wo, values, sigma, np.ones(len(wi), bool), ("grey",))
    return fits.fit(family, data, transport=SINGLE, noise=fits.Noise(discrepancy=False), starts=4, **options)


@pytest.mark.parametrize(("turns", "identified"), [([0.0], False), ([0.0, 45.0, 90.0], True)])
def test_one_plane_does_not_distinguish_the_width_across(turns, identified):
    """Of values along the tangent, known up to a factor: the width across is another. Then the sample is turned."""
    theta_i, theta_o = (angle.ravel() for angle in np.meshgrid([10.0, 30.0, 50.0, 70.0], np.linspace(-80, 80, 33)))
    wi = np.concatenate([lj.direction(theta_i, turn, degrees=True) for turn in turns])
    azimuths = [np.where(theta_o < 0, turn, turn + 180.0) for turn in turns]
    wo = np.concatenate([lj.direction(np.abs(theta_o), azimuth, degrees=True) for azimuth in azimuths])
    values = np.asarray(lj.evaluate(brushed(0.15, 0.4, 0.0), wi, wo, SINGLE))
    width = fits.Free(0.3, 0.03, 1.0)
    fit = fitted(wi, wo, values, NOISE * values + 1e-4, brushed(width, width, 0.0), scale=fits.Free(1.0, 0.2, 5.0))
    assert any("base.alpha_y" in direction.weights for direction in fit.unidentified) is not identified
    assert np.isfinite(fit.standard_errors["base.alpha_y"]) == identified
    assert fit.standard_errors["base.alpha"] < 0.001


@pytest.mark.slow
def test_pulls_of_a_table_are_of_unit_width(tmp_path):
    """A table in the format of RGL, noise of 2 %, 100 repeats: means are known to 0.1, standard deviations to 0.07."""
    fits.export(brushed(*BRUSHED.values()), tmp_path / "brushed.bsdf", "rgl", transport=SINGLE)
    table = fits.read(tmp_path / "brushed.bsdf")
    random = np.random.default_rng(5)
    pulls = []
    for _ in range(100):
        rows = random.choice(len(table.wi), 500, replace=False)
        wi, wo = table.wi[rows], table.wo[rows]
        exact = table.values[rows, :1]
        sigma = NOISE * exact + 1e-4
        fit = fitted(wi, wo, exact + sigma * random.standard_normal(exact.shape), sigma)
        pulls.append([(fit.values[name] - value) / fit.standard_errors[name] for name, value in BRUSHED.items()])
    mean, spread = np.mean(pulls, axis=0), np.std(pulls, axis=0)
    assert np.all(np.abs(mean) < 0.4)
    assert np.all(np.abs(spread - 1.0) < 0.28)
