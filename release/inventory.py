"""Inventory of an image: reads its files from outside, and compares them with an SBOM and a lock.

    python3 release/inventory.py ROOT                         # as JSON
    python3 release/inventory.py ROOT --against SBOM LOCK     # exit status 1, and a line for each difference

ROOT is the image's root folder. No program of the image is run. Standard library only: the check runs where nothing is
installed.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import Distribution, distributions
from pathlib import Path, PurePath
from typing import Any

from lock import BUILT_FROM_SOURCE, normal, read_lock

ENVIRONMENT = Path("opt/lightpage")
"""Environment of Python in the image."""
PYTHON_FOLDER = Path("/usr/bin")
"""Folder of the image's Python, which the environment names and links to."""
WHEELS = "wheels.sha256"
"""The list of installed wheels, in the environment."""
OWN_FILES = frozenset(
    ["pyvenv.cfg", *(f"bin/{name}" for name in ("activate", "activate.csh", "activate.fish", "Activate.ps1")), WHEELS]
)
"""Files of the environment that come with no package: of venv, and the list of wheels."""
MOST_LINKS = 40
"""Most links on the way to a file, as in Linux."""
INTERPRETER = re.compile(r"python3?|python3\.\d+")
"""Names of venv's links to Python."""
LEFT_OUT = (
    "usr/share/doc/",
    "usr/share/man/",
    "usr/share/locale/",
    "usr/share/info/",
    "usr/share/groff/",
    "usr/share/lintian/",
    "usr/share/linda/",
)
"""Folders that images of Debian leave out."""
SHARED_OBJECT = re.compile(r"(.+?)\.so(\.[\w.]+)?")
OWN = "lightpage"
LONGEST_NAME = 200
"""Longest name of a licence, characters."""
PREFIX = "lightpage:"
"""Prefix of the names of this project's properties in an SBOM."""


@dataclass(frozen=True)
class PythonPackage:
    """A distribution in the image's environment.

    Args:
        wheel: file name of the wheel that it was installed from.
        sha256: checksum of that wheel.
        record_sha256: checksum of the list of its files, which holds a checksum of each.
        libraries: shared objects that it brings for others to link with, path in the environment to SHA-256.
        licence: licence in its metadata: an SPDX expression, or free text, or nothing.
    """

    name: str
    version: str
    wheel: str
    sha256: str
    record_sha256: str
    licence: str
    libraries: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class DebianPackage:
    """An installed package of Debian.

    Args:
        section: section with the area before it, unless that is `main`.
        record_sha256: checksum of the list of its files, which holds an MD5 of each; empty where it has none.
        licences: short names of the machine-readable part of its copyright file.
    """

    name: str
    version: str
    architecture: str
    section: str
    record_sha256: str
    licences: tuple[str, ...]


@dataclass(frozen=True)
class Inventory:
    """Inventory of an image. `faults` are files that are not as their package's list says, and files of no package."""

    python: tuple[PythonPackage, ...]
    debian: tuple[DebianPackage, ...]
    release: str
    faults: tuple[str, ...]


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def take(root: Path) -> Inventory:
    """Read an image's files.

    Raises:
        FileNotFoundError: it is none of this project's images.
    """
    environment = root.resolve() / ENVIRONMENT
    files, faults = walk(environment)
    faults += [f"{part}: is a link" for part in (ENVIRONMENT, ENVIRONMENT.parent) if (root / part).is_symlink()]
    [site] = environment.glob("lib/python3*/site-packages")
    listed_wheels = (line.split("  ") for line in (environment / WHEELS).read_text().splitlines())
    wheels = {file: digest for digest, file in listed_wheels}
    packages, owned = [], {environment / name for name in OWN_FILES}
    for found in sorted(distributions(path=[str(site)]), key=lambda each: normal(each.name)):
        if folder_of(found) / "RECORD" not in files:
            faults.append(f"{found.name}: has no list of its files")
            continue
        listed, wrong = check_files(found, site, files)
        owned |= listed
        faults += [f"{found.name}: {fault}" for fault in wrong]
        packages.append(python_package(found, site, wheels, files))
    faults += [f"{path.relative_to(environment)}: belongs to no package" for path in sorted(files - owned)]
    faults += check_settings(environment / "pyvenv.cfg")
    debian = tuple(debian_packages(root))
    for package in debian:
        faults += [f"{package.name}: {fault}" for fault in check_debian_files(root, package)]
    release = re.search(r'^VERSION_ID="(.*)"$', (root / "etc/os-release").read_text(), re.MULTILINE)
    return Inventory(tuple(packages), debian, release[1] if release else "unknown", tuple(faults))


