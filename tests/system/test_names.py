"""All that is installed lies under `lightpage.`, and a caller's own modules of any name break nothing."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = sorted(path.name for path in (ROOT / "lightpage").iterdir() if path.is_symlink())
"""Folders at the top that are linked into the package."""
CALLERS = (*FOLDERS, "analysis", "release", "tests", "proto", "client", "wire", "errors", "model", "service", "toy")
"""Names that a caller's own modules may have."""


def sources() -> list[Path]:
    told = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in told.split("\0") if (path := ROOT / name).is_file() and not path.is_symlink()]


def test_every_package_is_linked_and_found_by_all_who_look() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert {"train", "export", "runtime", "report", "study"} <= set(FOLDERS)
    assert settings["tool"]["setuptools"]["packages"]["find"]["include"] == ["lightpage", "lightpage.*"]
    assert "lightpage" in settings["tool"]["mypy"]["packages"]
    assert all(os.readlink(ROOT / "lightpage" / name) == f"../{name}" for name in FOLDERS)


def test_nothing_is_imported_by_its_folders_name() -> None:
    """A module would otherwise be loaded twice, and errors of the one not be caught as those of the other."""
    found = []
    for path in sources():
        if path.suffix == ".py":
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
                found += [(path.name, name) for name in names if name.partition(".")[0] in FOLDERS]
        if path.suffix in (".py", ".md", ".toml", ".sh", ".yaml", ".yml") or path.name in ("Makefile", "Dockerfile"):
            found += [(path.name, name) for name in re.findall(rf"-m ({'|'.join(FOLDERS)})\.", path.read_text())]
    assert found == []


def test_no_module_of_this_process_was_loaded_by_its_folders_name() -> None:
    assert [name for name in sys.modules if name.partition(".")[0] in FOLDERS] == []


def test_a_callers_own_modules_break_nothing(toy_zip: Path, tmp_path: Path) -> None:
    for name in CALLERS:
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('the own module {name} was imported')\n")
    toy.write_toy_recording(tmp_path / "R.h5", toy.ToyDevice(), 16, 2)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [Path(sys.executable).with_name("lightpage")]
    bulk = ["bulk", "evaluate", "out", "--recordings", "R.h5", "--bundle", toy_zip, "--workers", "1"]  # another process
    for line in (
        [*command, "train", "--help"],
        [*command, *bulk],
        [sys.executable, "-m", "lightpage", "serve", "--help"],
        [sys.executable, "-c", f"import lightpage; lightpage.load({str(toy_zip)!r}); lightpage.LightpageClient"],
    ):
        done = subprocess.run(list(map(str, line)), cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, (line, done.stderr)


def test_a_wheel_has_one_name_and_is_small(tmp_path: Path) -> None:
    source = tmp_path / "source"
    for name in ("pyproject.toml", "setup.py", "LICENSE", "README.md"):
        source.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "lightpage", source / "lightpage", symlinks=True, ignore=_compiled)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=_compiled)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    for environment in ({}, {"CC": "/no/compiler"}):
        command, own = [*pip, "--wheel-dir", str(tmp_path), "."], {**os.environ, **environment}
        subprocess.run(command, cwd=source, env=own, check=True, timeout=120)
        shutil.rmtree(source / "build")
    (pure,) = tmp_path.glob("lightpage-*-py3-none-any.whl")  # where nothing is compiled, of every system
    assert not [name for name in zipfile.ZipFile(pure).namelist() if name.endswith((".so", ".pyd"))]
    (wheel,) = tmp_path.glob("lightpage-*-cp311-abi3-*.whl")  # of this platform, for Python 3.11 and later
    assert wheel.stat().st_size <= 5e6
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"lightpage"}
    ours = {
        str(path.relative_to(ROOT)) for path in sources() if path.relative_to(ROOT).parts[0] in ("lightpage", *FOLDERS)
    }
    packed = {name.removeprefix("lightpage/") if name.split("/")[1] in FOLDERS else name for name in names}
    assert ours - packed == set()
    compiled = {name for name in packed if name.endswith((".so", ".pyd"))}
    assert compiled <= {f"lightpage/codec/compiled/page_code{suffix}" for suffix in (".abi3.so", ".pyd")}
    assert compiled or not shutil.which("cc")


@pytest.mark.long  # mypy reads everything anew, for a minute; a source checkout shows the same by what lint checks
def test_mypy_finds_an_error_in_every_package(tmp_path: Path) -> None:
    for name in ("lightpage", *FOLDERS, "analysis"):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=_compiled)
        (tmp_path / name / "planted.py").write_text('"""Wrong."""\n\nNUMBER: int = "text"\n')
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    done = subprocess.run([sys.executable, "-m", "mypy"], cwd=tmp_path, capture_output=True, text=True, timeout=500)
    told = re.findall(r"^(\S+)/planted\.py:3: error: Incompatible types", done.stdout, re.MULTILINE)
    assert sorted(told) == sorted(["lightpage", "analysis", *(f"lightpage/{name}" for name in FOLDERS)]), done.stdout


def _compiled(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name in ("__pycache__", "weights", "planted.py") or name.endswith(".so")]
