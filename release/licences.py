"""Lists the licences of all that an SBOM names, and fails on one that is not allowed.

    python release/licences.py SBOM

licences.toml says what is allowed and why, and which licence those packages have whose metadata do not say it in SPDX.
"""

from __future__ import annotations

import functools
import json
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from license_expression import AND, OR, ExpressionError, get_spdx_licensing

RULES = Path(__file__).with_name("licences.toml")
_SPDX = get_spdx_licensing()
_OWN_WORDS = re.compile(r"LicenseRef-[A-Za-z0-9.-]+")
"""Name in SPDX of a licence that is in none of its lists."""


@functools.cache
def rules() -> Mapping[str, Mapping[str, str]]:
    """Tables `allowed` and `named` of licences.toml."""
    return tomllib.loads(RULES.read_text())


def spdx(name: str, licence: str) -> str | None:
    """A package's licence as an SPDX expression, None where nobody says one.

    Args:
        name: name of the package, normalised.
        licence: licence in its metadata.
    """
    if name in rules()["named"]:
        return rules()["named"][name]
    if _OWN_WORDS.fullmatch(licence):
        return licence
    try:
        parsed = _SPDX.parse(licence, validate=True, strict=True)
    except ExpressionError:
        return None
    return str(parsed) if parsed is not None else None


def refused(expression: str) -> set[str]:
    """The parts of an SPDX expression that are not allowed: of a choice, all of them only if none is allowed."""
    return _refused(_SPDX.parse(expression))


def _refused(parsed: Any) -> set[str]:
    if isinstance(parsed, AND):
        return set().union(*(_refused(part) for part in parsed.args))
    if isinstance(parsed, OR):
        parts = [_refused(part) for part in parsed.args]
        return set() if any(not part for part in parts) else set().union(*parts)
    return set() if str(parsed) in rules()["allowed"] else {str(parsed)}


def judged(sbom: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Package, licence, and what is wrong with it ('' where nothing is), for each component of an SBOM."""
    found = []
    for component in sbom["components"]:
        name = f"{component['name']} {component['version']}"
        words = [each.get("expression") or _name(each["license"]) for each in component.get("licenses", ())]
        if component["bom-ref"].startswith("pkg:deb/"):
            section = next(p["value"] for p in component["properties"] if p["name"] == "lightpage:debian-section")
            fault = f"is of Debian's area {section.partition('/')[0]}, not main" if "/" in section else ""
            found.append((f"{name} (Debian)", ", ".join(words) or "see its copyright file", fault))
            continue
        expression = spdx(component["name"], words[0] if words else "")
        if expression is None:
            found.append((name, ", ".join(words) or "none", "is no SPDX expression; name it in licences.toml"))
        else:
            bad = ", ".join(sorted(refused(expression)))
            found.append((name, expression, f"is not allowed: {bad}" if bad else ""))
    return found


def _name(licence: Mapping[str, str]) -> str:
    return licence.get("id") or licence["name"]


def main(arguments: Sequence[str]) -> int:
    """Run the command that the head of the file describes."""
    path = Path(arguments[0])
    if not path.is_file():
        print(f"{path}: no such file; `make sbom` writes it", file=sys.stderr)
        return 2
    rows = judged(json.loads(path.read_text()))
    for name, licence, fault in rows:
        print(f"{name:44} {licence}{f'   <- {fault}' if fault else ''}")
    bad = [name for name, _, fault in rows if fault]
    print(f"{len(rows)} packages, {len(bad)} of them with a licence that is not allowed")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
