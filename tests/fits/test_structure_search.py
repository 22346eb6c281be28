"""The search for the stack behind data, by transports that are known and cheap, and the libraries that it takes."""

from dataclasses import replace
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest

import fits
import layerjax as lj
from fits import Free, Library, Noise, SearchOptions, default_library, read_library, search, structure_search
from fits._files import locked
from fits.prediction import cross_validation
from fits.problem.parameters import names_of, split
from fits.store import Store
from fits.structure_search import STORE
from tests.helpers.files import contents
from tests.helpers.refusals import refuses

COAT, BASE = lj.Medium(Free(1.0, 0.05, 5.0), 0.8), lj.Stack([], lj.Lambertian(Free(0.5, 0.0, 1.0)))
METAL = lj.Stack([], lj.Conductor(Free(1.5, 0.1, 5.0), Free(2.0, 0.1, 8.0), Free(0.3, 0.05, 1.0)))
LIBRARY = Library({"haze": COAT}, {"diffuse": BASE, "metal": METAL})
TRUTH = lj.Stack([lj.Medium(0.6, 0.8)], lj.Lambertian(0.4))
GIVEN = {"transport": lj.SingleScattering(), "noise": Noise(relative=0.01, floor=1e-6, discrepancy=False)}
BY_RULE = GIVEN | {"noise": Noise(relative=0.01, floor=1e-6)}
OPTIONS, SHORT = SearchOptions(layers=1, starts=2), SearchOptions(layers=0, starts=1)
INTERFACE = '[layers.coat]\nkind = "Interface"\nior = { start = 1.5, low = 1.1, high = 2.0 }\nalpha = 0.3\n'
DIFFUSE = '[bases.diffuse]\nkind = "Lambertian"\nalbedo = { start = 0.2, low = 0.0, high = 1.0 }\n'


@pytest.fixture(scope="module")
def data():
    geometry = fits.slices([10.0, 40.0, 70.0], np.arange(-75.0, 76.0, 6.0))
    return fits.simulate(TRUTH, geometry, lj.SingleScattering(), 0.01, 1e-6, seed=1)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("search") / "stacks"


@pytest.fixture(scope="module")
def found(data, directory):
    return search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)


def test_the_stack_behind_the_data_is_found(found, directory):
    assert (found.best.name, found.best.bic, found.indistinguishable) == ("haze / diffuse", 0.0, ())
    assert found.options == OPTIONS
    assert {one.name for one in found.candidates} == {"diffuse", "metal", "haze / diffuse", "haze / metal"}
    assert found.probabilities["haze / diffuse"] == found.best.model_score.model_probability > 0.999
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    values, errors = found.best.fit.values, found.best.fit.standard_errors
    for name, truth in (("layers[0].thickness", 0.6), ("base.albedo", 0.4)):
        assert abs(values[name] - truth) < 4.0 * errors[name]
    assert fits.load_fit(directory / "haze+diffuse+full").values == values


def test_a_killed_search_resumes_and_finds_the_same(data, directory, found, monkeypatch):
    """Killed as it holds out incidences of one of four structures: the next run does this one, and no other."""
    whole = Store.read(directory / STORE)
    with Store.open(directory / STORE, whole.fingerprint) as store:
        store.put("haze / diffuse", None)
    made = Mock(wraps=cross_validation.refit, side_effect=[DEFAULT, KeyboardInterrupt, *[DEFAULT] * 3])
    monkeypatch.setattr(cross_validation, "refit", made)
    with pytest.raises(KeyboardInterrupt):
        search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)
    again = search(data, LIBRARY, options=OPTIONS, directory=directory, **GIVEN)
    assert made.call_count == 5
    for one, other in zip(again.candidates, found.candidates, strict=True):
        assert (one.name, one.model_score) == (other.name, other.model_score)
        np.testing.assert_array_equal(one.fit.vector, other.fit.vector)


@pytest.mark.parametrize("correlated", [pytest.param(0.2, marks=pytest.mark.slow), 1.0])
def test_the_options_of_its_fits_decide_on_a_discrepancy(data, correlated):
    """Residuals of a stack without the haze are correlated by more than 0.2, which is the default, and below 1."""
    options = replace(SHORT, fit=fits.FitOptions(autocorrelation=correlated))
    one = search(data, Library({"haze": COAT}, {"diffuse": BASE}), options=options, **BY_RULE)
    assert bool(one.best.fit.problem.noise.discrepancy) == (correlated < 1.0)


