"""Cases of `benchmarks pulls`: few repeats of one, and a table that is read back."""

import numpy as np
import pytest

import fits
import layerjax as lj
from benchmarks.studies.pulls import cases, run


@pytest.mark.slow
def test_a_mixture_is_recovered():
    case = next(cases.of_mixtures(6))
    rows = run.run_case("mixtures", case)
    assert {row.parameter for row in rows} == set(case.problem.names)
    for row in rows:
        assert row.repeats == 6
        assert row.typical == pytest.approx(row.truth, abs=5.0 * row.error)
    assert "coat on 30% of a metal" in run._table(rows, of_tables=False)


@pytest.mark.slow
def test_an_instrument_is_part_of_one_problem_and_not_of_the_other():
    found, without = (case for case, _ in zip(cases.by_instruments(2), range(2), strict=False))
    assert found.truth["instrument.tilt"] == cases.TILT
    assert "instrument.tilt" in found.problem.names
    assert not any(name.startswith("instrument") for name in without.problem.names)
    np.testing.assert_array_equal(found.values, without.values)


def test_tables_hold_their_materials(tmp_path):
    stack, free = cases.materials()["velvet"]
    path = tmp_path / "velvet.binary"
    cases.write_table(path, stack)
    data = fits.read(path, bins=40)
    expected = lj.evaluate(stack, data.wi, data.wo, lj.SingleScattering())
    np.testing.assert_allclose(data.values, np.broadcast_to(expected, data.values.shape), rtol=1e-9)
    problem = fits.Problem(free, data, cases.carrier(free), noise=fits.Noise(relative=0.1))
    assert cases._numbers(stack, free) == [1.0, 0.7, 0.3, 0.1]
    assert problem.names == ("layers[0].thickness", "layers[0].albedo", "layers[0].phase.alpha", "base.albedo")
