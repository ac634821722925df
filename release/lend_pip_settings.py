"""Turns `pip config list` into what a pip inside an image build can use: settings, certificates, package folders.

    python3 -m pip config list | python3 release/lend_pip_settings.py FOLDER

Writes FOLDER/pip.conf and, where certificates are named, FOLDER/ca_bundle; prints the local folders that the settings
lean on, one a line: the build sees the first as /run/packages/0, the second as /run/packages/1. Standard library only:
it runs before anything is installed.
"""

from __future__ import annotations

import ast
import shutil
import sys
from pathlib import Path
from urllib.parse import unquote, urlparse

SOURCES = ("index-url", "extra-index-url", "find-links")
LENT = (*SOURCES, "trusted-host", "proxy", "timeout", "default-timeout")
CERTIFICATES_IN_BUILD = "/run/secrets/ca_bundle"
PACKAGES_IN_BUILD = "/run/packages"


def parse(listing: str) -> dict[str, str]:
    """Read lines KEY.OPTION='VALUE' as pip prints them; environment beats `install`, which beats `global`.

    Returns option name to value. Lines that are no settings are passed over: pip may print warnings among them.
    """
    weight = {"global": 0, "install": 1, ":env:": 2}
    found: dict[str, tuple[int, str]] = {}
    for line in listing.splitlines():
        key, equals, quoted = line.partition("=")
        section, dot, option = key.partition(".")
        if not (equals and dot) or section not in weight:
            continue
        if option not in found or weight[section] >= found[option][0]:
            found[option] = (weight[section], str(ast.literal_eval(quoted)))
    return {option: value for option, (_, value) in found.items()}


def local_folders(settings: dict[str, str]) -> list[Path]:
    """The folders of this machine that the settings find packages in: existing ones only, none inside another.

    An index kept as files has its links in a folder `simple` that points to files beside it; there the parent is lent.
    """
    words = " ".join(settings.get(option, "") for option in SOURCES).split()
    paths = [Path(unquote(urlparse(word).path)) for word in words if urlparse(word).scheme in ("", "file")]
    roots = [path.parent if path.name == "simple" else path for path in paths]
    folders = sorted({root for root in roots if root.is_absolute() and root.is_dir()})
    return [folder for folder in folders if not any(other in folder.parents for other in folders)]


def moved(value: str, folders: list[Path]) -> str:
    """The words of `value` with every lent folder at its place in the build, PACKAGES_IN_BUILD/its number."""
    words = []
    for word in value.split():
        for number, folder in enumerate(folders):
            place = f"{PACKAGES_IN_BUILD}/{number}"
            for start in (folder.as_uri(), str(folder)):
                if word == start or word.startswith(f"{start}/"):
                    word = word.replace(start, f"file://{place}" if start.startswith("file:") else place, 1)
        words.append(word)
    return " ".join(words)


def main() -> None:
    """Run the command that the head of the file describes."""
    out = Path(sys.argv[1])
    settings = parse(sys.stdin.read())
    folders = local_folders(settings)
    lines = ["[global]", *(f"{option} = {moved(settings[option], folders)}" for option in LENT if option in settings)]
    certificates = Path(settings.get("cert", ""))
    if certificates.is_file():
        shutil.copyfile(certificates, out / "ca_bundle")
        lines.append(f"cert = {CERTIFICATES_IN_BUILD}")
    (out / "pip.conf").write_text("\n".join(lines) + "\n")
    for folder in folders:
        print(folder)


if __name__ == "__main__":
    main()
