"""What pages of fits, maps, searches and batches are made of: sections of sentences, tables and pictures, as HTML."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from string import Template

import layerjax

PACKAGES = ("jax", "equinox", "optimistix", "emcee", "numpy", "scipy")


@dataclass(frozen=True)
class Table:
    """A title, column heads, and rows of as many words; `note` stands below."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def numeric(self, column: int) -> bool:
        """Whether a column holds numbers."""
        words = [row[column] for row in self.rows if row[column]]
        return bool(words) and all(word.rstrip("°%").lstrip("+-")[:1].isdigit() or word == "unknown" for word in words)


Part = str | Table | Sequence[str] | None
"""What a section holds: HTML, a table, or sentences."""

_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.5rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; font-size: 13px; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { padding: 0.2rem 0.8rem 0.2rem 0; text-align: left; vertical-align: top; } td { border-top: 1px solid #eee; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
caption { text-align: left; font-weight: 600; white-space: nowrap; }
.pair { display: flex; flex-wrap: wrap; gap: 0 1rem; } .pair figure { flex: 1 1 20rem; min-width: 0; max-width: 31rem; }
figure { margin: 1rem 0; } img { max-width: 100%; } figcaption, .note { font-size: 13px; color: #555; }
pre { background: #f6f6f6; padding: 0.8rem; font-size: 12.5px; overflow-x: auto; }
.verdict { background: #fff6e5; border-left: 4px solid #E69F00; padding: 0.5rem 1rem; }
.verdict.fine { background: #eef7f2; border-color: #009E73; }
@media (max-width: 40rem) { figure { overflow-x: auto; } figure img { max-width: 44rem; } }
</style></head><body>
$body
</body></html>
""")


def document(title: str, body: Sequence[str]) -> str:
    """A whole page from its sections."""
    return _PAGE.substitute(title=html.escape(title), body="\n".join(body))


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    return {"layerjax": layerjax.__version__} | {package: metadata.version(package) for package in PACKAGES}


def made_with() -> str:
    """Versions of what a page was made with, as an HTML fragment."""
    words = [f"{package} {version}" for package, version in versions().items()]
    return f'<p class="note">Made with {html.escape(", ".join(words))}.</p>'


def verdict(words: Sequence[str], sound: bool) -> str:
    """What a page opens with; sound: whether there is no reservation."""
    return f'<p class="verdict{" fine" if sound else ""}">{html.escape(" ".join(words))}</p>'


def section(head: str, *parts: Part) -> str:
    """A part of a page under a heading; empty parts are omitted."""
    shown = [f"<h2>{html.escape(head)}</h2>"]
    for part in parts:
        if isinstance(part, Table):
            shown.append(html_table(part))
        elif part:
            shown.append(part if isinstance(part, str) else sentences(part))
    return "\n".join(shown)


def html_table(table: Table) -> str:
    """The table as an HTML fragment, every word escaped; nothing of a table without rows."""
    if not table.rows:
        return ""
    kinds = [' class="number"' if table.numeric(index) else "" for index in range(len(table.columns))]

    def line(tag: str, words: Sequence[str]) -> str:
        cells = (f"<{tag}{kind}>{html.escape(word)}</{tag}>" for kind, word in zip(kinds, words, strict=True))
        return f"<tr>{''.join(cells)}</tr>"

    body = "\n".join(line("td", row) for row in table.rows)
    note = f'<p class="note">{html.escape(table.note)}</p>' if table.note else ""
    caption = f"<caption>{html.escape(table.title)}</caption>" if table.title else ""
    return f"<table>{caption}<thead>{line('th', table.columns)}</thead>\n<tbody>{body}</tbody></table>{note}\n"


def sentences(words: Sequence[str]) -> str:
    """A list of sentences."""
    return "<ul>" + "".join(f"<li>{html.escape(sentence)}</li>" for sentence in words) + "</ul>"


def image(content: bytes, caption: str) -> str:
    """A picture, the content of a PNG file, with its caption."""
    caption = html.escape(caption)
    picture = f'<img alt="{caption}" src="data:image/png;base64,{base64.b64encode(content).decode("ascii")}">'
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"
