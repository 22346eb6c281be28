"""Pages of docs say of the source what holds."""

import importlib
import re
from pathlib import Path

import pytest

import layerjax
from tools import papers

ROOT = Path(__file__).parents[1]
MADE = ("_build", "benchmarks", "project", "jupyter_execute")
"""Folders of docs that are made from what stands elsewhere."""

DOCS = (path.relative_to(ROOT) for path in sorted((ROOT / "docs").rglob("*.md")))
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", *(str(path) for path in DOCS if path.parts[1] not in MADE))
AGAIN = "python -m tools.papers makes docs/papers.md again"


def test_papers_are_those_of_the_source():
    assert papers.page() == papers.PAGE.read_text(), AGAIN


def test_citations_are_read_as_they_are_written():
    source = '''"""Of the model (Eqs. 12 and 16, the sign of Eq. 15), see Secs. 5.1 and 5.3; Walter 2007, Eq. 21."""
KINDS = 2
"""Fits: by Eq. (8) of Guo et al. 2015."""


class Slab:
    def value(self):
        """As above (Eqs. (32-35))."""
        return 1  # Eq. (4), 1/sr
'''
    found = papers.citations_in(Path("layerjax/transport/spongecake/slab.py"), source)
    assert {(each.paper.last, each.label, each.place.partition(":")[2]) for each in found} == {
        *(("Wang", f"Eq. {number}", "") for number in (12, 15, 16)),
        ("Wang", "Sec. 5.1", ""),
        ("Wang", "Sec. 5.3", ""),
        ("Walter", "Eq. 21", ""),
        ("Guo", "Eq. 8", "KINDS"),
        *(("Wang", f"Eq. {number}", "Slab.value") for number in (4, 32, 33, 34, 35)),
    }


def test_a_citation_of_no_known_paper_is_refused():
    with pytest.raises(ValueError, match=r"Eq\. 3"):
        list(papers.citations_in(Path("layerjax/channels.py"), '"""Sums (Eq. 3)."""'))


def test_homes_of_papers_are_there():
    lacking = [home for paper in papers.PAPERS for home in paper.homes if not any((ROOT / "layerjax").glob(home))]
    assert not lacking


@pytest.mark.parametrize("page", ["docs/errata.md", "docs/papers.md", "CONTRIBUTING.md"])
def test_places_in_the_source_exist(page):
    lacking = [place for place in places((ROOT / page).read_text()) if not exists(*place)]
    assert not lacking, f"{page}: {lacking}"


def places(text):
    """(module, name) of every `module:name` and `module` of the packages; the name may be empty."""
    return [(module, name[1:]) for module, name in re.findall(r"`((?:layerjax|fits)(?:\.\w+)+)(:[\w.]+)?`", text)]


def exists(module, name):
    try:
        found = importlib.import_module(module)
    except ImportError:  # it may be a public name
        parent, _, last = module.rpartition(".")
        return not name and hasattr(importlib.import_module(parent), last)
    for part in filter(None, name.split(".")):
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


@pytest.mark.parametrize("page", PAGES)
def test_links_exist(page):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", (ROOT / page).read_text()):
        assert ((ROOT / page).parent / target).exists(), target


def test_files_and_tests_that_contributing_names_exist():
    for path in re.findall(r"`((?:layerjax|fits|tests|tools|benchmarks|docs|examples|\.ci)/[\w./-]*)", text_of_guide()):
        assert (ROOT / path).exists(), path
    named = re.findall(r"pytest .*?(tests/\S+)::(\w+)", text_of_guide())
    assert named
    for path, test in named:
        assert f"def {test}(" in (ROOT / path).read_text(), test


def test_files_that_results_name_exist():
    for page in (ROOT / "benchmarks" / "results").glob("*.md"):
        for path in re.findall(
            r"`((?:layerjax|fits|tests|tools|benchmarks|docs|examples)/[\w./-]*)`", page.read_text()
        ):
            assert (ROOT / path).exists() or "NAME" in path, (page.name, path)


def text_of_guide():
    return (ROOT / "CONTRIBUTING.md").read_text()


def test_one_version_everywhere():
    version = layerjax.__version__
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^## \[(\S+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == version
