"""Common parts of the readers of XML files of LBNL WINDOW and Radiance: the layer, its blocks, and texts in it."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from fits.data.formats._text import BOMS_16, without_mark

COME = {"front": 1.0, "back": -1.0}
"""Of the side that light comes from: the sign of z. WINDOW's front is the top."""


ELEMENT = re.compile(rb"<(\w+:)?WindowElement\b")


def layer_of(path: Path) -> ElementTree.Element:
    """The layer of the file, without namespaces. What stands before the XML is no part of it, as for Radiance."""
    marked = path.read_bytes()
    raw = without_mark(marked)
    start = ELEMENT.search(raw)
    begin = start.start() if start else 0
    declared = raw.rfind(b"<?xml", 0, begin)
    begin = begin if declared < 0 else declared
    # what was UTF-16 is UTF-8 now, whatever its declaration says
    parser = ElementTree.XMLParser(encoding="utf-8" if marked.startswith(BOMS_16) else None)
    try:
        root = ElementTree.fromstring(raw[begin:].lstrip(), parser)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{path}: not well-formed XML: {error}") from None
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]
    layer = root.find("Optical/Layer")
    if root.tag != "WindowElement" or layer is None:
        raise ValueError(
            f"{path}: an XML file of <{root.tag[:40]}>, must be a <WindowElement> with <Optical> and <Layer>"
        )
    return layer


def number_of(path: Path, parent: ElementTree.Element, tag: str) -> float:
    """The number in the element of this tag."""
    text = text_of(parent, tag) or ""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: {tag} is {text[:40]!r}, must be a number") from None


def text_of(parent: ElementTree.Element, tag: str) -> str | None:
    """The text in the element of this tag; None if there is none."""
    text = parent.findtext(tag)
    return None if text is None else text.strip()


def blocks(path: Path, data: ElementTree.Element) -> Iterator[tuple[str, ElementTree.Element]]:
    """The blocks of one wavelength, each with its name: "transmission" or "reflection", and "front" or "back"."""
    for block in data.iter("WavelengthDataBlock"):
        name = (text_of(block, "WavelengthDataDirection") or "").lower()
        kind, _, side = name.partition(" ")
        if kind not in ("transmission", "reflection") or side not in COME:
            raise ValueError(
                f"{path}: WavelengthDataDirection is {name!r}, must be Transmission or Reflection, Front or Back"
            )
        yield name, block
