"""XML from anywhere: no document types, whose entities may open files and grow without end, and no deep nesting."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from torchreg.errors import FormatError
from torchreg.io.limits import FILE_BUDGET

# Elements within each other in any honest robot description are far fewer.
_MAX_DEPTH = 64


class _StrictBuilder(ET.TreeBuilder):
    """A builder of the element tree that refuses document types (which bring entities) and absurd nesting."""

    depth = 0
    count = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise FormatError(
            f"has a document type declaration ({name!r}), which robot descriptions do not need; remove it"
        )

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:
        self.depth += 1
        self.count += 1
        if self.count > FILE_BUDGET.elements:
            raise FormatError(f"has more than {FILE_BUDGET.elements} elements, which no robot description has")
        if self.depth > _MAX_DEPTH:
            raise FormatError(f"nests elements more than {_MAX_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ET.Element:
        self.depth -= 1
        return super().end(tag)


def parse_xml(content: bytes) -> ET.Element:
    """Return the outermost element of a document."""
    parser = ET.XMLParser(target=_StrictBuilder())
    try:
        # Blank lines before the declaration are common, harmless, and an error to the parser.
        parser.feed(content.lstrip(b" \t\r\n"))
        root: ET.Element = parser.close()
    except (ET.ParseError, ValueError, LookupError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"not well-formed XML ({error})") from error
    return root