def walk(environment: Path) -> tuple[set[Path], list[str]]:
    """The regular files of an environment, and what is neither a file nor a folder there. Links are not followed.

    venv's own links to Python, and `lib64` to `lib`, are in order.
    """
    files, faults = set[Path](), []
    for folder, names, others in os.walk(environment):
        for name in sorted([*names, *others]):
            path = Path(folder, name)
            inside = path.relative_to(environment)
            if path.is_symlink():
                if not is_of_venv(inside, path.readlink()):
                    faults.append(f"{inside}: is a link to {path.readlink()}")
            elif path.is_file():
                files.add(path)
            elif not path.is_dir():
                faults.append(f"{inside}: is neither a file nor a folder")
    return files, faults


def is_of_venv(link: Path, target: Path) -> bool:
    """Return whether venv makes such a link, named within the environment."""
    if link == Path("lib64"):
        return target == Path("lib")
    known = link.parent == Path("bin") and target.parent in (Path(), PYTHON_FOLDER)
    return known and all(INTERPRETER.fullmatch(path.name) for path in (link, target))


def check_settings(path: Path) -> Iterator[str]:
    """Yield the faults of the file that says which Python an environment has."""
    pairs = (line.partition("=") for line in path.read_text().splitlines())
    settings = {key.strip().lower(): value.strip() for key, _, value in pairs}
    for key, expected in (("home", str(PYTHON_FOLDER)), ("include-system-site-packages", "false")):
        if settings.get(key) != expected:
            yield f"{path.name}: {key} is {settings.get(key)}, not {expected}"


def check_files(found: Distribution, site: Path, files: set[Path]) -> tuple[set[Path], list[str]]:
    """The files that a distribution lists, and what is wrong with them.

    Only its list itself and byte code in `__pycache__` have no checksum.

    Args:
        found: the distribution.
        site: folder that its list begins at.
        files: regular files of the environment.
    """
    owned, wrong = set[Path](), []
    for entry in found.files or ():
        path = installed(site, entry)
        owned.add(path)
        if entry.hash is None:
            compiled = path.suffix == ".pyc" and path.parent.name == "__pycache__"
            if path != folder_of(found) / "RECORD" and not compiled:
                wrong.append(f"{entry}: has no checksum")
            continue
        if path not in files:
            wrong.append(f"{entry}: is missing")
            continue
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, entry.hash.mode).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != entry.hash.value:
            wrong.append(f"{entry}: is not the file that was installed")
    return owned, wrong


def installed(site: Path, entry: PurePath) -> Path:
    """Return the path of a file of a distribution's list; scripts are outside `site`."""
    return Path(os.path.normpath(site / entry))


def folder_of(found: Distribution) -> Path:
    """Return the folder of a distribution's metadata."""
    return Path(str(found._path))  # type: ignore[attr-defined]  # it has no public name


def python_package(found: Distribution, site: Path, wheels: dict[str, str], files: set[Path]) -> PythonPackage:
    """Describe one distribution; arguments as for `check_files`, and SHA-256 of wheels by file name."""
    name, version = normal(found.name), found.version
    wheel = next((file for file in wheels if is_wheel_of(file, name, version)), "")
    libraries = {
        str(entry): sha256(installed(site, entry))
        for entry in sorted(found.files or ())
        if is_library(entry.name) and installed(site, entry) in files
    }
    record = sha256(folder_of(found) / "RECORD")
    return PythonPackage(name, version, wheel, wheels.get(wheel, ""), record, licence_of(found), libraries)


