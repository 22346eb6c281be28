"""Arguments of a wrong kind or value are refused in one line that names them, and files that are missing as such."""

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
from tests.helpers.refusals import refuses

STACK = lj.Stack([], lj.Lambertian(fits.Free(0.5, 0.0, 1.0)))
PLAIN = lj.Stack([], lj.Lambertian(0.5))
VIEW = fits.slices(incidence=[20], outgoing=[-40, 10, 70])
DATA = fits.simulate(PLAIN, VIEW, noise=0.1)
FIT = fits.fit(STACK, DATA, starts=1)
FITTED = {"stack": STACK, "data": DATA}
MANY = {"files": "a.csv", "stacks": "a.toml", "out": "there"}
FREE = {"start": 0.5, "low": 0.0, "high": 1.0}
LAZY = [fits.__name__, *(f"fits.{one.name}" for one in pkgutil.iter_modules(fits.__path__) if one.ispkg)]
SWITCHES = [
    (name, one.name, "None" in str(one.annotation))
    for name in fits.__all__
    if callable(getattr(fits, name)) and name not in ("Fit", "Posterior", "Search")  # results, made by fits alone
    for one in inspect.signature(getattr(fits, name)).parameters.values()
    if one.annotation in (bool, bool | None, "bool", "bool | None")
]


def every_field(of: type) -> str:
    return " ".join(one.name for one in dataclasses.fields(of))


CALLS = {
    "fit": (FITTED, "stack data transport noise* instrument* starts seed progress* checkpoint* screen"),
    "Problem": (FITTED, "stack data transport noise* instrument*"),
    "read": ({}, "path"),
    "ReadOptions": ({}, "min_retro_angle* max_polar_angle* select hold_out"),
    **{name: ({}, "path") for name in ("read_slab", "read_problem", "read_library", "open_map")},
    **{name: ({}, "directory") for name in ("load_fit", "load_posterior")},
    "write_csv": ({"measurements": DATA, "path": "there.csv"}, "measurements path"),
    "write_problem": ({"path": "a.toml", "stack": STACK}, "path stack transport noise* scale* objective instrument*"),
    "save_fit": ({"fit": FIT, "directory": "there"}, "fit directory"),
    "export": ({"material": FIT, "path": "there.csv", "to": "csv"}, "material path to progress*"),
    "report": ({"fit": FIT, "path": "there.html"}, "fit path posterior* others* held_out* options"),
    "search": ({"data": DATA}, "data library* noise* seed options* directory* progress*"),
    "simulate": ({"stack": PLAIN, "geometry": VIEW, "noise": 0.1}, "stack geometry transport noise floor seed"),
    "predict": ({"fitted": FIT, "at": VIEW}, "fitted at draws seed"),
    "scores": ({"prediction": None, "measurements": DATA}, "prediction"),
    "sample": ({"fit": FIT}, "fit ess* sampler walkers* max_steps* options* seed path*"),
    "evidence": ({"fit": FIT}, "fit draws seed"),
    "cross_validate": ({"fit": FIT}, "fit draws seed options*"),
    "compare": ({"candidates": {"one": FIT, "other": FIT}}, "candidates options*"),
    "average": ({"candidates": {"one": FIT}}, "candidates weights* options*"),
    "default_library": ({}, "channels"),
    "render": ({"stack": PLAIN}, "stack size"),
    "fit_files": (MANY, "files stacks out processes read_options* starts seed progress*"),
    "fit_map": ({"stack": STACK, "geometry": VIEW, "values": DATA.values[None], "out": "there.zarr"}, "out options"),
    "slices": ({}, "incidence outgoing* azimuth"),
    "Joint": ({}, "parts"),
    "Noise": ({"tails": "student"}, "relative* floor* degrees_of_freedom use_sigma"),
    "Free": (FREE, "start low high prior* random_walk_sd* same_for_all_texels"),
    "Instrument": ({}, "source_aperture detector_aperture gain_sd* floor* rings*"),
    "Sphere": ({"diameter": 100.0, "sample": 10.0}, every_field(fits.Sphere)),
    "Spheres": ({}, "reflection* transmission* standard"),
    "Measurements": ({one.name: getattr(DATA, one.name) for one in dataclasses.fields(DATA)}, "values channels"),
    "Geometry": ({"wi": VIEW.wi, "wo": VIEW.wo}, "wi wo"),
    **{name: ({}, every_field(getattr(fits, name))) for name in ("ComparisonOptions", "FitOptions", "ReportOptions")},
    "SamplerOptions": ({}, every_field(fits.SamplerOptions).replace("walkers", "walkers*")),
    "SearchOptions": ({}, "layers starts beam cross_validated bic_gain fit"),
    "MapOptions": ({}, "starts seed emulator* processes"),
}
"""By function: what is given besides, and the arguments that are wrong; * after those which may be None."""

WRONG = {"class": lj.Stack, "word": "8", "complex": 3j, "None": None, "below 0": -1, "not a number": math.nan}
PATHS = ("path", "directory", "checkpoint", "out", "files", "stacks")
MAY_BE = {("slices", "below 0"), ("slices", "word"), ("Free", "below 0"), ("Free", "word")}

CASES = [
    (name, argument.rstrip("*"), kind)
    for name, (_, arguments) in CALLS.items()
    for argument in arguments.split()
    for kind in WRONG
    if not (kind == "None" and argument.endswith("*"))
    and not (kind == "word" and argument.rstrip("*") in PATHS)
    and (name, kind) not in MAY_BE
    and (argument, kind) != ("progress*", "class")
]


@pytest.mark.parametrize(("name", "argument", "kind"), CASES)
def test_it_is_refused_by_name(name, argument, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = CALLS[name][0] | {argument: WRONG[kind]}
    words = refuses(argument, getattr(fits, name), **given, error=(TypeError, ValueError))
    assert "\n" not in words
    assert len(words) < 300
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "argument", "optional"), SWITCHES)
def test_a_switch_is_true_or_false(name, argument, optional, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slab.rxt").write_text(RXT.format(spheres=0) + "1\n0.3\n")
    call = getattr(fits, name)
    if name in ("read_slab", "ReadOptions"):  # options are looked at as the file is read
        call = partial(fits.read if name == "ReadOptions" else fits.read_slab, "slab.rxt")
    for given in ("no", 0, *(() if optional else (None,))):
        options = CALLS.get(name, ({}, ""))[0] | {argument: given}
        assert "\n" not in refuses(rf"{argument}: {given!r} is not True.* or ", call, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["slab.rxt"]


@pytest.mark.parametrize("given", [np.ones((3, 3)), "data.csv", None])
def test_what_is_no_measurements_is_told_how_to_read_them(given):
    for call, first in ((fits.fit, (STACK,)), (fits.search, ()), (fits.predict, (FIT,))):
        refuses(r"is not a .*Measurements; fits\.read\(path\) reads a file, fits\.Meas", call, *first, given)


def test_missing_files_are_named(tmp_path):
    missing = tmp_path / "nowhere.csv"
    for name in ("read", "read_slab", "read_problem", "read_library", "load_fit", "load_posterior", "open_map"):
        with pytest.raises(FileNotFoundError) as caught:
            getattr(fits, name)(missing)
        assert caught.value.filename == str(missing)


@pytest.mark.parametrize("name", LAZY)
def test_names_that_are_imported_later_are_listed(name):
    package = importlib.import_module(name)
    assert set(getattr(package, "__all__", ())) <= set(dir(package))
    assert {"__name__", "__path__"} <= set(dir(package))
