"""Proposals from a surrogate: the same posterior with fewer exact evaluations, whatever interrupts it."""

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from fits.data.geometry import slices
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.problem.simulate import simulate
from fits.sampling import ensemble, surrogate
from fits.sampling.chain import read_chain
from fits.sampling.design import SELDOM, Draws, Kept, mean_stay
from fits.sampling.laplace import Approximation
from fits.sampling.posterior import Posterior
from fits.sampling.sample import load, sample
from fits.sampling.surrogate import Evaluated, affordable_degrees, evaluate, fitted, monomials, term_count
from tests.helpers.files import largest_file
from tests.helpers.models import LINE, line, line_data

SHORT = {"walkers": 16, "seed": 1, "max_steps": 200, "surrogate": True}


@pytest.fixture(scope="module")
def short(result: Fit) -> Posterior:
    return sample(result, **SHORT)


def effective(posterior: Posterior) -> float:
    return float(posterior.effective_samples.min())


def test_monomials_are_all_products() -> None:
    z = np.array([2.0, 3.0, 5.0])
    cubic = monomials(z, 3)
    assert len(cubic) == term_count(3, 3) == len(set(cubic))
    assert sorted(cubic) == sorted(
        2.0**i * 3.0**j * 5.0**k for i in range(4) for j in range(4 - i) for k in range(4 - i - j)
    )
    np.testing.assert_array_equal(monomials(np.stack([z, 2.0 * z]), 3)[0], cubic)
    np.testing.assert_array_equal(monomials(np.array([3.0]), 4), [1.0, 3.0, 9.0, 27.0, 81.0])


def test_the_degree_follows_from_the_number_of_parameters() -> None:
    assert affordable_degrees(1, 100, 8.0) == [2, 3, 4]
    assert affordable_degrees(10, 100, 8.0) == [2, 3]
    assert affordable_degrees(30, 100, 8.0) == [2]
    assert affordable_degrees(40, 100, 8.0) == []
    assert affordable_degrees(5, 1_000_000, 8.0) == []


def test_a_polynomial_is_found_again(result: Fit) -> None:
    """The line is linear in its parameters: its surrogate is exact wherever points lie, but for a constant."""
    positions = Approximation.of(result).draw(np.random.RandomState(0), 64)
    points = Evaluated(positions, *(np.asarray(part) for part in result.problem.call(evaluate, positions)))
    found = fitted(result.problem.model, 2, points)
    near = positions[np.argsort(-points.log_posterior)[:40]]
    exact = [float(result.problem.log_posterior_unconstrained(u)) for u in near]
    assert np.std(np.array(exact) - [float(found.log_posterior_unconstrained(u)) for u in near]) < 1e-8


def test_how_long_a_chain_stays() -> None:
    """A step for the posterior itself; for a surrogate that is too narrow what independent proposals find."""
    generator = np.random.default_rng(0)
    count, narrow, hot = 2000, 0.7, 2.5

    def drawn(temperature: float) -> Draws:
        positions = narrow * np.sqrt(temperature) * generator.standard_normal((count, 1))
        heights = -0.5 * (positions[:, 0] / narrow) ** 2
        return Draws(positions, heights, heights / temperature)

    draws = drawn(1.0), drawn(hot), drawn(4.0)
    assert mean_stay(draws, [part.heights + 3.0 for part in draws]) == pytest.approx(1.0)
    there, here = draws[0].positions[:, 0], generator.standard_normal(count)
    ratio = (0.5 / narrow**2 - 0.5) * (there**2 - here[:, None] ** 2)
    exact = [-0.5 * part.positions[:, 0] ** 2 for part in draws]
    stays = 1.0 / np.maximum(np.exp(np.minimum(ratio, 0.0)).mean(axis=1), SELDOM)
    assert mean_stay(draws, exact) == pytest.approx(stays.mean(), rel=5 * stays.std() / np.sqrt(count))
    assert mean_stay(draws, [np.full(count, -np.inf)] * 3) == np.inf


