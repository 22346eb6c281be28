"""python -m tools.check_site: build the site with warnings as errors, and follow every link inside it.

Notebooks are not run, unless --execute is given: then all of them are, whatever was kept of earlier runs.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
"""What a browser fetches by itself: tags, and the attribute that says from where."""

NOT_FETCHED = {"canonical", "next", "prev", "index", "search", "author", "copyright"}
"""Links in the head that state where the page is in the site."""


class Page(HTMLParser):
    """What a page holds: its anchors, what it links to, and what it loads."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := found.get(name))}
        if tag == "a" and (target := found.get("href")):
            self.links.add(target)
        if tag in LOADED and (target := found.get(LOADED[tag])) and found.get("rel") not in NOT_FETCHED:
            self.loaded.add(target)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.check_site", description=__doc__)
    parser.add_argument("--execute", action="store_true", help="run all notebooks")
    execute = parser.parse_args().execute
    with tempfile.TemporaryDirectory() as name:
        site = Path(name) / "html"  # notebooks are written beside it
        build(site, "force" if execute else "off")
        wrong = list(broken(site))
        if wrong:
            raise SystemExit("\n".join(wrong))
        count = len(list(site.rglob("*.html")))
        print(f"the site: {count} pages, every link inside leads somewhere, nothing comes from outside")


def build(site: Path, execution: str) -> None:
    """The site, in a folder."""
    options = ["-q", "-W", "--keep-going", "-d", str(site / ".doctrees"), "-D", f"nb_execution_mode={execution}"]
    subprocess.run([sys.executable, "-m", "sphinx", *options, "docs", str(site)], cwd=ROOT, check=True)


def broken(site: Path) -> Iterator[str]:
    """A line for each link that leads nowhere, and for each thing that a page would load from elsewhere."""
    pages = {path: Page(path.read_text()) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts}
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        for target in sorted(page.links | page.loaded):
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                if target in page.loaded and parts.scheme != "data":
                    yield f"{name}: loads {target}"
                continue
            place = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not place.is_file():
                yield f"{name}: {target} leads to no file"
            elif parts.fragment and place in pages and unquote(parts.fragment) not in pages[place].anchors:
                yield f"{name}: {target} leads to no place on that page"


if __name__ == "__main__":
    main()
