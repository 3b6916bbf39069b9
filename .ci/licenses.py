"""The licenses of all that torchreg depends on, with every extra; ends with 1 if one is GPL or is not told.

python .ci/licenses.py      one line per installed distribution: name, version, license, what asks for it
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections import deque
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

# Licenses whose terms would reach torchreg's own code; the Lesser GPL leaves what merely imports a library alone.
_REFUSED = re.compile(r"(?<!L)(?<!Lesser )(?<!Library )\b(A?GPL|GNU (Affero )?General Public)", re.IGNORECASE)
ROOT = "torchreg-articulated"
_NAME = re.compile(r"[A-Za-z0-9._-]+")
# Distributions, by the beginning of their names, whose metadata tell no license, or more than one that does not matter.
KNOWN = {
    "nvidia": "NVIDIA's own, as part of torch",
    "docutils": "public domain and BSD; its one other file, for Emacs, is not installed; builds the pages alone",
}


def requirements() -> list[str]:
    """Return what pyproject.toml asks for, with every extra."""
    text = (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    extras = project["optional-dependencies"].values()
    rows = [*project["dependencies"], *(row for extra in extras for row in extra)]
    return [row for row in rows if not row.startswith(ROOT)]


def dependencies() -> Iterator[tuple[metadata.Distribution, str]]:
    """Yield each installed distribution that torchreg or another one needs, with the name of that one."""
    asked_for = (_NAME.match(row) for row in requirements())
    waiting, seen = deque((found.group(), ROOT) for found in asked_for if found is not None), set[str]()
    while waiting:
        name, asked = waiting.popleft()
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key in seen:
            continue
        seen.add(key)
        try:
            found = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # of another system, or an extra that is not installed
        yield found, asked
        for row in found.requires or ():
            matched = _NAME.match(row)
            if matched is not None and "extra ==" not in row:
                waiting.append((matched.group(), name))


def license_of(found: metadata.Distribution) -> str:
    """Return the license that a distribution tells, empty if none."""
    told, name = found.metadata, found.metadata["Name"].lower()
    for beginning, text in KNOWN.items():
        if name.startswith(beginning):
            return text
    rows = [row.rpartition(":: ")[2] for row in told.get_all("Classifier") or () if row.startswith("License ::")]
    # Some put the whole text into the field.
    words = [told.get("License-Expression") or "", "; ".join(rows), (told.get("License") or "").strip().split("\n")[0]]
    for text in words:
        if text and text not in ("OSI Approved", "UNKNOWN"):
            return text[:100]
    return _by_file(found)


def _by_file(found: metadata.Distribution) -> str:
    """Return the first line of a distribution's license file that says something, empty without one."""
    for path in found.files or ():
        if re.match(r"(LICEN[CS]E|COPYING)", path.name, re.IGNORECASE):
            rows = (path.read_text() or "").splitlines() if path.locate().exists() else []
            told = next((row.strip() for row in rows if row.strip()), "")
            if told:
                return told[:100]
    return ""


def main() -> int:
    """Print all licenses; return 1 if one is refused or unknown."""
    bad = []
    for found, asked in sorted(dependencies(), key=lambda pair: pair[0].metadata["Name"].lower()):
        name, told = found.metadata["Name"], license_of(found)
        print(f"{name:32} {found.version:18} {told or 'UNKNOWN':50.50} for {asked}")
        if not told or _REFUSED.search(told):
            bad.append(f"{name}: {told or 'tells no license'}")
    for text in bad:
        print(f"not allowed: {text}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