def licence_of(found: Distribution) -> str:
    """Return the licence in a distribution's metadata: an SPDX expression, a few words, or nothing."""
    metadata = found.metadata
    licence: str = next(iter(metadata.get_all("License-Expression") or metadata.get_all("License") or [""])).strip()
    if licence and "\n" not in licence and len(licence) <= LONGEST_NAME:
        return licence  # others put the whole text there
    classifiers = [c for c in metadata.get_all("Classifier") or () if c.startswith("License ::")]
    return ", ".join(each.rpartition(" :: ")[2] for each in classifiers)


def is_wheel_of(file: str, name: str, version: str) -> bool:
    """Return whether a wheel's file name is that of this distribution."""
    its_name, its_version, *_ = file.split("-")
    return (normal(its_name), its_version) == (name, version)


def is_library(name: str) -> bool:
    """Return whether a file is a shared object for others to link with, not a module of Python."""
    matched = SHARED_OBJECT.fullmatch(name)
    return matched is not None and name.startswith("lib") and not matched[1].endswith((".abi3", "-linux-gnu"))


def debian_packages(root: Path) -> Iterator[DebianPackage]:
    """Yield the packages that dpkg lists as installed, by name."""
    paragraphs = (root / "var/lib/dpkg/status").read_text().strip().split("\n\n")
    found = [dict(re.findall(r"^([\w-]+): (.*)$", paragraph, re.MULTILINE)) for paragraph in paragraphs]
    for fields in sorted(found, key=lambda each: each["Package"]):
        if fields.get("Status", "").endswith(" installed"):
            name, architecture = fields["Package"], fields["Architecture"]
            record = debian_record(root, name, architecture)
            yield DebianPackage(
                name,
                fields["Version"],
                architecture,
                fields.get("Section", ""),
                sha256(record) if record is not None else "",
                licence_names(root / "usr/share/doc" / name / "copyright"),
            )


def debian_record(root: Path, name: str, architecture: str) -> Path | None:
    """dpkg's list of a package's files with their MD5, where it has one."""
    folder = root / "var/lib/dpkg/info"
    paths = (folder / f"{name}.md5sums", folder / f"{name}:{architecture}.md5sums")
    return next((path for path in paths if path.is_file()), None)


def check_debian_files(root: Path, package: DebianPackage) -> Iterator[str]:
    """Yield the faults of a package's files. Those that a slim Debian leaves out may be missing."""
    record = debian_record(root, package.name, package.architecture)
    for line in record.read_text().splitlines() if record is not None else ():
        expected, name = line.split(maxsplit=1)
        path = within(root, name)
        if path is None:
            if not name.startswith(LEFT_OUT):
                yield f"{name}: is missing"
            continue
        with path.open("rb") as file:
            if hashlib.file_digest(file, "md5").hexdigest() != expected:
                yield f"{name}: is not the file that was installed"


def within(root: Path, name: str) -> Path | None:
    """A file of the image by its name there, through links that begin and end in the image's root; None: no file."""
    path, parts, links = root, deque(Path(name).parts), 0
    while parts:
        part = parts.popleft()
        if part == "..":
            path = path if path == root else path.parent
        elif part == "/":
            path = root
        elif (path / part).is_symlink():
            if (links := links + 1) > MOST_LINKS:
                return None
            parts.extendleft(reversed((path / part).readlink().parts))
        else:
            path = path / part
    return path if path.is_file() else None


def licence_names(path: Path) -> tuple[str, ...]:
    """Short names of licences in a Debian copyright file, where it has the machine-readable form."""
    if not path.is_file():
        return ()
    text = path.read_text("utf-8", "replace")
    if "copyright-format" not in text:
        return ()
    return tuple(sorted({name.strip() for name in re.findall(r"^License: *(\S.*)$", text, re.MULTILINE | re.I)}))


