"""An image that is not the work tree's is not taken for it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.packaging.scripts import ROOT

GONE_ON = 42
"""Status of a check that found the image to be the right one, and gets no container of it."""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A work tree that has the scripts, committed."""
    folder = tmp_path / "tree"
    (folder / "packaging").mkdir(parents=True)
    for name in ("check_image.sh", "revision.sh"):
        shutil.copy(ROOT / "packaging" / name, folder / "packaging" / name)
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "first")
    return folder


def git(folder: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=nobody", "-c", "user.email=nobody@example.org", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.strip()


def check(tree: Path, buildah: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Check an image by a buildah of these lines of shell, as far as that goes without namespaces and mounts."""
    program = tree.parent / "programs" / "buildah"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f"#!/bin/sh\n{buildah}\n")
    program.chmod(0o755)
    path = f"{program.parent}:{os.environ['PATH']}"
    return subprocess.run(
        [tree / "packaging/check_image.sh", "--inside", "lightpage:runtime", ""],
        env={**os.environ, "LIGHTPAGE_BUILDER": "buildah", "PATH": path, **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )


def labelled(revision: str) -> str:
    """A buildah whose image has this label."""
    return f'case "$*" in *" inspect "*) echo "{revision}" ;; *) exit {GONE_ON} ;; esac'


def test_an_image_of_another_revision_is_refused(tree: Path) -> None:
    commit = git(tree, "rev-parse", "HEAD")
    assert check(tree, labelled(commit)).returncode == GONE_ON
    for other in ("a" * 40, f"{commit}-changed", "<no value>"):
        refused = check(tree, labelled(other))
        assert refused.returncode == 2
        assert f"'{other}'" in refused.stderr
    (tree / "more").touch()
    assert check(tree, labelled(f"{commit}-changed")).returncode == GONE_ON
    assert check(tree, labelled(commit)).returncode == 2


def test_an_image_that_is_not_buildahs_is_refused(tree: Path) -> None:
    refused = check(tree, "echo no such image >&2; exit 125")
    assert refused.returncode == 2
    assert "(no such image)" in refused.stderr
    refused = check(tree, labelled(""), LIGHTPAGE_BUILDER="docker")
    assert refused.returncode == 2
    assert "'docker'" in refused.stderr
