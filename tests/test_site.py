"""The site: what its pages are made of, and that it builds."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

import fits
import layerjax
from layerjax import gallery as materials
from tests.helpers.places import ROOT

pytest.importorskip("sphinx", reason="needs the extra docs")

from tools import check_site, gallery, site

DOCS = ROOT / "docs"


def test_every_public_name_is_in_the_api():
    documented = set()
    for page in (DOCS / "api").glob("*.md"):
        module = ""
        for directive, name in re.findall(r"^\.\. (\S+):: (\S+)", page.read_text(), re.MULTILINE):
            if directive == "currentmodule":
                module = name
            else:
                documented.add(name if "." in name else f"{module}.{name}")
    names = {name for name, value in vars(layerjax).items() if not name.startswith("_") and not inspect.ismodule(value)}
    public = {f"layerjax.{name}" for name in names} | {f"fits.{name}" for name in fits.__all__}
    assert not public - documented
    elsewhere = {name for name in documented - public if name.count(".") == 1}
    assert not elsewhere


def test_the_gallery_is_that_of_the_package():
    assert gallery.page() == gallery.PAGE.read_text(), "python -m tools.gallery makes docs/gallery.md again"
    assert {path.stem for path in gallery.PICTURES.iterdir()} == set(materials.names())


def test_stacks_of_the_gallery_are_those_that_are_printed():
    printed = re.findall(r"## (\w+)\n.*?```python\n(.*?)```", gallery.page(), re.DOTALL)
    assert [name for name, _ in printed] == list(materials.names())
    for name, code in printed:
        assert eqx.tree_equal(eval(code, {"lj": layerjax}), materials.stack(name)), name


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("see [errata](errata.md#a).", "see [errata](errata.md#a)."),
        ("[all](../benchmarks/results/held-out.md)", "[all](benchmarks/held-out.md)"),
        ("[new](../CHANGELOG.md#x)", "[new](project/changelog.md#x)"),
        ("the [suite](../benchmarks/suite)", "the suite"),
        (
            "[`layerjax.fresnel`](../layerjax/fresnel.py)",
            "[`layerjax.fresnel`](source:source/layerjax/fresnel.html#source)",
        ),
        ("[a stack](../examples/coated_diffuse.toml)", "[a stack](../examples/coated_diffuse.toml)"),
        ("```sh\n[suite](../benchmarks/suite)\n```\n", "```sh\n[suite](../benchmarks/suite)\n```\n"),
        ("[out](https://example.org/x.md)", "[out](https://example.org/x.md)"),
    ],
)
def test_links_of_the_repository_become_those_of_the_site(text, expected):
    assert site.linked(text, DOCS / "papers.md", "papers") == expected


def test_a_name_in_a_link_leads_to_its_line():
    link = "[`layerjax.fresnel:schlick`](../layerjax/fresnel.py)"
    line = (ROOT / "layerjax" / "fresnel.py").read_text().split("\n").index(next(_lines_with("def schlick("))) + 1
    assert site.linked(link, DOCS / "papers.md", "papers").endswith(f"fresnel.html#line-{line})")


def _lines_with(start):
    return (line for line in (ROOT / "layerjax" / "fresnel.py").read_text().split("\n") if line.startswith(start))


def test_pictures_of_pages_from_elsewhere_are_found():
    origin = site.RESULTS / "error-vs-time.md"
    text = site.linked("![a](error-vs-time.png)", origin, "benchmarks/error-vs-time")
    assert text == "![a](../../benchmarks/results/error-vs-time.png)"
    assert (DOCS / "benchmarks" / text[5:-1]).resolve().exists()


def test_results_have_a_page_each(tmp_path: Path):
    site.write_pages(tmp_path)
    overview = (tmp_path / "benchmarks" / "index.md").read_text()
    for path in site.RESULTS.glob("*.json"):
        assert f"{path.stem}.json" in (tmp_path / "benchmarks" / f"{path.stem}.md").read_text()
        assert f"[{path.stem}]({path.stem}.md)" in overview


def test_broken_links_are_found(tmp_path: Path):
    (tmp_path / "a.html").write_text(
        '<script src="https://cdn.example/x.js"></script><link rel="stylesheet" href="gone.css">'
        '<a href="b.html#here">1</a><a href="b.html#there">2</a><a href="c.html">3</a><a href="https://example.org">4</a>'
    )
    (tmp_path / "b.html").write_text('<p id="here"></p>')
    assert sorted(check_site.broken(tmp_path)) == [
        "a.html: b.html#there leads to no place on that page",
        "a.html: c.html leads to no file",
        "a.html: gone.css leads to no file",
        "a.html: loads https://cdn.example/x.js",
    ]


@pytest.mark.slow
def test_the_site_builds_and_every_notebook_runs():
    subprocess.run([sys.executable, "-m", "tools.check_site", "--execute"], cwd=ROOT, check=True)
