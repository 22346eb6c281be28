"""Every reader, with files that are damaged in any way: readings, or one line that says what is wrong."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fits
import layerjax as lj
from fits.data.formats import read
from fits.data.measurements import Measurements
from tests.helpers.merl import SHAPE
from tests.helpers.mutations import mutated
from tests.helpers.places import ROOT

COATINGS = ROOT / "examples" / "arizona_black_coatings"
PAINT = lj.Stack([], lj.Lambertian(0.4))


def csv(folder: Path) -> bytes:
    return b"\n".join((COATINGS / "aeroglaze_650nm_inplane.csv").read_bytes().splitlines()[:60])


def totals(folder: Path) -> bytes:
    return b"theta_i,total_reflectance,total_reflectance_std\n8,0.31,0.01\n20,0.32,0.01\n45,0.4,0.02\n"


def rxt(folder: Path) -> bytes:
    header = "IAD1\n# a slab\n1.4\n1.5\n2.0\n1.0\n5\n0.98\n1\n"
    return f"{header}200 25 12 1 0.96\n200 25 12 1 0.96\n2\n800 0.3 0.4\n810 0.2 0.5\n".encode()


def merl(folder: Path) -> bytes:
    return np.array(SHAPE, "<i4").tobytes() + np.full((3, *SHAPE), 0.2).tobytes()


def exported(to: str, ending: str) -> Callable[[Path], bytes]:
    def of(folder: Path) -> bytes:
        path = folder / f"paint{ending}"
        fits.export(PAINT, path, to)  # type: ignore[arg-type]
        return path.read_bytes()

    return of


FILES: dict[str, tuple[str, Callable[[Path], bytes]]] = {
    "csv": ("x.csv", csv),
    "totals": ("x.csv", totals),
    "rxt": ("x.rxt", rxt),
    "merl": ("x.binary", merl),
    "rgl": ("x.bsdf", exported("rgl", ".bsdf")),
    "zemax": ("x.bsdf", lambda folder: (COATINGS / "AnoBlackNiTEonSteel.bsdf").read_bytes()),
    "fred": ("x.txt", lambda folder: (COATINGS / "AnoBlackNiTEonSteel.txt").read_bytes()),
    "klems": ("x.xml", exported("klems", ".xml")),
}


def damaged(kind: str, folder: Path, count: int) -> None:
    name, make = FILES[kind]
    raw = make(folder)
    random = np.random.default_rng(len(kind))
    said = 0
    for _ in range(count):
        bad = folder / name
        bad.write_bytes(mutated(raw, random, 4000 if kind == "zemax" else 400))
        try:
            found = read(bad, format=kind)
        except ValueError as error:
            words = str(error)
            said += 1
        else:
            assert isinstance(found, Measurements)
            continue
        assert words.startswith(str(bad)), words
        assert "\n" not in words, words
    assert said > 0


pytestmark = pytest.mark.filterwarnings("ignore:.*more than 3 standard deviations:UserWarning")


@pytest.mark.parametrize("kind", FILES)
def test_some_damaged_files(tmp_path: Path, kind: str) -> None:
    damaged(kind, tmp_path, 8 if kind in ("merl", "rgl") else 40)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FILES)
def test_many_damaged_files(tmp_path: Path, kind: str) -> None:
    damaged(kind, tmp_path, 500)
