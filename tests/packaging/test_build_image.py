"""What may be built is said before anything is."""

from __future__ import annotations

import os
import re
import subprocess

import pytest

from tests.packaging.scripts import ROOT, script

lock = script("lock")
DIGEST = f"debian:bookworm-slim@sha256:{64 * 'a'}"


def build(target: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Ask for an image with no builder that there is: nothing can get built."""
    return subprocess.run(
        [ROOT / "packaging/build_image.sh", target],
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


@pytest.mark.parametrize("target", lock.TARGETS)
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
