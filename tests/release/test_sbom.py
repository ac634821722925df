"""An SBOM names all that is in an image, is CycloneDX, and whatever differs from it afterwards is found."""

import base64
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.release.scripts import script

inventory, licences, sbom = script("inventory"), script("licences"), script("sbom")
LABELS = {f"{sbom.OCI}title": "lightpage runtime", f"{sbom.OCI}version": "0.1.0", f"{sbom.OCI}revision": 40 * "a"}
LABELS[f"{sbom.OCI}created"] = "2026-11-25T12:00:00Z"
STATUS = """Package: libgood1
Status: install ok installed
Architecture: amd64
Multi-Arch: same
Version: 1:2.0+deb12u1
Section: libs
Description: a library
 of more than one line

Package: gone
Status: deinstall ok config-files
Architecture: amd64
Version: 1
"""


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def write(path: Path, content: bytes) -> bytes:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return content


def listed(path: str, content: bytes) -> str:
    """A file's line in RECORD."""
    hashed = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
    return f"{path},sha256={hashed},{len(content)}"


def install(site: Path, name: str, version: str, licence: str, files: dict[str, bytes]) -> None:
    """A distribution as pip leaves it."""
    folder = f"{name}-{version}.dist-info"
    metadata = f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\nLicense-Expression: {licence}\n".encode()
    lines = []
    for path, content in {**files, f"{folder}/METADATA": metadata}.items():
        write(site / path, content)
        lines.append(listed(path, content))
    for path in filter(lambda path: path.endswith(".py"), files):
        compiled = Path(path).parent / "__pycache__" / f"{Path(path).stem}.cpython-311.pyc"
        write(site / compiled, b"compiled")
        lines.append(f"{compiled},,")
    write(site / folder / "RECORD", "\n".join([*lines, f"{folder}/RECORD,,"]).encode())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The files of a small image."""
    return image(tmp_path / "root")


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The SBOM of `root` before anything is planted there."""
    return told(image(tmp_path_factory.mktemp("image")))


def image(root: Path) -> Path:
    """Write the files of a small image."""
    site = root / "opt/lightpage/lib/python3.11/site-packages"
    install(site, "lightpage", "0.1.0", "MIT", {"lightpage/__init__.py": b""})
    files = {"click/__init__.py": b"import os\n", "click.libs/libfast-1a.so.2": b"elf", "click/_c.abi3.so": b"elf"}
    install(site, "Click", "8.5.1", "BSD-3-Clause", files)
    for name, target in (("bin/python3", "/usr/bin/python3"), ("bin/python", "python3"), ("lib64", "lib")):
        (root / "opt/lightpage" / name).parent.mkdir(exist_ok=True)
        (root / "opt/lightpage" / name).symlink_to(target)
    write(root / "opt/lightpage/bin/activate", b"")
    write(root / "opt/lightpage/pyvenv.cfg", b"home = /usr/bin\ninclude-system-site-packages = false\n")
    wheels = f"{64 * '1'}  lightpage-0.1.0-cp311-abi3-linux_x86_64.whl\n{64 * '2'}  click-8.5.1-py3-none-any.whl\n"
    write(root / "opt/lightpage/wheels.sha256", wheels.encode())
    write(root / "etc/os-release", b'NAME="Debian"\nVERSION_ID="12"\n')
    write(root / "var/lib/dpkg/status", STATUS.encode())
    library = write(root / "usr/lib/libgood.so.1", b"library")
    (root / "lib").symlink_to("/usr/lib")  # that of the image, not of this machine
    left_out = f"{32 * '0'}  usr/share/doc/libgood1/README\n"
    md5 = hashlib.md5(library).hexdigest()
    write(root / "var/lib/dpkg/info/libgood1:amd64.md5sums", f"{md5}  lib/libgood.so.1\n{left_out}".encode())
    notice = b"Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\n\nLicense: LGPL-2+\n"
    write(root / "usr/share/doc/libgood1/copyright", notice)
    return root


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    path = tmp_path / "runtime.txt"
    path.write_text(f"# Made.\nclick==8.5.1 \\\n    --hash=sha256:{64 * '9'} \\\n    --hash=sha256:{64 * '2'}\n")
    return path


