"""Stacks as pictures in notebooks: layers from top to bottom in SVG, with their numbers beside them.

Strokes and words take the colour of the text around them, and fills are translucent, so that a picture is readable on
light and dark pages; there is neither a script nor a style sheet nor an identifier in it.
"""

import textwrap
from collections.abc import Sequence
from html import escape
from typing import Literal, NamedTuple

WIDTH, LEFT, RIGHT = 640, 8, 158
"""Size of the picture, and where its layers begin and end, in pixels."""

SKY_HEIGHT, LINE, MARGIN = 40, 17, 7
"""Heights of what lies above the layers and of a line of words, and what is left above and below these."""

MOST_LETTERS = 68
"""Letters of a line."""

INTERFACE, MEDIUM, BASE = "rgba(31, 119, 180, 0.75)", "rgba(31, 119, 180, 0.18)", "rgba(140, 110, 80, 0.35)"


Kind = Literal["interface", "medium", "base", "nothing"]


class DiagramRow(NamedTuple):
    """A layer or a base: what it looks like, its name, and its numbers in words."""

    kind: Kind
    name: str
    words: str


def diagram(rows: Sequence[DiagramRow], title: str) -> str:
    """SVG of the rows from top to bottom, not to scale, lit from the left and seen from the right."""
    parts, top = [*_light()], SKY_HEIGHT
    for row in rows:
        lines = textwrap.wrap(row.words, MOST_LETTERS) or [""]
        height = 2 * MARGIN + LINE * (1 + len(lines) * bool(row.words))
        parts += [*_layer(row, top, height), *_words(row, lines, top)]
        top += height
    size = f'width="{WIDTH}" height="{top + 4}" viewBox="0 0 {WIDTH} {top + 4}"'
    look = 'style="max-width: 100%; height: auto" font-family="sans-serif" font-size="12.5" fill="currentColor"'
    label = f'role="img" aria-label="{escape(title)}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {look} {label}>{"".join(parts)}</svg>'


def diagram_column(parts: Sequence[tuple[str, str]]) -> str:
    """HTML of pictures below each other, under their heads."""
    return "".join(f"<div><strong>{escape(head)}</strong></div><div>{inside}</div>" for head, inside in parts)


def _light() -> list[str]:
    """The sun at the left, its light, and that which leaves for an eye at the right."""
    middle = (LEFT + RIGHT) // 2
    stroke = 'fill="none" stroke="currentColor" stroke-width="1.5"'
    return [
        f'<circle cx="{LEFT + 24}" cy="8" r="5" fill="rgba(240, 170, 0, 0.9)"/>',
        f'<path d="M{LEFT + 30} 12 L{middle} {SKY_HEIGHT} m-9 -2 l9 2 l-4 -8" {stroke}/>',
        f'<path d="M{middle} {SKY_HEIGHT} L{RIGHT - 32} 12 m-9 2 l9 -2 l-4 8" {stroke}/>',
        f'<path d="M{RIGHT - 29} 8 q9 -9 18 0 q-9 9 -18 0" {stroke}/><circle cx="{RIGHT - 20}" cy="8" r="2.5"/>',
    ]


def _layer(row: DiagramRow, top: int, height: int) -> list[str]:
    wide = RIGHT - LEFT
    if row.kind == "nothing":
        middle = (LEFT + RIGHT) // 2
        arrow = f"M{middle} {top + 3} V{top + height - 3} m-4 -7 l4 7 l4 -7"
        return [f'<path d="{arrow}" fill="none" stroke="currentColor" stroke-width="1.5"/>']
    if row.kind == "interface":
        facets = "".join(f" l5 {-6 if step % 2 else 6}" for step in range(wide // 5))
        first = 3 if top == SKY_HEIGHT else 0  # on top of all, facets stand out into the sky
        body = f'<rect x="{LEFT}" y="{top + first}" width="{wide}" height="{height - first}" fill="{MEDIUM}"/>'
        return [body, f'<path d="M{LEFT} {top + 3}{facets}" fill="none" stroke="{INTERFACE}" stroke-width="2"/>']
    colour = MEDIUM if row.kind == "medium" else BASE
    body = f'<rect x="{LEFT}" y="{top}" width="{wide}" height="{height}" fill="{colour}"/>'
    if row.kind == "medium":
        dots = [
            f'<circle cx="{LEFT + 12 + (step * 37) % (wide - 20)}" cy="{top + 8 + (step * 11) % (height - 14)}" r="2"/>'
            for step in range(9)
        ]
        edge = f'<path d="M{LEFT} {top}h{wide}" stroke="{INTERFACE}" stroke-dasharray="3 3"/>'
        return [body, edge, f'<g fill="{INTERFACE}">{"".join(dots)}</g>']
    slants = "".join(f"M{LEFT + x} {top + 10} l10 -10 " for x in range(0, wide - 9, 10))
    return [body, f'<path d="{slants}" fill="none" stroke="currentColor" stroke-width="1" opacity="0.6"/>']


def _words(row: DiagramRow, lines: Sequence[str], top: int) -> list[str]:
    first = top + MARGIN + 13
    name = f'<text x="{RIGHT + 14}" y="{first}" font-weight="bold">{escape(row.name)}</text>'
    rest = [
        f'<text x="{RIGHT + 14}" y="{first + LINE * number}">{escape(line)}</text>'
        for number, line in enumerate(lines, start=1)
        if line
    ]
    return [name, *rest]
