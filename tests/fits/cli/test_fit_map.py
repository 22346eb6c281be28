"""`layerjax fit-map`: what it asks of `fits.fit_map`, what it prints, and bad input in one line."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import layerjax as lj
from fits.cli.parser import main
from fits.data.geometry import slices
from fits.maps.options import MapOptions, SpatialPrior
from fits.maps.store import FLAGS, FittedMap, open_map
from fits.problem.compilation import cores
from fits.problem.noise import Noise
from tests.helpers.commands import refused
from tests.helpers.map_files import ANGLES, MASK, SIGMA, VALUES, hdf5_file
from tests.helpers.painted_maps import numbers, stored, without

WORDS = ["fit-map", "map.npy", "--geometry", "view.csv", "--stack", "coat.toml", "--out", "coat.zarr"]


def found(folder: Path, failing: int = 0, chunks: int | None = None) -> FittedMap:
    """A store of ten texels: two masked, eight fitted, all but so many of these converged; or only its first chunks."""
    made = numbers((2, 5))
    place = np.arange(10.0).reshape(2, 5)
    made["values/base.albedo"], made["errors/base.albedo"] = place.copy(), 0.5 * place
    made["errors/base.albedo"][0, 0] = np.inf  # nothing holds it
    made["reduced_chi_square"] = 100.0 + place
    made["flags"][place < failing] &= ~np.uint16(FLAGS["converged"])
    without(made, place >= 8, "masked")
    return stored(folder / "found.zarr", made, (1, 5), chunks=chunks)


class Called:
    """In the place of `fits.fit_map`: keeps what it is called with."""

    def __init__(self, then: Callable[[], Any]) -> None:
        self.then, self.given = then, None

    def __call__(self, stack: Any, geometry: Any, values: Any, out: Any, **options: Any) -> Any:
        self.given = {"stack": stack, "geometry": geometry, "values": values, "out": out} | options
        options["options"].progress("texels", 5, 10)
        return self.then()


@pytest.fixture
def place(work: Path) -> Path:
    """A current directory with a map, its directions, and a stack file."""
    np.save(work / "map.npy", VALUES)
    np.save(work / "sigma.npy", SIGMA)
    np.save(work / "mask.npy", MASK)
    table = np.column_stack(list(ANGLES.values()))
    np.savetxt(work / "view.csv", table, delimiter=",", header=",".join(ANGLES), comments="")
    return work


@pytest.fixture
def in_place(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], Any]], Called]:
    def put(then: Callable[[], Any]) -> Called:
        module = ModuleType("fits.maps.fit_map")
        called = module.fit_map = Called(then)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "fits.maps.fit_map", module)
        return called

    return put


def test_defaults_and_options_arrive(place: Path, in_place: Any) -> None:
    made = found(place)
    called = in_place(lambda: made)
    assert main(WORDS) == 0
    assert called.given is not None
    given = dict(called.given)
    assert isinstance(given.pop("stack"), lj.Stack)
    assert isinstance(given.pop("transport"), lj.SingleScattering)
    options = given.pop("options")
    assert callable(options.progress)
    assert replace(options, progress=None) == MapOptions(processes=cores())
    places = {"geometry": "view.csv", "values": "map.npy", "out": "coat.zarr", "sigma": None, "mask": None}
    assert given == {**places, "noise": Noise(), "client": None}
    more = (
        "--sigma sigma.npy --mask mask.npy --noise 0.02 --starts 3 --seed 5 --pilot-texels 9 --chunk-size 100 --force"
    )
    some = "--processes 3 --emulator never --spatial-prior gaussian --spatial-scale 0.1"
    assert main([*WORDS, *more.split(), *some.split()]) == 0
    counts = {"starts": 3, "seed": 5, "pilot_texels": 9, "chunk_size": 100, "processes": 3}
    prior = SpatialPrior("gaussian", 0.1)
    wanted = MapOptions(**counts, emulator=False, force=True, spatial_prior=prior)
    assert replace(called.given["options"], progress=None) == wanted
    files = {"sigma": "sigma.npy", "mask": "mask.npy", "noise": Noise(relative=0.02)}
    assert {name: called.given[name] for name in files} == files
    words = "--scheduler tcp://10.0.0.1:8786 --emulator always --spatial-prior total_variation --spatial-rounds 3"
    assert main([*WORDS, *words.split(), "--spatial-scale", "base.albedo=0.1", "scale=1"]) == 0
    prior = SpatialPrior("total_variation", {"base.albedo": 0.1, "scale": 1.0}, 3)
    assert called.given["client"] == "tcp://10.0.0.1:8786"
    assert replace(called.given["options"], progress=None) == MapOptions(emulator=True, spatial_prior=prior)
    # the stack file says the rest
    more = "[noise]\nrelative = 0.1\ntails = 'student'\n[scale]\nstart = 1\nlow = 0.8\nhigh = 1.2\n"
    more += "same_for_all_texels = true\n[instrument]\ndetector_aperture = 2.0\n"
    (place / "coat.toml").write_text((place / "coat.toml").read_text() + more)
    assert main([*WORDS, "--noise", "0.03"]) == 0
    assert called.given["noise"] == Noise(relative=0.03, tails="student")
    assert called.given["options"].scale.same_for_all_texels
    assert called.given["options"].instrument.detector_aperture == 2.0


def test_a_map_is_fitted(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the function itself, from a file that holds the directions as well."""
    thickness, albedo = np.array([[0.5, 0.8, 1.2]]), np.array([[0.3, 0.5, 0.6]])
    view = slices(incidence=(10.0, 50.0), outgoing=np.arange(-60.0, 61.0, 20.0))
    stack = lj.Stack([lj.Medium(thickness[..., None], 0.8)], lj.Lambertian(albedo[..., None]))
    wi, wo = view.wi[:, None, None], view.wo[:, None, None]
    exact = np.moveaxis(np.asarray(lj.evaluate(stack, wi, wo, lj.SingleScattering())), 0, 2)
    hdf5_file(place / "map.h5", {"values": exact, "wi": view.wi, "wo": view.wo})
    words = ["fit-map", "map.h5", "--stack", "coat.toml", "--out", "coat.zarr", "--noise", "0.02"]
    words += ["--processes", "1", "--pilot-texels", "3", "--starts", "4", "--emulator", "never"]
    assert main(words) == 0
    fitted = open_map("coat.zarr")
    # readings without noise: how near a solver stops to the optimum is far below an error
    for name, truth in (("layers[0].thickness", thickness), ("base.albedo", albedo)):
        assert np.all(np.abs(fitted.values[name] - truth) < 0.05 * fitted.errors[name])
    assert main(words) == 0  # nothing is left to do
    capsys.readouterr()
    assert "coat.zarr" in refused([*words, "--seed", "1"], capsys, place)