def striped(stack, wi, wo):
    """A line that explains the data on stripes only that are much narrower than its errors: no polynomial does that."""
    return line(stack, wi, wo) + jnp.where(jnp.sin(2000.0 * stack["a"]) < 0.8, 0.2, 0.0) * wo[:, :1]


def test_a_surrogate_that_does_not_hold_is_left_out(result: Fit) -> None:
    fitted = dataclasses.replace(result, problem=Problem(LINE, line_data(), striped))
    notes = []
    posterior = sample(
        fitted,
        **SHORT | {"allow_unconverged": True},
        progress=lambda stage, done, total, note: notes.append((stage, note)),
    )
    assert "does not hold" in posterior.status
    assert "left out" in posterior.status
    assert ("surrogate", "") in notes
    plain = sample(fitted, **SHORT | {"allow_unconverged": True, "surrogate": False})
    np.testing.assert_array_equal(posterior.chain, plain.chain)


def test_a_model_that_is_finite_at_its_best_alone_has_no_surrogate(result: Fit) -> None:
    best = result.values["['a']"]

    def finite_there(stack, wi, wo):
        return line(stack, wi, wo) + jnp.where(jnp.abs(stack["a"] - best) < 1e-4, 0.0, jnp.nan)

    fitted = dataclasses.replace(result, problem=Problem(LINE, line_data(), finite_there))
    posterior = sample(fitted, **SHORT | {"allow_unconverged": True})
    assert posterior.status == "no surrogate, for want of finite values about the best fit"
    assert len(posterior.chain) == 200


def test_more_parameters_than_a_surrogate_can_have(result: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surrogate, "MOST_TERMS", 3)
    posterior = sample(result, **SHORT | {"allow_unconverged": True})
    assert posterior.status == "no surrogate of 2 parameters: exact evaluations alone"
    assert len(posterior.chain) == 200


