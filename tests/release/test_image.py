"""Build targets are checked before anything is built, and an image that is not the work tree's is refused."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.release.scripts import ROOT, script

lock = script("lock")
GONE_ON = 42
"""Status of a check that found the image to be the right one, and gets no container of it."""
DIGEST = f"debian:bookworm-slim@sha256:{64 * 'a'}"


def build(target: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Ask for an image with no builder that there is: nothing can get built."""
    return subprocess.run(
        [ROOT / "release/build_image.sh", target],
        env={**os.environ, "LIGHTPAGE_BUILDER": "nobody", **environment},
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize(
    ("environment", "named"),
    [
        ({"LIGHTPAGE_RELEASE": "1"}, "'debian:bookworm-slim'"),
        ({"LIGHTPAGE_RELEASE": "1", "LIGHTPAGE_BASE": "debian:12"}, "'debian:12'"),
        ({"LIGHTPAGE_BASE": "debian@sha256:12"}, "'sha256:12'"),
        ({"LIGHTPAGE_RELEASE": "yes"}, "'yes'"),
        ({"LIGHTPAGE_PLATFORM": "linux/riscv64"}, "'linux/riscv64'"),
        ({"LIGHTPAGE_BASE": DIGEST}, "'nobody'"),
    ],
)
def test_what_cannot_be_built_is_refused(environment: dict[str, str], named: str) -> None:
    refused = build("runtime", **environment)
    assert refused.returncode == 2
    assert named in refused.stderr


@pytest.mark.parametrize("target", ["runtime", "gpu"])
def test_a_target_without_wheels_for_arm_is_refused_there(target: str) -> None:
    refused = build(target, LIGHTPAGE_PLATFORM="linux/arm64")
    assert refused.returncode == 2
    assert (
        "'nobody'" if "aarch64" in lock.TARGETS[target].machines else lock.TARGETS[target].refused
    ) in refused.stderr


def test_the_base_is_an_argument_and_no_stage_names_another() -> None:
    text = (ROOT / "Dockerfile").read_text()
    assert re.findall(r"^ARG BASE=(.*)$", text, re.MULTILINE) == ["debian:bookworm-slim"]
    stages = set(re.findall(r" AS (\S+)$", text, re.MULTILINE))
    assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) - stages == {"scratch", "${BASE}"}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A work tree that has the scripts, committed."""
    folder = tmp_path / "tree"
    (folder / "release").mkdir(parents=True)
    for name in ("check_image.sh", "revision.sh"):
        shutil.copy(ROOT / "release" / name, folder / "release" / name)
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
        [tree / "release/check_image.sh", "--inside", "lightpage:runtime", ""],
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