def test_what_was_found_is_printed(place: Path, in_place: Any, capsys: pytest.CaptureFixture[str]) -> None:
    in_place(lambda: found(place))
    assert main(WORDS) == 0
    output = capsys.readouterr()
    lines = [line for line in output.out.splitlines() if line.strip()]
    rows = {line.split("  ")[0].strip(): line.split() for line in reversed(lines)}  # the first of each
    assert rows["of the map"][-1] == "10"
    assert rows["converged"][1] == "8"
    assert rows["masked"][1] == "2"
    # 0 to 7: quartiles 1.75, 3.5, 5.25; of the errors 0.5 to 3.5, the infinite one left out
    assert rows["base.albedo"][1:8] == ["1.75", "3.5", "5.25", "1.25", "2", "2.75", "1"]
    chi_square = next(line.split() for line in lines if line.strip().startswith("chi2/dof"))
    assert [word for word in chi_square if word[0].isdigit()][:3] == ["101.8", "103.5", "105.2"]
    assert rows["layers[0].f0"] == ["layers[0].f0", "0.04321", "0.00012", "1"]
    assert "layerjax report coat.zarr" in output.out
    assert "texels 5/10" in output.err


@pytest.mark.parametrize(("failing", "chunks"), [(1, None), (8, None), (0, 1)], ids=["7 of 8", "none", "unfinished"])
def test_a_map_that_did_not_converge_is_doubtful(place: Path, in_place: Any, failing: int, chunks: int | None) -> None:
    in_place(lambda: found(place, failing, chunks))
    assert main(WORDS) == 1


def test_an_interrupt_says_that_the_store_is_good(
    place: Path, in_place: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    in_place(interrupted)
    assert main(WORDS) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "layerjax: interrupted: what was fitted is in coat.zarr; the same command resumes it"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("map.npy=nowhere.npy", "nowhere.npy: no such file"),
        ("map.npy=.", "layerjax fit-many"),
        ("map.npy=data.csv", "data.csv: a map is one array"),
        ("map.npy=mask.npy", r"mask.npy has shape (5, 4), the geometry 6 pairs"),
        ("view.csv=nowhere.csv", "nowhere.csv: no such file"),
        ("view.csv=coat.toml", "coat.toml, line"),
        ("coat.toml=nowhere.toml", "nowhere.toml: no such file"),
        ("coat.zarr=coat.h5", "coat.h5: a fitted map can be written as .zarr only"),
        ("coat.zarr=no/such/coat.zarr", "no/such"),
        ("coat.zarr=file.zarr", "file.zarr: is a file"),
        ("--spatial-prior gaussian", "--spatial-prior gaussian needs --spatial-scale"),
        ("--spatial-scale 0.1", "--spatial-scale is given without --spatial-prior"),
        (
            "--spatial-prior gaussian --spatial-scale 0.1 scale=0.1",
            "one number for all parameters, or one for each name",
        ),
        ("--spatial-prior gaussian --spatial-scale scale=0", "SpatialPrior.scale['scale'] is 0.0; it must be a number"),
    ],
)
def test_bad_input_is_named(place: Path, capsys: pytest.CaptureFixture[str], words: str, message: str) -> None:
    """Of a file in the place of another, or of further options."""
    (place / "file.zarr").write_text("")
    change, more = ({}, words.split()) if words.startswith("--") else (dict([words.split("=")]), [])
    assert message in refused([*(change.get(word, word) for word in WORDS), *more], capsys, place)
