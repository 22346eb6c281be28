"""Pictures of a map show its numbers where they are, and grey where there are none."""

import math
import re

import numpy as np
import pytest
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from fits.maps.report import pictures
from fits.maps.store import FLAGS
from tests.helpers.painted_maps import GOOD


def image_of(figure: Figure) -> np.ndarray:
    """What the uppermost image of a figure shows, NaN where it is transparent."""
    return np.ma.filled(np.ma.asarray(figure.axes[0].images[-1].get_array(), float), np.nan)


def words(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_an_image_is_the_map_with_row_0_on_top() -> None:
    values, fitted = np.arange(12.0).reshape(3, 4), np.ones((3, 4), bool)
    fitted[0, 1], values[2, 2] = False, np.inf
    figure = pictures.value_picture(values, fitted, pictures.face((3, 4)), "a", "mm", "viridis")
    shown = image_of(figure)
    assert np.isnan(shown[0, 1])
    expected = np.where(fitted & np.isfinite(values), values, np.nan)
    np.testing.assert_array_equal(np.where(np.isfinite(shown), shown, np.nan), expected)
    assert figure.axes[0].get_ylim() == (2.5, -0.5)
    assert figure.axes[1].get_ylabel() == "mm"
    assert words(figure) == ["not fitted", "none: at a bound, or open"]
    ground = figure.axes[0].images[0].get_array()
    assert ground is not None
    assert ground[2, 2] == 1
    assert ground[0, 1] == 0
    whole = pictures.value_picture(np.ones((3, 4)), np.ones((3, 4), bool), pictures.face((3, 4)), "a", "1", "viridis")
    assert words(whole) == []


@pytest.mark.parametrize(
    ("shape", "part", "steps", "told"),
    [
        ((5,), (slice(None, None, 1),), (1,), ""),
        ((1,), (slice(None, None, 1),), (1,), ""),
        ((1, 9), (0, slice(None, None, 1)), (1,), ""),
        ((9, 1), (slice(None, None, 1), 0), (1,), ""),
        ((1, 1), (0, slice(None, None, 1)), (1,), ""),
        ((7, 3, 4), (3, slice(None, None, 1), slice(None, None, 1)), (1, 1), "slice [3] of 7"),
        ((4, 7, 3, 4), (2, 3, slice(None, None, 1), slice(None, None, 1)), (1, 1), "slice [2, 3] of 4 x 7"),
        ((2001, 2000), (slice(None, None, 2), slice(None, None, 1)), (2, 1), "one texel in 2 x 1"),
        ((6001,), (slice(None, None, 4),), (4,), "one texel in 4"),
    ],
)
def test_what_is_drawn_of_a_map(shape: tuple[int, ...], part: tuple, steps: tuple[int, ...], told: str) -> None:
    face = pictures.face(shape)
    assert (face.part, face.steps, face.words) == (part, steps, told)
    drawn = face.of(np.empty(shape, bool))
    assert drawn.ndim == len(steps)
    assert max(drawn.shape) <= pictures.MOST


def test_axes_of_a_map_that_is_reduced_count_texels_of_the_map() -> None:
    shape = (2400, 30)
    values = np.arange(72000.0).reshape(shape)
    figure = pictures.value_picture(values, np.ones(shape, bool), pictures.face(shape), "a", "1", "viridis")
    assert image_of(figure).shape == (1200, 30)
    assert figure.axes[0].get_ylim() == (2399.5, -0.5)
    assert figure.axes[0].get_xlim() == (-0.5, 29.5)


def test_a_map_of_one_axis_is_a_line_with_gaps() -> None:
    values, fitted = np.linspace(0.0, 1.0, 50), np.ones(50, bool)
    fitted[10:20] = False
    figure = pictures.value_picture(values, fitted, pictures.face((50,)), "a", "mm", "viridis")
    index, drawn = figure.axes[0].lines[0].get_data()
    np.testing.assert_array_equal(index, np.arange(50))
    np.testing.assert_array_equal(drawn, np.where(fitted, values, np.nan))
    assert figure.axes[0].get_ylabel() == "mm"


def test_colours_run_over_the_middle_and_are_logarithmic_where_it_is_wide() -> None:
    values = np.concatenate([np.linspace(1.0, 2.0, 999), [1e9, np.nan, np.inf]])
    scale = pictures.scale_of(values)
    assert scale.low == pytest.approx(1.0, abs=0.02)
    assert scale.high == pytest.approx(2.0, abs=0.02)
    assert not scale.logarithmic
    assert pictures.scale_of(np.geomspace(1e-3, 1.0, 100)).logarithmic
    assert not pictures.scale_of(np.linspace(-1.0, 100.0, 100)).logarithmic
    assert not pictures.scale_of(np.linspace(0.0, 100.0, 100)).logarithmic
    for numbers in ([], [np.nan], [0.0, 0.0], [3.0], [-2.0, -2.0]):
        scale = pictures.scale_of(np.array(numbers))
        assert scale.low < scale.high


def test_chi_square_is_even_about_one() -> None:
    ratio = np.geomspace(0.5, 20.0, 100).reshape(10, 10)
    ratio[0, 0] = 0.0
    figure = pictures.chi_square_picture(ratio, np.ones((10, 10), bool), pictures.face((10, 10)))
    norm = figure.axes[0].images[-1].norm
    assert isinstance(norm, LogNorm)
    assert norm.vmin is not None
    assert norm(1.0) == pytest.approx(0.5)
    assert 15.0 < 1.0 / norm.vmin < 20.0


def test_a_texel_is_shown_as_the_gravest_of_its_flags() -> None:
    cases = {
        "not there yet": 0,
        "masked": FLAGS["masked"],
        "too few readings": FLAGS["too_few_readings"],
        "failed": FLAGS["failed"] | FLAGS["restarted"],
        "not converged": FLAGS["fitted"] | FLAGS["poor"],
        "poor": GOOD | FLAGS["poor"] | FLAGS["at_bound"],
        "not resolved": GOOD | FLAGS["unidentified"] | FLAGS["at_bound"],
        "at a bound": GOOD | FLAGS["at_bound"] | FLAGS["restarted"],
        "fine, started again": GOOD | FLAGS["restarted"],
        "fine": GOOD,
    }
    found = pictures.states_of(np.array(list(cases.values()), np.uint16))
    assert [pictures.STATES[place].words for place in found] == list(cases)
    assert [state.words for state in pictures.STATES] == list(cases)


@pytest.mark.parametrize("shape", [(6, 5), (30,), (3, 4, 5)])
def test_the_legend_of_flags_counts_all_texels(shape: tuple[int, ...]) -> None:
    flags = np.full(shape, GOOD, np.uint16)
    flags.flat[:7] = FLAGS["masked"]
    figure = pictures.flag_picture(flags, pictures.face(shape))
    assert words(figure) == ["masked: 7", f"fine: {flags.size - 7}"]
    assert len({state.colour for state in pictures.STATES}) == len(pictures.STATES)


def density(ratio: float, freedom: int) -> float:
    """Of chi-square per degree of freedom, in closed form."""
    half = freedom / 2.0
    return math.exp(half * math.log(half) + (half - 1.0) * math.log(ratio) - half * ratio - math.lgamma(half))


def test_the_expected_density_is_that_of_the_degrees_of_freedom() -> None:
    at = np.array([0.3, 0.9, 1.0, 1.6])
    one = pictures.expected_density(at, np.full(100, 7))
    np.testing.assert_allclose(one, [density(ratio, 7) for ratio in at], rtol=1e-10)
    two = pictures.expected_density(at, np.repeat([7, 30], [30, 10]))
    np.testing.assert_allclose(two, [0.75 * density(x, 7) + 0.25 * density(x, 30) for x in at], rtol=1e-10)
    grid = np.linspace(1e-3, 6.0, 20001)
    many = pictures.expected_density(grid, np.arange(3, 300))
    assert np.trapezoid(many, grid) == pytest.approx(1.0, abs=1e-3)


def test_bars_of_chi_square_are_a_density_beside_the_expected_one() -> None:
    rng, freedom = np.random.default_rng(0), 40
    ratio = rng.chisquare(freedom, 200_000) / freedom
    figure = pictures.chi_square_histogram(ratio, np.full(ratio.size, freedom))
    stairs = figure.axes[0].patches[0].get_data()  # type: ignore[attr-defined]
    middle, width = 0.5 * (stairs.edges[1:] + stairs.edges[:-1]), np.diff(stairs.edges)
    expected = np.array([density(x, freedom) for x in middle])
    # counting noise of a bar, four deviations, and what a bar's width rounds off the curve
    allowed = 4.0 * np.sqrt(expected / (ratio.size * width)) + 0.01
    assert np.all(np.abs(stairs.values - expected) < allowed)


@pytest.mark.parametrize("numbers", [[], [np.nan], [2.0], [0.0, 0.0], [1.0, 1e6, 1e3], [np.inf, 1.0, 2.0]])
def test_histograms_of_few_numbers_are_drawn(numbers: list[float]) -> None:
    figure = pictures.histogram_picture(np.array(numbers), "a", "mm")
    outside = re.search(r"(\d+) outside", figure.axes[0].get_title(loc="left"))
    inside = np.isfinite(numbers).sum() - (int(outside[1]) if outside else 0)
    counted = sum(np.sum(patch.get_data().values) for patch in figure.axes[0].patches)  # type: ignore[attr-defined]
    assert counted == inside
    assert figure.axes[0].get_xlabel() == "mm"
    pictures.chi_square_histogram(np.array(numbers), np.full(len(numbers), 5))
