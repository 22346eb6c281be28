"""The search for the stack behind data, by transports that are known and cheap."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fits
import layerjax as lj
from fits._files import locked
from fits.optimise.result import Fit
from fits.problem.compilation import cores
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.store import Store
from fits.structure_search import report
from fits.structure_search import search as structure_search
from fits.structure_search.library import Library
from fits.structure_search.search import STORE, SearchOptions, search
from tests.helpers.files import contents

LIBRARY = Library(
    layers={"interface": lj.Interface(Free(1.5, 1.05, 2.5), Free(0.3, 0.05, 1.0))},
    bases={
        "diffuse": lj.Stack([], lj.Lambertian(Free(0.3, 0.0, 1.0))),
        "metal": lj.Stack([], lj.Conductor(Free(1.5, 0.1, 5.0), Free(2.0, 0.1, 8.0), Free(0.3, 0.05, 1.0))),
    },
)
TRUTH = lj.Stack([lj.Interface(1.4, 0.25)], lj.Lambertian(0.3))
GIVEN = {"transport": lj.Statistical(), "noise": Noise(relative=0.03, floor=1e-6, discrepancy=False)}
OPTIONS = SearchOptions(layers=1, starts=2)
SHORT = SearchOptions(layers=0, starts=1)


@pytest.fixture(scope="module")
def data() -> fits.Measurements:
    geometry = fits.slices([10.0, 40.0, 70.0], np.arange(-75.0, 76.0, 6.0))
    return fits.simulate(TRUTH, geometry, lj.Statistical(), 0.03, 1e-6, seed=1)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("search") / "stacks"


@pytest.fixture(scope="module")
def found(data: fits.Measurements, directory: Path) -> fits.Search:
    return search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)


def test_the_stack_behind_the_data_is_found(found: fits.Search, directory: Path) -> None:
    assert found.best.name == "interface / diffuse"
    assert found.indistinguishable == ()
    assert found.options == OPTIONS
    assert found.ranking == tuple(one.name for one in found.candidates)
    assert set(found.ranking) == {"diffuse", "metal", "interface / diffuse", "interface / metal"}
    assert found.probabilities["interface / diffuse"] == found.best.model_score.model_probability > 0.999
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.best.bic == 0.0
    values, errors = found.best.fit.values, found.best.fit.standard_errors
    for name, truth in (("layers[0].ior", 1.4), ("layers[0].alpha", 0.25), ("base.albedo", 0.3)):
        assert abs(values[name] - truth) < 4.0 * errors[name]
    assert fits.load_fit(directory / "interface+diffuse+full").values == values


@pytest.mark.slow
def test_others_get_a_discrepancy_term(data: fits.Measurements, found: fits.Search) -> None:
    by_rule = GIVEN | {"noise": Noise(relative=0.03, floor=1e-6)}
    again = search(data, LIBRARY, options=OPTIONS, **by_rule)
    noise = {one.name: one.fit.problem.noise.discrepancy for one in again.candidates}
    assert not noise["interface / diffuse"]
    assert all(noise[name] for name in ("diffuse", "metal", "interface / metal"))
    assert again.best.name == found.best.name


def test_a_killed_search_resumes_and_finds_the_same(
    data: fits.Measurements, directory: Path, found: fits.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in the cross-validation of one of four structures: the next run makes that one again, and no other."""
    whole = Store.read(directory / STORE)
    with Store.open(directory / STORE, whole.fingerprint) as store:
        store.put("interface / diffuse", None)
    made: list[str] = []
    out_of_sample = structure_search.out_of_sample

    def interrupted(fit: Fit) -> object:
        made.append("one")
        if len(made) == 1:
            raise KeyboardInterrupt
        return out_of_sample(fit)

    monkeypatch.setattr(structure_search, "out_of_sample", interrupted)
    with pytest.raises(KeyboardInterrupt):
        search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)
    again = search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)
    assert len(made) == 2
    assert again.ranking == found.ranking
    for one, other in zip(again.candidates, found.candidates, strict=True):
        np.testing.assert_array_equal(one.fit.vector, other.fit.vector)
        assert one.model_score == other.model_score
    assert set(Store.read(directory / STORE).keys()) == set(whole.keys())