# ---- against an SBOM -----------------------------------------------------------------------------------------------


def differences(inventory: Inventory, sbom: Mapping[str, Any]) -> list[str]:
    """List the differences between an image and an SBOM, a line each."""
    said = {component["bom-ref"]: facts_of_component(component) for component in sbom["components"]}
    found = facts(inventory)
    lines = [f"{ref}: in the image, not in the SBOM" for ref in found if ref not in said]
    lines += [f"{ref}: in the SBOM, not in the image" for ref in said if ref not in found]
    for ref in found.keys() & said.keys():
        for key in sorted(found[ref].keys() | said[ref].keys()):
            if found[ref].get(key) != said[ref].get(key):
                lines.append(f"{ref}: {key} is {found[ref].get(key)}; the SBOM says {said[ref].get(key)}")
    return [*inventory.faults, *sorted(lines)]


def python_ref(package: PythonPackage) -> str:
    """Package URL of a distribution."""
    return f"pkg:pypi/{package.name}@{package.version}"


def debian_ref(package: DebianPackage, release: str) -> str:
    """Package URL of a Debian package."""
    version = package.version.replace("+", "%2B").replace(":", "%3A")
    name = package.name.replace("+", "%2B")
    return f"pkg:deb/debian/{name}@{version}?arch={package.architecture}&distro=debian-{release}"


def facts(inventory: Inventory) -> dict[str, dict[str, str]]:
    """Return what is compared, by package URL: checksums of its list of files, its wheel and its libraries."""
    found = {debian_ref(each, inventory.release): {"record": each.record_sha256} for each in inventory.debian}
    for package in inventory.python:
        found[python_ref(package)] = {
            "wheel": package.sha256,
            "record": package.record_sha256,
            **package.libraries,
        }
    return found


def facts_of_component(component: Mapping[str, Any]) -> dict[str, str]:
    """Return what is compared of an SBOM's component, by the names of `facts`."""
    properties = {each["name"]: each["value"] for each in component.get("properties", ())}
    record = {"record": properties.get(f"{PREFIX}record-sha256", "")}
    if component["bom-ref"].startswith("pkg:deb/"):
        return record
    wheel = next((each["content"] for each in component.get("hashes", ())), "")
    libraries = {each["name"]: each["hashes"][0]["content"] for each in component.get("components", ())}
    return {"wheel": wheel, **record, **libraries}


def differences_from_lock(inventory: Inventory, lock: Path) -> list[str]:
    """List the differences between an image's Python packages and a lock, a line each. Our own is in no lock."""
    locked = read_lock(lock)
    found = {package.name: package for package in inventory.python if package.name != OWN}
    lines = [f"{name}: is in {lock.name}, not in the image" for name in locked.keys() - found.keys()]
    for name, package in found.items():
        if name not in locked:
            lines.append(f"{name}: is in the image, not in {lock.name}")
        elif package.version != locked[name].version:
            lines.append(f"{name}: is {package.version}; {lock.name} says {locked[name].version}")
        elif package.sha256 not in locked[name].hashes and name not in BUILT_FROM_SOURCE:
            lines.append(
                f"{name}: its wheel has SHA-256 {package.sha256 or 'unknown'}, which {lock.name} does not name"
            )
    return sorted(lines)


def main(arguments: Sequence[str]) -> int:
    """Run the command that the head of the file describes."""
    inventory = take(Path(arguments[0]))
    if arguments[1:2] != ["--against"]:
        print(json.dumps(asdict(inventory), indent=1))
        return 0
    path = Path(arguments[2])
    if not path.is_file():
        print(f"{path}: no SBOM; make one with `make sbom`")
        return 1
    lines = differences(inventory, json.loads(path.read_text())) + differences_from_lock(inventory, Path(arguments[3]))
    print(*lines, sep="\n", end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
