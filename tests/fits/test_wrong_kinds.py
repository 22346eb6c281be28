"""Arguments of a wrong kind are refused in one line that names them, and files that are missing as such."""

import dataclasses
import importlib
import inspect
import math
import pkgutil
from functools import partial

import numpy as np
import pytest

import fits
import layerjax as lj
from tests.helpers.data_files import RXT

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


KEYWORDS = {
    "fit": (FUNCTIONS["fit"], "starts seed progress* checkpoint* screen"),
    "read": ({}, "path"),
    "ReadOptions": ({}, "min_retro_angle* max_polar_angle* select hold_out"),
    **{name: ({}, "path") for name in ("read_slab", "read_problem", "read_library", "open_map")},
    **{name: ({}, "directory") for name in ("load_fit", "load_posterior")},
    "write_csv": ({"measurements": DATA, "path": "there.csv"}, "measurements path"),
    "write_problem": (
        {"path": "there.toml", "stack": STACK},
        "path stack transport noise* scale* objective instrument*",
    ),
    "save_fit": ({"fit": FIT}, "directory"),
    "export": ({"material": FIT, "path": "there.csv", "to": "csv"}, "path to progress*"),
    "report": ({"fit": FIT, "path": "there.html"}, "path posterior* others* held_out* options"),
    "search": ({"data": DATA}, "seed options* directory* progress*"),
    "simulate": (FUNCTIONS["simulate"], "noise floor seed"),
    "predict": (FUNCTIONS["predict"], "draws seed"),
    "scores": ({"prediction": None, "measurements": DATA}, "prediction"),
    "sample": ({"fit": FIT}, "ess* sampler walkers* max_steps* options* seed path*"),
    "evidence": ({"fit": FIT}, "draws seed"),
    "cross_validate": ({"fit": FIT}, "draws seed options*"),
    "compare": (FUNCTIONS["compare"], "options*"),
    "average": (FUNCTIONS["average"], "weights* options*"),
    "default_library": ({}, "channels"),
    "render": ({"stack": PLAIN}, "stack size"),
    "fit_files": (
        {"files": "a.csv", "stacks": "a.toml", "out": "there"},
        "files stacks out processes search read_options* starts seed progress*",
    ),
    "fit_map": ({"stack": STACK, "geometry": VIEW, "values": DATA.values[None], "out": "there.zarr"}, "out options"),
    "Joint": ({}, "parts"),
    "Noise": ({}, "use_sigma"),
    "Sphere": ({"diameter": 100.0, "sample": 10.0}, "diameter sample entrance detector wall detector_reflectance"),
    "Spheres": ({}, "reflection* transmission* standard"),
    "Measurements": ({one.name: getattr(DATA, one.name) for one in dataclasses.fields(DATA)}, "values channels"),
    "Geometry": ({"wi": VIEW.wi, "wo": VIEW.wo}, "wi wo"),
    "SamplerOptions": (
        {},
        "ess autocorrelation_times r_hat max_steps walkers* burn_in independent warm_up smallest_mode",
    ),
    "ComparisonOptions": ({}, " ".join(one.name for one in dataclasses.fields(fits.ComparisonOptions))),
    "ReportOptions": ({}, " ".join(one.name for one in dataclasses.fields(fits.ReportOptions))),
    "SearchOptions": ({}, "layers starts beam cross_validated bic_gain budget* fit"),
    "MapOptions": ({}, "starts seed emulator* processes"),
}
"""By function: what is given besides, and the arguments that are wrong; * after those which may be None."""

UNFIT = {"a number as a word": "8", "None": None, "below 0": -1, "not a number": math.nan}
PATHS = ("path", "directory", "checkpoint", "out", "files", "stacks")

UNFIT_CASES = [
    (name, argument.rstrip("*"), kind)
    for name, (_, arguments) in KEYWORDS.items()
    for argument in arguments.split()
    for kind in UNFIT
    if not (kind == "None" and argument.endswith("*"))
    and not (kind == "a number as a word" and argument.rstrip("*") in PATHS)
]


@pytest.mark.parametrize(("name", "argument", "kind"), UNFIT_CASES)
def test_unfit_arguments_are_refused_by_name(name, argument, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=argument) as caught:
        getattr(fits, name)(**KEYWORDS[name][0] | {argument: UNFIT[kind]})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    assert not list(tmp_path.iterdir())


BY_THE_PROGRAM = ("Fit", "Posterior", "Search")
"""Results, which nobody else makes."""

SWITCHES = [
    (name, one.name, "None" in str(one.annotation))
    for name in fits.__all__
    if callable(getattr(fits, name)) and name not in BY_THE_PROGRAM
    for one in inspect.signature(getattr(fits, name)).parameters.values()
    if one.annotation in (bool, bool | None, "bool", "bool | None")
]


@pytest.mark.parametrize(("name", "argument", "optional"), SWITCHES)
def test_a_switch_is_true_or_false(name, argument, optional, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slab.rxt").write_text(RXT.format(spheres=0) + "1\n0.3\n")
    call, more = getattr(fits, name), KEYWORDS.get(name, (FUNCTIONS.get(name, {}), ""))[0]
    if name in ("read_slab", "ReadOptions"):  # options are looked at as the file is read
        call = partial(fits.read if name == "ReadOptions" else fits.read_slab, "slab.rxt")
    for given in ("no", 0, *(() if optional else (None,))):
        with pytest.raises(ValueError, match=rf"{argument}: {given!r} is not True.* or ") as caught:
            call(**MORE.get(name, {}) | more | {argument: given})
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["slab.rxt"]


def test_so_are_those_of_measurements():
    for method in (DATA.select, DATA.drop):
        with pytest.raises(ValueError, match="in_plane: 'no' is not True, False or None"):
            method(in_plane="no")


@pytest.mark.parametrize("given", [np.ones((3, 3)), "data.csv", None])
def test_what_is_no_measurements_is_told_how_to_read_them(given):
    for call in (lambda: fits.fit(STACK, given), lambda: fits.search(given), lambda: fits.predict(FIT, given)):
        with pytest.raises(
            ValueError, match=r"is not a .*Measurements; fits\.read\(path\) reads a file, fits\.Measurements\("
        ):
            call()


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
