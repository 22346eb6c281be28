"""Pictures of materials: what a pixel shows, and the command."""

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure

import layerjax as lj
from fits.reports.render import SKY, SUN, _sky, render, sphere, to_screen
from fits.reports.results import save_fit

WHITE = lj.Stack([], lj.Lambertian(1.0))
SINGLE = lj.SingleScattering()


def test_a_white_sphere_shows_the_cosine() -> None:
    """The pixel in the middle, lit from the viewer and from 60 degrees; a pixel is flat to 1e-3."""
    for light, cosine in (((0.0, 0.0, 1.0), 1.0), ((np.sqrt(0.75), 0.0, 0.5), 0.5)):
        picture = to_screen(sphere(WHITE, lj.prepare(WHITE, SINGLE), light, 65))
        np.testing.assert_allclose(picture[32, 32], to_screen(np.asarray(SUN * cosine + SKY)), atol=2e-3)
    np.testing.assert_allclose(picture[0, 0], to_screen(np.asarray(SKY)))  # beside the sphere


def test_what_loses_nothing_cannot_be_seen_under_a_sky() -> None:
    """A lossless haze returns the sky; 1e-3 for the angles between those of the table."""
    haze = lj.Stack([lj.Medium(1.0, 1.0, lj.HenyeyGreenstein(0.5))])
    solved = lj.prepare(haze, lj.AddingDoubling(nodes=12, modes=8))
    wo = np.asarray(lj.direction(np.radians([0.0, 20.0, 50.0, 80.0]), 1.0))
    np.testing.assert_allclose(_sky(haze, solved, wo), 1.0, atol=1e-3)


SHEET = pytest.param(lj.Stack([lj.Medium(0.7, 0.9)]), True, marks=pytest.mark.slow)


@pytest.mark.parametrize(("stack", "behind"), [(WHITE, False), SHEET])
def test_only_a_sheet_is_seen_from_behind(stack: lj.Stack, behind: bool) -> None:
    titles = [axes.get_title(loc="left") for axes in render(stack, SINGLE, size=16).axes]
    assert "lit from the front" in titles
    for title in ("from behind", "BSDF in the plane of incidence, transmitted"):
        assert (title in titles) == behind


def test_bad_arguments_are_named() -> None:
    for size in (4, 1025, 100_000):
        with pytest.raises(ValueError, match=rf"size: {size} is not a whole number from 16 to 1024"):
            render(WHITE, SINGLE, size=size)
    with pytest.raises(ValueError, match=r"layers: the stack ends in a medium of index 1\.5, .* Interface of ior 1"):
        render(lj.Stack([lj.Interface(1.5, 0.2)]), size=16)
    with pytest.raises(ValueError, match="transport: RandomWalk is random"):
        render(WHITE, lj.RandomWalk(), size=16)


def test_the_command_draws_files_and_the_best_of_a_fit(work, layerjax, coat_fit, monkeypatch) -> None:
    layerjax("render coat.toml --out haze.png --size 16")
    assert (work / "haze.png").read_bytes().startswith(b"\x89PNG")
    save_fit(coat_fit, "result")
    drawn = []
    monkeypatch.setattr("fits.reports.render.render", lambda *given, **_: drawn.append(given) or Figure())
    layerjax("render result --out coat.png")
    assert (work / "coat.png").exists()
    ((stack, transport),) = drawn
    assert eqx.tree_equal(stack, coat_fit.stack, rtol=1e-12)
    assert transport == coat_fit.problem.transport
