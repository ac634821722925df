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
    ("environment", "said"),
    [
        ({"LIGHTPAGE_RELEASE": "1"}, "a release needs a base with a digest; got 'debian:bookworm-slim'"),
        (
            {"LIGHTPAGE_RELEASE": "1", "LIGHTPAGE_BASE": "debian:12"},
            "a release needs a base with a digest; got 'debian:12'",
        ),
        (
            {"LIGHTPAGE_BASE": "debian@sha256:12"},
            "has the digest 'sha256:12'; sha256: and 64 hexadecimal digits wanted",
        ),
        ({"LIGHTPAGE_RELEASE": "yes"}, "LIGHTPAGE_RELEASE is 'yes'; 1 or nothing wanted"),
        ({"LIGHTPAGE_PLATFORM": "linux/riscv64"}, "platform 'linux/riscv64' is none of linux/amd64, linux/arm64"),
        ({"LIGHTPAGE_BASE": DIGEST}, "LIGHTPAGE_BUILDER is 'nobody'"),
    ],
)
def test_what_cannot_be_built_is_refused(environment: dict[str, str], said: str) -> None:
    refused = build("runtime", **environment)
    assert refused.returncode == 2
    assert said in refused.stderr


@pytest.mark.parametrize("target", lock.TARGETS)
def test_a_target_without_wheels_for_arm_is_refused_there(target: str) -> None:
    refused = build(target, LIGHTPAGE_PLATFORM="linux/arm64")
    assert refused.returncode == 2
    if "aarch64" in lock.TARGETS[target].machines:
        assert "LIGHTPAGE_BUILDER is 'nobody'" in refused.stderr
    else:
        assert f"no image '{target}' for linux/arm64: {lock.TARGETS[target].refused}" in refused.stderr


def test_the_base_is_an_argument_and_no_stage_names_another() -> None:
    text = (ROOT / "Dockerfile").read_text()
    assert re.findall(r"^ARG BASE=(.*)$", text, re.MULTILINE) == ["debian:bookworm-slim"]
    stages = set(re.findall(r" AS (\S+)$", text, re.MULTILINE))
    assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) - stages == {"scratch", "${BASE}"}
