"""Strict XML: what is well-formed is read as it stands, entities and deep nesting are refused."""

import pytest

from torchreg.errors import FormatError
from torchreg.io.strict_xml import parse_xml


def test_elements_come_as_they_stand():
    root = parse_xml(b"\n <?xml version='1.0'?><a x='1'>t<b/><!-- c --><b y='&lt;'/></a>")
    assert (root.tag, root.attrib, root.text) == ("a", {"x": "1"}, "t")
    assert [child.attrib for child in root] == [{}, {"y": "<"}]


def test_other_encodings_are_read():
    assert parse_xml("<?xml version='1.0' encoding='utf-16'?><a x='ü'/>".encode("utf-16")).get("x") == "ü"


def test_nesting_is_limited_in_depth_not_in_number():
    assert len(parse_xml(b"<a>" + b"<b></b>" * 500 + b"</a>")) == 500
    parse_xml(b"<a>" * 64 + b"</a>" * 64)
    with pytest.raises(FormatError, match="nests elements more than 64 deep"):
        parse_xml(b"<a>" * 65 + b"</a>" * 65)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not well-formed XML"),
        (b"<a>", "not well-formed XML"),
        (b"<a></b>", "not well-formed XML"),
        (b"<?xml version='1.0' encoding='klingon'?><a/>", "not well-formed XML"),
        (b"<a>\xff</a>", "not well-formed XML"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", r"document type declaration \('a'\)"),
        (b"<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>", "document type declaration"),
    ],
)
def test_what_is_refused(content, message):
    with pytest.raises(FormatError, match=message):
        parse_xml(content)
