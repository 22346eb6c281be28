"""Libraries of layers and bases."""

from pathlib import Path

import pytest

import layerjax as lj
from fits.problem.parameters import Free, split
from fits.structure_search.library import Library, default_library, read_library

BASE = lj.Stack([], lj.Lambertian(Free(0.2, 0.0, 1.0)))
COAT = lj.Interface(Free(1.5, 1.1, 2.0), 0.3)


def test_stacks_are_put_together_from_the_top() -> None:
    library = default_library()
    stack = library.stack(("haze", "interface", "pigment"))
    assert [type(layer).__name__ for layer in stack.layers] == ["Medium", "Interface", "Medium"]
    assert stack.base is None
    assert library.stack(("metal",)).base is library.bases["metal"].base


@pytest.mark.parametrize("channels", [1, 3])
def test_every_part_of_the_default_is_free_and_has_as_many_colours(channels: int) -> None:
    library = default_library(channels)
    for base in library.bases:
        for layer in library.layers:
            names = split(library.stack((layer, base)))[1]
            assert names
    names = split(library.stack(("particles", "diffuse")))[1]
    assert sum("albedo" in name for name in names) == 2 * channels


def test_a_file_says_the_same(tmp_path: Path) -> None:
    (tmp_path / "library.toml").write_text(
        '[layers.coat]\nkind = "Interface"\nior = { start = 1.5, low = 1.1, high = 2.0 }\nalpha = 0.3\n'
        '[bases.diffuse]\nkind = "Lambertian"\nalbedo = { start = 0.2, low = 0.0, high = 1.0 }\n'
        '[[bases.deep.layers]]\nkind = "Medium"\nthickness = 50.0\nalbedo = { start = 0.5, low = 0.0, high = 1.0 }\n'
    )
    library = read_library(tmp_path / "library.toml")
    assert set(library.layers) == {"coat"}
    assert set(library.bases) == {"diffuse", "deep"}
    assert library.stack(("coat", "diffuse")).layers[0].ior == Free(1.5, 1.1, 2.0)
    assert library.stack(("coat", "deep")).base is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[bases.diffuse]\nkind = "Lambertian"\nalbedo = 0.2\n', "it has no layer"),
        ('[layers.coat]\nkind = "Interface"\nior = 1.5\nalpha = 0.3\n', "it has no base"),
        ('[layers.coat]\nkind = "Lambertian"\nalbedo = 0.2\n', "layers.coat: layers.0..kind is 'Lambertian'"),
        ('[layers.coat]\nkind = "Interface"\nior = 1.5\nalhpa = 0.3\n', "alhpa"),
        ('[bases.flat]\nkind = "Lambertian"\n', "bases.flat"),
        ("[stack]\n", "stack"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "library.toml").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_library(tmp_path / "library.toml")
    assert str(caught.value).startswith(str(tmp_path / "library.toml"))


@pytest.mark.parametrize(
    ("layers", "bases", "message"),
    [
        ({"a": COAT}, {"a": BASE}, "'a' names a layer and a base"),
        ({"a/b": COAT}, {"c": BASE}, "'a/b' is no name"),
        ({"a": COAT}, {"b c": BASE, "B-c": BASE}, "'b c' and 'B-c' are one name as files"),
    ],
)
def test_bad_names_are_refused(layers: dict, bases: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Library(layers, bases)
