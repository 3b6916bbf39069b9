"""XML from anywhere: no document types, whose entities may open files and grow without end, and no deep nesting."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from xml.parsers import expat

from torchreg.errors import FormatError
from torchreg.io.file_format import plain_text
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


_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_DECLARATION = re.compile(rb"\s*<\?xml[^>]*\?>")


def parse_lenient_xml(content: bytes) -> ET.Element:
    """Return the outermost element of a document that is read as robots' tools read it.

    Byte order marks, zeros at the end, comments before the declaration and hyphens in comments do no harm. Namespaces
    mean nothing: prefixes are part of the names, those of the outermost element are left out everywhere.
    """
    text = plain_text(content).rstrip(b"\0 \t\r\n")
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = _DECLARATION.sub(b"", text, count=1)  # says UTF-16, which it is no longer
    try:
        root = _parsed_names(_COMMENT.sub(_blank_lines, text))
    except FormatError as error:
        # Perhaps a block that holds comments was commented out.
        whole = _without_nested_comments(text)
        if whole is None:
            raise
        try:
            root = _parsed_names(whole)
        except FormatError:
            raise error from None
    prefix, colon, _ = root.tag.partition(":")
    if colon:
        for element in root.iter():
            element.tag = element.tag.removeprefix(prefix + colon)
    return root


def _blank_lines(comment: re.Match[bytes]) -> bytes:
    """Return as many lines as a comment has, so that messages name the right one."""
    return b"\n" * comment.group().count(b"\n")


def _without_nested_comments(text: bytes) -> bytes | None:
    """Return a document without its comments, which may hold comments; None if none does, or they are not closed."""
    kept, depth, start, nested = list[bytes](), 0, 0, False
    for mark in re.finditer(rb"<!--|-->", text):
        opens = mark.group() == b"<!--"
        if depth == 0 and opens:
            kept.append(text[start : mark.start()])
        nested = nested or (opens and depth > 0)
        depth = depth + 1 if opens else max(depth - 1, 0)
        start = mark.end() if depth == 0 else start
    return None if depth or not nested else b"".join([*kept, text[start:]])


def _parsed_names(text: bytes) -> ET.Element:
    """Return the outermost element of a document whose prefixes are part of the names."""
    blank = len(text) - len(text.lstrip())
    builder, parser = _StrictBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = lambda name, system, public, _: builder.doctype(name, public, system)
    try:
        parser.Parse(text[blank:], True)
        root: ET.Element = builder.close()
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(_told(error, text[:blank].count(b"\n"))) from error
    return root


def _told(error: Exception, before: int) -> str:
    """Return what is wrong with a document, and where, given the lines before what was parsed."""
    if not isinstance(error, expat.ExpatError):
        return f"not well-formed XML ({error})"
    what, line = expat.errors.messages[error.code], error.lineno + before
    if what in ("no element found", "unclosed token"):
        return f"not well-formed XML: it ends at line {line} before an element is closed; is it cut off?"
    return f"not well-formed XML ({what}: line {line}, column {error.offset})"