def told(root: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(sbom.sbom(inventory.take(root), LABELS))
    return document


def test_it_names_every_package_with_version_checksum_licence_and_libraries(document: dict[str, Any]) -> None:
    components = {component["bom-ref"]: component for component in document["components"]}
    assert components.keys() == {
        "pkg:pypi/click@8.5.1",
        "pkg:pypi/lightpage@0.1.0",
        "pkg:deb/debian/libgood1@1%3A2.0%2Bdeb12u1?arch=amd64&distro=debian-12",
    }
    click = components["pkg:pypi/click@8.5.1"]
    assert click["hashes"] == [{"alg": "SHA-256", "content": 64 * "2"}]
    assert click["licenses"] == [{"license": {"id": "BSD-3-Clause"}}]
    assert [(each["name"], each["hashes"][0]["content"]) for each in click["components"]] == [
        ("click.libs/libfast-1a.so.2", digest(b"elf"))
    ]
    [debian] = [component for ref, component in components.items() if ref.startswith("pkg:deb/")]
    assert (debian["version"], debian["licenses"]) == ("1:2.0+deb12u1", [{"license": {"name": "LGPL-2+"}}])
    said = {each["name"]: each["value"] for each in document["metadata"]["component"]["properties"]}
    assert said == LABELS
    assert document["metadata"]["timestamp"] == "2026-11-25T12:00:00+00:00"


def test_the_image_that_it_was_made_of_agrees_with_it_and_with_the_lock(
    root: Path, lock: Path, document: dict[str, Any]
) -> None:
    assert inventory.differences(inventory.take(root), document) == []
    assert inventory.differences_from_lock(inventory.take(root), lock) == []


def subjects(lines: Iterable[str]) -> list[str]:
    """Return the subject of each line."""
    return [line.rpartition(": ")[0] for line in lines]


def moved_and_linked(path: Path, to: Path) -> None:
    """Move it, and leave a link as the image would follow it."""
    path.rename(to)
    path.symlink_to(Path("/usr/lib", to.name))


def relinked(path: Path, target: str) -> None:
    path.unlink()
    path.symlink_to(target)


def written(path: str | Path, content: bytes) -> Callable[[Path], object]:
    return lambda root: write(root / path, content)


SITE = Path("opt/lightpage/lib/python3.11/site-packages")
OWN, CLICK = "lib/python3.11/site-packages", "click/__init__.py"
DEBIAN = "pkg:deb/debian/libgood1@1%3A2.0%2Bdeb12u{}?arch=amd64&distro=debian-12"
OTHER_CONFIGURATION = b"home = /state\ninclude-system-site-packages = true\n"
PLANTED: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "a changed module": (written(SITE / CLICK, b"import socket\n"), [f"Click: {CLICK}"]),
    "a module of nobody": (written(SITE / "usercustomize.py", b""), [f"{OWN}/usercustomize.py"]),
    "byte code of nobody that needs no source": (written(SITE / "socket.pyc", b""), [f"{OWN}/socket.pyc"]),
    "a linked package": (lambda root: (root / SITE / "extra").symlink_to("../../../../../usr/lib"), [f"{OWN}/extra"]),
    "a package that has become a link": (
        lambda root: moved_and_linked(root / SITE / "lightpage", root / "usr/lib/own"),
        [f"{OWN}/lightpage", "lightpage: lightpage/__init__.py"],
    ),
    "another Python": (lambda root: relinked(root / "opt/lightpage/bin/python3", "/state/python3"), ["bin/python3"]),
    "a Python with packages of others": (written("opt/lightpage/pyvenv.cfg", OTHER_CONFIGURATION), 2 * ["pyvenv.cfg"]),
    "a pipe": (lambda root: os.mkfifo(root / "opt/lightpage/bin/pipe"), ["bin/pipe"]),
    "a package that is gone": (
        lambda root: [shutil.rmtree(path) for path in (root / SITE).glob("[cC]lick*")],
        ["pkg:pypi/click@8.5.1"],
    ),
    "another version of Debian's": (
        written("var/lib/dpkg/status", STATUS.replace("deb12u1", "deb12u2").encode()),
        [DEBIAN.format(1), DEBIAN.format(2)],
    ),
    "a changed library of Debian's": (written("usr/lib/libgood.so.1", b"other"), ["libgood1: lib/libgood.so.1"]),
}


