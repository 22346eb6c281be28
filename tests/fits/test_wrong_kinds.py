"""Arguments of a wrong kind are refused in one line that names them, and files that are missing as such."""

import importlib
import pkgutil

import numpy as np
import pytest

import fits
import layerjax as lj

STACK = lj.Stack([], lj.Lambertian(fits.Free(0.5, 0.0, 1.0)))
PLAIN = lj.Stack([], lj.Lambertian(0.5))
VIEW = fits.slices(incidence=[20], outgoing=[-40, 10, 70])
DATA = fits.simulate(PLAIN, VIEW, noise=0.1)
FIT = fits.fit(STACK, DATA, starts=1)

FUNCTIONS = {
    "fit": {"stack": STACK, "data": DATA, "transport": "auto", "noise": None, "instrument": None},
    "Problem": {"stack": STACK, "data": DATA, "transport": "auto", "noise": fits.Noise(), "instrument": None},
    "search": {"data": DATA, "library": None, "noise": None},
    "simulate": {"stack": PLAIN, "geometry": VIEW, "transport": "auto", "noise": 0.1, "floor": 0.1},
    "predict": {"fitted": FIT, "at": VIEW},
    "sample": {"fit": FIT},
    "cross_validate": {"fit": FIT},
    "evidence": {"fit": FIT},
    "compare": {"candidates": {"one": FIT, "other": FIT}},
    "average": {"candidates": {"one": FIT}},
    "save_fit": {"fit": FIT},
    "export": {"material": FIT},
    "report": {"fit": FIT},
    "slices": {"incidence": 10.0, "outgoing": 10.0, "azimuth": 0.0},
    "Noise": {"relative": 0.1, "floor": 0.1, "degrees_of_freedom": 4.0},
    "Free": {
        "start": 0.5,
        "low": 0.0,
        "high": 1.0,
        "prior": None,
        "random_walk_sd": None,
        "same_for_all_texels": False,
    },
}

MORE = {"save_fit": {"directory": "there"}, "export": {"path": "there.csv", "to": "csv"}, "report": {"path": "there"}}
"""Places that nothing is written to."""

WRONG = {"class": lj.Stack, "string": "nothing", "number": 3j, "array": np.ones((3, 3)), "surface": lj.Lambertian(0.5)}

CASES = [
    (name, argument, kind)
    for name, arguments in FUNCTIONS.items()
    for argument in arguments
    for kind in WRONG
    if (name, kind) != ("slices", "array")
]


@pytest.mark.parametrize(("name", "argument", "kind"), CASES)
def test_it_is_refused_by_name(name, argument, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((TypeError, ValueError)) as caught:
        getattr(fits, name)(**FUNCTIONS[name] | MORE.get(name, {}) | {argument: WRONG[kind]})
    message = str(caught.value)
    assert argument in message
    assert "\n" not in message
    assert len(message) < 300
    assert not list(tmp_path.iterdir())


READERS = ("read", "read_slab", "read_problem", "read_library", "load_fit", "load_posterior", "open_map")


@pytest.mark.parametrize("name", READERS)
def test_a_missing_file_is_named(name, tmp_path):
    missing = tmp_path / "nowhere.csv"
    with pytest.raises(FileNotFoundError) as caught:
        getattr(fits, name)(missing)
    assert caught.value.filename == str(missing)


def test_missing_files_of_many_and_of_maps_are_named(tmp_path):
    stack, missing = tmp_path / "stack.toml", tmp_path / "nowhere"
    fits.write_problem(stack, STACK)
    fits.write_csv(DATA, tmp_path / "data.csv")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        fits.fit_files(missing, stack, tmp_path / "out")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        fits.fit_files(tmp_path / "data.csv", missing, tmp_path / "out")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npy"):
        fits.fit_map(STACK, VIEW, f"{missing}.npy", tmp_path / "map.zarr")


LAZY = [fits.__name__, *(f"fits.{one.name}" for one in pkgutil.iter_modules(fits.__path__) if one.ispkg)]


@pytest.mark.parametrize("name", LAZY)
def test_names_that_are_imported_later_are_listed(name):
    package = importlib.import_module(name)
    assert set(getattr(package, "__all__", ())) <= set(dir(package))
    assert {"__name__", "__path__"} <= set(dir(package))