def test_every_structure_has_the_instrument_and_another_search_is_refused(data, tmp_path):
    instrument = fits.Instrument(gain_sd=0.02)
    given = {"data": data, "library": Library({"haze": COAT}, {"diffuse": BASE}), **GIVEN, "instrument": instrument}
    given |= {"options": SHORT, "directory": tmp_path / "it"}
    for one in search(**given).candidates:
        assert one.fit.problem.instrument == instrument
        assert sum(name.startswith("instrument.gains") for name in one.fit.values) == 3
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious").touch()
    before, store = contents(tmp_path), tmp_path / "it" / STORE

    def refused(message, **changes):
        refuses(message, search, **given | changes)

    another = r"holds the work of another problem \("
    refused(f"{another}instrument", instrument=None)
    refused(f"{another}seed 0, not 1", seed=1)
    refused(f"{another}starts 1, not 3", options=replace(SHORT, starts=3))
    refused(f"{another}fit", options=replace(SHORT, fit=fits.FitOptions(same_cost=1.0)))
    refused(f"{another}data", data=data.drop(incidence=10))
    refused(r"is not empty, and holds no search\.store", directory=tmp_path / "other")
    with locked(store.with_name(f"{STORE}.lock"), "it"):
        refused("in use by another process")
    store.write_bytes(before[str(store)][:6000])
    refused(rf"{STORE}: damaged")
    refuses("layers: 9 is not a whole number from 0 to 6", SearchOptions, layers=9)


def test_it_is_reported_with_one_verdict(found):
    """BIC, weight and probability had said one thing, and the score another."""
    table = structure_search.search_table(found)
    assert table.rows[0][0] == "haze / diffuse"
    assert "others were fitted with independent noise only" in table.note or len(table.rows) == len(found.candidates)
    words = " ".join(structure_search.search_sentences(found))
    assert "Of 4 models, haze / diffuse has the best cross-validated predictive score. It is ahead of every" in words
    assert "indistinguishable" not in words
    close = {one: replace(one, model_score=replace(one.model_score, clear_diff=-1.0)) for one in found.candidates[:2]}
    near = replace(found, candidates=tuple(close.get(one, one) for one in found.candidates))
    assert near.indistinguishable == (found.candidates[1].name,)
    near = " ".join(structure_search.search_sentences(near))
    assert f"It is statistically indistinguishable from {found.candidates[1].name} (" in near
    assert "BIC, weight and probability do not overrule this" in near
    assert "It is ahead" not in near


# ---- libraries ----


def test_stacks_of_the_default_are_put_together_from_the_top():
    library = default_library()
    layers = library.stack(("haze", "interface", "pigment")).layers
    assert [type(layer).__name__ for layer in layers] == ["Medium", "Interface", "Medium"]
    assert library.stack(("metal",)).base is library.bases["metal"].base
    for channels in (1, 3):  # every part is free, and has as many colours
        library = default_library(channels)
        for base in library.bases:
            assert all(split(library.stack((layer, base)))[1] for layer in library.layers)
        names = names_of(split(library.stack(("particles", "diffuse")))[1])
        assert sum("albedo" in name for name in names) == 2 * channels


def test_a_file_says_the_same(tmp_path):
    deep = '[[bases.deep.layers]]\nkind = "Medium"\nthickness = 50.0\nalbedo = 0.5\n'
    (tmp_path / "library.toml").write_text(INTERFACE + DIFFUSE + deep)
    library = read_library(tmp_path / "library.toml")
    assert (set(library.layers), set(library.bases)) == ({"coat"}, {"diffuse", "deep"})
    assert library.stack(("coat", "diffuse")).layers[0].ior == Free(1.5, 1.1, 2.0)
    assert library.stack(("coat", "deep")).base is None


def test_bad_files_are_refused(tmp_path):
    for text, message in (
        (DIFFUSE, "it has no layers"),
        (INTERFACE, "it has no bases"),
        (INTERFACE.replace("Interface", "Lambertian"), "layers.coat: layers.0..kind is 'Lambertian'"),
        (INTERFACE.replace("alpha", "alhpa"), "alhpa"),
        ('[bases.flat]\nkind = "Lambertian"\n' + INTERFACE, "bases.flat"),
        ("[stack]\n", "stack"),
        (INTERFACE + DIFFUSE.replace("diffuse", "coat"), "'coat' is there twice; names must differ"),
        (INTERFACE + DIFFUSE + DIFFUSE.replace("diffuse", "Diffuse"), "'diffuse' is there twice"),
    ):
        (tmp_path / "library.toml").write_text(text)
        words = refuses(message, read_library, tmp_path / "library.toml")
        assert words.startswith(str(tmp_path / "library.toml"))