def test_it_is_chosen_by_the_clock(result: Fit, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And the chain remembers it, whatever the clock says later."""
    path, options = (
        tmp_path / "chain.h5",
        {"walkers": 16, "seed": 1, "path": tmp_path / "chain.h5", "allow_unconverged": True},
    )
    monkeypatch.setattr(ensemble, "COSTLY", 0.0)
    sample(result, **options, max_steps=100)
    monkeypatch.setattr(ensemble, "COSTLY", math.inf)
    assert sample(result, **options, max_steps=200).status.startswith("proposals from a surrogate")
    with pytest.raises(ValueError, match=r"\(surrogate differs\)"):
        sample(result, **options, surrogate=False)
    assert len(load(result, path).chain) == 200
    assert sample(result, **options, max_steps=100, resume=False).status == ""
    with pytest.raises(ValueError, match=r"\(surrogate differs\)"):
        sample(result, **options, surrogate=True)


@pytest.mark.parametrize(("seconds", "costly"), [([0.01] * 5 + [3e-4], False), ([1e-3] * 200, True)])
def test_one_quick_look_is_enough(monkeypatch: pytest.MonkeyPatch, seconds: list[float], costly: bool) -> None:
    """A clock of our own: a look at three points takes what is said here, whatever else the machine does."""
    passed, looks = [0.0], iter(seconds)

    class Timed:
        def call(self, *_: object) -> float:
            passed[0] += next(looks)
            return 0.0

    monkeypatch.setattr(ensemble, "COSTLY", 200e-6)
    monkeypatch.setattr(ensemble.time, "perf_counter", lambda: passed[0])
    assert ensemble.is_costly(Timed(), np.zeros((3, 2))) == costly


def test_it_goes_on_from_its_file_to_the_same_end(result: Fit, short: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    sample(result, path=path, **SHORT | {"max_steps": 120})
    assert {entry.name for entry in tmp_path.iterdir()} == {"chain.h5"}
    assert {"root", "centre", "whiten", "radius", "weights", "degree"} <= set(read_chain(path)["moves"])
    whole = sample(result, path=path, **SHORT)
    np.testing.assert_array_equal(whole.chain, short.chain)
    assert whole.status == short.status


class Stop(Exception):
    pass


@pytest.mark.parametrize("after", [700, *(pytest.param(after, marks=pytest.mark.slow) for after in (1, 300))])
def test_interrupted_building_goes_on_to_the_same_chain(
    result: Fit, short: Posterior, tmp_path: Path, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And evaluates no point of a whole round again: there are two, of 256 and 512 points."""
    done, call = [], Problem.call

    def counted(self, function, *arguments):
        if function is evaluate:
            done.append(len(arguments[0]))
        return call(self, function, *arguments)

    def stop(stage: str, evaluations: int, total: int | None, note: str) -> None:
        if stage == "surrogate" and evaluations >= after:
            raise Stop

    monkeypatch.setattr(Problem, "call", counted)
    sample(result, **SHORT)
    at_once, path = sum(done), tmp_path / "chain.h5"
    with pytest.raises(Stop):
        sample(result, path=path, **SHORT, progress=stop)
    (tmp_path / ".chain.surrogate.abcd1234").write_bytes(b"half of a file, as a killed process leaves it")
    assert path.with_suffix(".surrogate").is_file() == (after > 256)
    done.clear()
    np.testing.assert_array_equal(sample(result, path=path, **SHORT).chain, short.chain)
    assert [entry.name for entry in tmp_path.iterdir()] == ["chain.h5"]
    assert sum(done) == at_once - (after > 256) * 256


def test_rounds_of_another_posterior_or_damaged_ones_are_made_again(result: Fit, tmp_path: Path) -> None:
    points = Evaluated(np.zeros((2, 2)), np.zeros((2, 3)), np.zeros(2))
    path = tmp_path / "chain.surrogate"
    Kept(path, {"seed": 1}).add(points)
    assert len(Kept(path, {"seed": 1}).rounds) == 1
    assert not Kept(path, {"seed": 2}).rounds
    path.write_bytes(path.read_bytes()[:-1])
    assert not Kept(path, {"seed": 1}).rounds


def test_a_full_disk_keeps_what_was_evaluated(result: Fit, short: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    with largest_file(40_000), pytest.raises(OSError, match="too large") as error:
        sample(result, path=path, **SHORT)
    assert error.value.filename == str(tmp_path / "chain.surrogate")
    assert {entry.name for entry in tmp_path.iterdir()} <= {"chain.h5", "chain.surrogate"}
    np.testing.assert_array_equal(sample(result, path=path, **SHORT).chain, short.chain)


def test_a_chain_of_another_transport_is_refused(result: Fit, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    sample(result, path=path, **SHORT)
    before = path.read_bytes()
    other = fit(LINE, line_data(), transport=lambda stack, wi, wo: 1.001 * line(stack, wi, wo), starts=2)
    with pytest.raises(ValueError, match=r"another problem or setting \(posterior differs\)"):
        sample(other, path=path, **SHORT)
    assert path.read_bytes() == before


@pytest.mark.slow
def test_all_orders_of_a_coated_medium() -> None:
    """Thickness and asymmetry trade against each other; as many effective samples as evaluations allow."""
    transport = lj.AddingDoubling(nodes=6, modes=6)

    def stack(ior, alpha, thickness, g, base):
        medium = lj.Medium(thickness=thickness, albedo=0.95, phase=lj.HenyeyGreenstein(g=g))
        return lj.Stack([lj.Interface(ior=ior, alpha=alpha), medium], base=lj.Lambertian(albedo=base))

    geometry = slices(incidence=(10, 30, 50, 70), outgoing=np.linspace(-80, 80, 35))
    data = simulate(stack(1.5, 0.2, 1.0, 0.5, 0.3), geometry, transport=transport, noise=0.02, seed=0)
    free = stack(
        Free(1.5, 1.2, 2.2), Free(0.2, 0.05, 0.8), Free(1.0, 0.02, 10.0), Free(0.5, -0.5, 0.95), Free(0.3, 0.0, 1.0)
    )
    fitted = fit(free, data, transport=transport, starts=1)
    posterior = sample(fitted, seed=1, ess=1000, max_steps=1000, surrogate=True)
    assert "surrogate of degree" in posterior.status
    assert effective(posterior) >= 1000
    assert effective(posterior) > 0.2 * posterior.chain[..., 0].size