@pytest.mark.parametrize("correlated", [0.2, 1.0])
def test_the_options_of_its_fits_decide_on_a_discrepancy(data: fits.Measurements, correlated: float) -> None:
    """Residuals of a stack without the interface are correlated by more than 0.2, which is the default, and below 1."""
    library = Library(LIBRARY.layers, {"diffuse": LIBRARY.bases["diffuse"]})
    options = replace(SHORT, fit=fits.FitOptions(autocorrelation=correlated))
    found = search(data, library, transport=lj.Statistical(), noise=Noise(relative=0.03, floor=1e-6), options=options)
    assert bool(found.best.fit.problem.noise.discrepancy) == (correlated < 1.0)


def test_a_budget_of_time_ends_a_search_that_another_goes_on_with(data: fits.Measurements, tmp_path: Path) -> None:
    many = Library(LIBRARY.layers, {f"diffuse {k}": LIBRARY.bases["diffuse"] for k in range(2 * cores())})
    given = GIVEN | {"directory": tmp_path / "it"}
    short = search(data, many, options=replace(SHORT, budget=0.0), **given)
    assert short.stopped
    assert 0 < len(short.candidates) < len(many.bases)
    assert short.best.model_score is not None
    assert "The time budget ended the search" in " ".join(report.search_sentences(short))
    longer = search(data, many, options=replace(SHORT, budget=60.0), **given)
    assert not longer.stopped
    assert len(longer.candidates) == len(many.bases)


def test_every_structure_is_seen_by_the_instrument_and_another_search_is_refused(
    data: fits.Measurements, tmp_path: Path
) -> None:
    seen = fits.Instrument(detector_aperture=2.0, gain_sd=0.02)
    given = GIVEN | {"options": SHORT, "directory": tmp_path / "seen"}
    found = search(data, LIBRARY, instrument=seen, **given)
    assert len(found.candidates) == 2
    for one in found.candidates:
        assert replace(one.fit.problem.instrument, rings=None) == seen
        assert sum(name.startswith("instrument.gains") for name in one.fit.values) == 3
    before = contents(tmp_path)
    for other, message in (
        ({"instrument": None}, "instrument"),
        ({"instrument": seen, "seed": 1}, "seed 0, not 1"),
        ({"instrument": seen, "options": replace(SHORT, starts=3)}, "starts 1, not 3"),
        ({"instrument": seen, "options": replace(SHORT, fit=fits.FitOptions(same_cost=1.0))}, "fit"),
        ({"instrument": seen, "data": data.drop(incidence=10)}, "data"),
    ):
        with pytest.raises(ValueError, match=rf"holds the work of another problem \({message}"):
            search(**{"data": data, "library": LIBRARY, **given, **other})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious").touch()
    with pytest.raises(ValueError, match="is not empty, and holds no search"):
        search(data, LIBRARY, **GIVEN, directory=tmp_path / "other")
    store = tmp_path / "seen" / STORE
    with locked(store.with_name(f"{STORE}.lock"), "it"), pytest.raises(ValueError, match="in use by another process"):
        search(data, LIBRARY, instrument=seen, **given)
    store.write_bytes(before[str(store)][:6000])
    with pytest.raises(ValueError, match=rf"{STORE}: damaged"):
        search(data, LIBRARY, instrument=seen, **given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"layers": 9}, r"layers is 9; it must be a whole number in \[0, 6\]"),
        ({"starts": 0}, r"starts is 0; it must be a whole number in \[1, inf\]"),
        ({"beam": 0.5}, "beam is 0.5; it must be a whole number"),
        ({"bic_gain": float("nan")}, "bic_gain is nan; it must be a finite number of at least 0"),
        ({"budget": -1.0}, "budget is -1.0; it must be a finite number of at least 0"),
    ],
)
def test_bad_options_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SearchOptions(**options)


def test_it_is_reported_with_one_verdict(found: fits.Search, tmp_path: Path) -> None:
    """BIC, weight and probability had said one thing, and the score another."""
    table = report.search_table(found)
    assert table.rows[0][0] == "interface / diffuse"
    assert all(len(row) == len(table.columns) for row in table.rows)
    words = " ".join(report.search_sentences(found))
    assert "Of 4 models, interface / diffuse has the best cross-validated predictive score." in words
    assert "It is ahead of every other cross-validated model by more than the error of the difference." in words
    assert "indistinguishable" not in words
    near = " ".join(report.search_sentences(replace(found, indistinguishable=("metal",))))
    assert "It is statistically indistinguishable from metal (" in near
    assert "BIC, weight and probability do not overrule this" in near
    assert "It is ahead" not in near
    report.write_report(found, tmp_path)
    page = (tmp_path / report.PAGE).read_text()
    assert "interface / metal" in page
    assert "<h1>Stacks behind" in page
