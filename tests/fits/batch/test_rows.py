"""Which stack is best of a file."""

import math

import pytest

from fits.batch.page import WIDE, overview, page, parameters_picture, told
from fits.batch.rows import Parameter, Row, best_of, standings, stored_row
from fits.reports.plots.data import as_png


def row(stack: str, aic: float = math.nan, file: str = "a.csv", **more: object) -> Row:
    options = {"directory": f"{file}/{stack}", "converged": True, "reduced_chi_square": 1.0, "chi_square": 90.0}
    return Row(file, stack, aic=aic, **(options | more))


def test_the_lowest_criterion_is_best_and_what_chance_explains_as_good() -> None:
    rows = [row("one", 10.0), row("two", 11.9), row("three", 15.0)]
    assert standings(rows) == {("a.csv", "one"): "best", ("a.csv", "two"): "as good", ("a.csv", "three"): "+5.0"}
    assert best_of(rows) == {"a.csv": "one"}


def test_scatter_that_the_best_leaves_counts_as_noise() -> None:
    rows = [row("one", 10.0, reduced_chi_square=4.0), row("two", 17.0), row("three", 90.0)]
    assert list(standings(rows).values()) == ["best", "as good", "+20.0"]


def test_a_fit_that_did_not_converge_is_not_the_best_of_those_that_did() -> None:
    rows = [row("one", 10.0, converged=False), row("two", 17.0)]
    assert standings(rows) == {("a.csv", "one"): "-7.0", ("a.csv", "two"): "best"}


def test_readings_held_out_come_before_the_criterion() -> None:
    rows = [row("one", 10.0, score=1.0, scored=50), row("two", 90.0, score=1.1, scored=50)]
    assert list(standings(rows).values()) == ["+10.0", "best"]


@pytest.mark.parametrize(
    "rows",
    [
        [row("one", 10.0)],
        [row("one", 10.0), row("two", failure="unreadable")],
        [row("one", 10.0), row("two", objective="cube_root")],
    ],
)
def test_nothing_is_said_of_what_cannot_be_compared(rows: list[Row]) -> None:
    assert set(standings(rows).values()) == {""}


def test_named_objectives_of_one_kind_are_ranked_without_a_verdict_on_chance() -> None:
    rows = [row("one", chi_square=1.0, objective="cube_root"), row("two", chi_square=1.5, objective="cube_root")]
    assert list(standings(rows).values()) == ["best", "+0.5"]


def test_files_are_judged_one_by_one() -> None:
    rows = [row("one", 1.0), row("two", 9.0), row("one", 9.0, "b.csv"), row("two", 1.0, "b.csv"), row("one", 1.0, "c")]
    assert best_of(rows) == {"a.csv": "one", "b.csv": "two", "c": "one"}


PARAMETERS = (Parameter("base.albedo", 0.5, 0.01, "1", False), Parameter("layers[0].alpha", 1.0, math.nan, "1", True))
ROWS = [
    row("coat", 1.0, file=f"<{k}> #.csv", parameters=PARAMETERS, status="converged", seconds=1.0, readings=9)
    for k in range(3)
]


def test_a_row_comes_back_from_a_file() -> None:
    import json

    from fits._files import plain

    assert repr(stored_row(json.loads(json.dumps(plain(ROWS[0].plain()))))) == repr(ROWS[0])


def test_the_page_escapes_names_and_links_to_reports() -> None:
    rows = [*ROWS, row("coat", file="b.csv", directory="", failure="line 2: <x> is no number")]
    text = page(rows, ["scans/README.md"], True, {one.directory for one in ROWS})
    assert "%3C0%3E%20%23.csv/coat/report.html" in text
    assert "&lt;0&gt; #.csv" in text
    assert "<0>" not in text
    assert "line 2: &lt;x&gt; is no number" in text
    assert "1 (bound)" in text
    assert "0.500 ± 0.010" in text
    assert text.count("data:image/png") == 1


def test_what_became_of_them_is_told() -> None:
    rows = [*ROWS, row("coat", file="b.csv", failure="broken"), row("coat", 1.0, "c.csv", converged=False)]
    words = told(rows, ["scans/README.md"])
    assert words[0] == "5 files by 1 stack: 4 of 5 fits are there, 3 of them converged."
    assert words[1] == "No result of b.csv (1 fit)."
    assert words[2] == "Not converged: c.csv by coat."
    assert "layers[0].alpha of coat (3 files)" in words[3]
    assert words[4] == "Not taken for measurements: scans/README.md."


def test_long_tables_are_shortened_and_pictures_drawn() -> None:
    table = overview(ROWS * 20, most=10)
    assert len(table.rows) == 11
    assert as_png(parameters_picture(ROWS)).startswith(b"\x89PNG")


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
def test_every_column_of_panels_ends_with_the_names_of_files(count: int) -> None:
    parameters = tuple(Parameter(f"layers[{k}].thickness_mm", 0.5, 0.01, "mm", False) for k in range(count))
    figure = parameters_picture([row("coat", file=f"{k}.csv", parameters=parameters) for k in range(2)])
    panels = figure.axes[: 1 + count]
    assert [axes.get_title(loc="left") for axes in panels[1:]] == [f"{one.name} (mm)" for one in parameters]
    for axes in panels[-WIDE:]:
        assert [label.get_text() for label in axes.get_xticklabels() if label.get_visible()] == ["0.csv", "1.csv"]
