"""`layerjax fit-map`: what it asks of `fits.fit_map`, what it prints, and bad input in one line."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import layerjax as lj
from fits import Free, MapOptions, Noise, SpatialPrior
from fits.cli.parser import main
from fits.maps.store import FLAGS
from tests.helpers.commands import refused
from tests.helpers.painted_maps import numbers, stored, without

WORDS = ["fit-map", "map.npy", "--geometry", "view.csv", "--stack", "coat.toml", "--out", "coat.zarr"]


def made(path, failing=0, chunks=None):
    """A store of ten texels: two masked, eight fitted, all but so many of these converged; or only its first chunks."""
    arrays, place = numbers((2, 5)), np.arange(10.0).reshape(2, 5)
    arrays["values/base.albedo"] = place.copy()
    arrays["flags"][place < failing] &= ~np.uint16(FLAGS["converged"])
    without(arrays, place >= 8, "masked")
    shutil.rmtree(path, ignore_errors=True)
    return stored(path, arrays, (1, 5), chunks=chunks)


@pytest.fixture
def place(work):
    """A current directory with a map, its directions, and a stack file."""
    np.save(work / "map.npy", np.ones((5, 1)))
    (work / "view.csv").write_text("theta_i,phi_i,theta_o,phi_o\n10,180,20,0\n")
    return work


@pytest.fixture
def run(place, monkeypatch):
    """The command with further words, and a map that is made up: its exit code, and what `fits.fit_map` is given."""

    def run(words="", **state):
        given = {}

        def fit_map(*arguments, options, **rest):
            given.update(zip(("stack", "geometry", "values", "out"), arguments, strict=True), **rest)
            given["options"] = replace(options, progress=None)
            options.progress("texels", 5, 10)
            return made(place / "found.zarr", **state)

        monkeypatch.setattr("fits.maps.fit_map.fit_map", fit_map)
        return main([*WORDS, *words.split()]), given

    return run


def test_defaults_and_options_arrive(place, run):
    code, given = run()
    assert code == 0
    assert isinstance(given.pop("stack"), lj.Stack)
    assert isinstance(given.pop("transport"), lj.SingleScattering)
    assert given.pop("options") == MapOptions()
    places = {"geometry": "view.csv", "values": "map.npy", "out": "coat.zarr", "sigma": None, "mask": None}
    assert given == {**places, "noise": Noise(), "client": None}
    # the stack file says what no option does
    more = "[noise]\nrelative = 0.1\ntails = 'student'\n[scale]\nstart = 1\nlow = 0.8\nhigh = 1.2\n"
    (place / "coat.toml").write_text((place / "coat.toml").read_text() + more)
    _, given = run(
        "--sigma sigma.npy --mask mask.npy --noise 0.02 --starts 3 --seed 5 --pilot-texels 9 --chunk-size 100 --force "
        "--processes 3 --emulator never --spatial-prior gaussian --spatial-scale 0.1"
    )
    counts = {"starts": 3, "seed": 5, "pilot_texels": 9, "chunk_size": 100, "processes": 3}
    more = {"emulator": False, "force": True, "spatial_prior": SpatialPrior("gaussian", 0.1)}
    assert given["options"] == MapOptions(scale=Free(1, 0.8, 1.2), **counts, **more)
    assert (given["sigma"], given["mask"], given["noise"]) == ("sigma.npy", "mask.npy", Noise(0.02, tails="student"))
    _, given = run("--scheduler tcp://10.0.0.1:8786 --emulator always")
    assert given["client"] == "tcp://10.0.0.1:8786"
    assert given["options"].emulator


def test_what_was_found_is_printed_and_a_map_that_did_not_converge_is_doubtful(run, capsys):
    assert run()[0] == 0
    output = capsys.readouterr()
    rows = {line.split("  ")[0].strip(): line.split() for line in reversed(output.out.splitlines()) if line.strip()}
    assert "A map of 10 texels: 8 are fitted, 2 masked.\n100 % of the fitted texels converged." in output.out
    assert rows["base.albedo"][1:4] == ["1.75", "3.5", "5.25"]  # quartiles of 0 to 7
    assert rows["layers[0].f0"] == ["layers[0].f0", "0.04321", "0.00012", "1"]
    assert "layerjax report coat.zarr" in output.out
    assert "texels 5/10" in output.err
    assert run(failing=1)[0] == run(chunks=1)[0] == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("map.npy=nowhere.npy", "nowhere.npy: no such file"),
        ("map.npy=.", "layerjax fit-many"),
        ("view.csv=coat.toml", "coat.toml, line"),
        ("coat.zarr=file.zarr", "file.zarr: is no store of a fitted map"),
        ("coat.zarr=coat.h5", "coat.h5: a fitted map can be written as .zarr only"),
        ("--spatial-prior gaussian", "--spatial-prior needs --spatial-scale"),
    ],
)
def test_bad_input_is_named(place, capsys, words, message):
    (place / "file.zarr").write_text("")
    change, more = ({}, words.split()) if words.startswith("--") else (dict([words.split("=")]), [])
    assert message in refused([*(change.get(word, word) for word in WORDS), *more], capsys, place)