def test_links_of_the_image_end_in_the_image(root: Path, tmp_path: Path) -> None:
    library = root / "usr/lib/libgood.so.1"
    library.rename(tmp_path / "outside")  # with the right content, and where no program of the image finds it
    library.symlink_to("hop")
    (library.parent / "hop").symlink_to(tmp_path / "outside")
    assert subjects(inventory.take(root).faults) == ["libgood1: lib/libgood.so.1"]
    for target in (f"{20 * '../'}{tmp_path}/outside", "libgood.so.1"):  # the second: in a circle
        relinked(library.parent / "hop", target)
        assert subjects(inventory.take(root).faults) == ["libgood1: lib/libgood.so.1"]


@pytest.mark.parametrize("name", PLANTED)
def test_a_difference_is_found(root: Path, document: dict[str, Any], name: str) -> None:
    plant, expected = PLANTED[name]
    plant(root)
    assert subjects(inventory.differences(inventory.take(root), document)) == expected


def test_a_file_and_its_checksum_changed_together_are_found(root: Path, document: dict[str, Any]) -> None:
    install(root / SITE, "Click", "8.5.1", "BSD-3-Clause", {"click/__init__.py": b"import socket\n"})
    found = inventory.differences(inventory.take(root), document)
    assert any(line.startswith("pkg:pypi/click@8.5.1: record is ") for line in found)


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        (64 * "2", 64 * "3", "click"),
        ("8.5.1", "8.5.0", "click"),
        ("click==", f"idna==3.20 --hash=sha256:{64 * '4'}\nclick==", "idna"),
    ],
)
def test_an_image_of_another_lock_is_found(root: Path, lock: Path, old: str, new: str, name: str) -> None:
    lock.write_text(lock.read_text().replace(old, new))
    found = inventory.differences_from_lock(inventory.take(root), lock)
    assert any(line.startswith(f"{name}: ") for line in found)


def test_licences_of_an_image_are_judged_by_its_sbom(document: dict[str, Any]) -> None:
    assert licences.judged(document) == [
        ("click 8.5.1", "BSD-3-Clause", ""),
        ("libgood1 1:2.0+deb12u1 (Debian)", "LGPL-2+", ""),
        ("lightpage 0.1.0", "MIT", ""),
    ]


ALLOWED = "MIT OR GPL-3.0-only", "GPL-3.0-or-later WITH GCC-exception-3.1"


# BSD is no SPDX expression
@pytest.mark.parametrize("licence", ["AGPL-3.0-only", "MIT AND GPL-3.0-only", "LicenseRef-Secret", "BSD", "", *ALLOWED])
def test_what_licences_are_allowed(licence: str) -> None:
    package = inventory.PythonPackage("other", "1", "", "", "", licence)
    component = json.loads(sbom.JsonV1Dot6(sbom.Bom(components=[sbom.python_component(package)])).output_as_string())
    [(_, _, fault)] = licences.judged(component)
    assert (fault == "") == (licence in ALLOWED)


def test_debian_packages_that_are_not_of_main_are_named(root: Path) -> None:
    write(root / "var/lib/dpkg/status", STATUS.replace("Section: libs", "Section: non-free/libs").encode())
    [found] = [fault for name, _, fault in licences.judged(told(root)) if "Debian" in name]
    assert "non-free" in found
