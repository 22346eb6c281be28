"""Mixtures in fits: as files, by the names of their parameters, and recovered from simulated measurements."""

from pathlib import Path

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.reports.html import FitReport

FILE = """\
transport = "SingleScattering"

[mixture.dust]
weight = { start = 0.5, low = 0.0, high = 1.0 }
layers = [{ kind = "Medium", thickness = { start = 1.0, low = 0.1, high = 5.0 }, albedo = 0.6 }]
base = { kind = "Lambertian", albedo = 0.1 }

[mixture.metal.base]
kind = "Conductor"
ior = 0.2
k = 3.0
alpha = { start = 0.4, low = 0.1, high = 1.0 }
"""
TRUTH = {"dust.layers[0].thickness": 0.6, "metal.base.alpha": 0.25, "weights.dust": 0.3}
GEOMETRY = fits.slices([10.0, 50.0], np.arange(-75.0, 76.0, 7.5))
SINGLE = lj.SingleScattering()


def test_files_are_read_fitted_and_written(tmp_path: Path) -> None:
    thickness, alpha, weight = TRUTH.values()
    dust = lj.Stack([lj.Medium(thickness, 0.6)], lj.Lambertian(0.1))
    mixed = lj.Mixture({"dust": dust, "metal": lj.Stack([], lj.Conductor(0.2, 3.0, alpha))}, [weight, None])
    data = fits.simulate(mixed, GEOMETRY, SINGLE, 0.03, 1e-4)
    (tmp_path / "dusty.toml").write_text(FILE)
    given = fits.read_problem(tmp_path / "dusty.toml")
    fits.write_problem(tmp_path / "again.toml", given.stack, transport=given.transport)
    again = fits.read_problem(tmp_path / "again.toml")
    one, other = (fits.Problem(each.stack, data, each.transport) for each in (given, again))
    assert one.names == other.names == tuple(TRUTH)
    np.testing.assert_array_equal([one.start, one.low], [other.start, other.low])
    np.testing.assert_allclose(one.predict(one.start), other.predict(other.start))
    found = fits.fit(given.stack, data, transport=SINGLE, starts=1)
    for name, truth in TRUTH.items():
        assert abs(found.values[name] - truth) < 4.0 * found.standard_errors[name]
    fits.save_fit(found, tmp_path / "result")
    assert tuple(fits.load_fit(tmp_path / "result").values) == tuple(TRUTH)
    assert "[mixture.dust]" in FitReport(found).page()


WEIGHT = "weight = { start = 0.5, low = 0.0, high = 1.0 }"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "high = 1.0 }\nlayers",
            "high = 1.2 }\nlayers",
            r"mixture.dust.weight.high is 1.2, must be a number in \[0, 1\]",
        ),
        ("weight = {", "weight = 0.3\nwait = {", r"mixture.dust has an unknown key 'wait' \(did you mean 'weight'\?\)"),
        ("albedo = 0.1", "albedo = 1.1", r"mixture.dust.base: Lambertian.albedo: 1.1 is outside \[0, 1\]"),
        ("[mixture.metal.base]", "[mixture.metal]\nweight = 0.2\n[mixture.metal.base]", "one has to be free of choice"),
        ("[mixture.metal.base]", "[base]", "mixture is a whole material, must stand without base"),
        (WEIGHT, "", "mixture: Mixture.weights: 2 are None"),
        (WEIGHT, "weight = [0.1, 0.2]", r"mixture.dust.weight is \[0.1, 0.2\]; it must be a number in \[0, 1\]"),
    ],
)
def test_bad_files_are_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(FILE.replace(old, new))
    with pytest.raises(ValueError, match=message):
        fits.read_problem(tmp_path / "bad.toml")
