"""Tests with the marker `own_network` run in a private network: fake cameras need two addresses, and one port.

A second pytest inside that network runs those of a file at once. Fixtures are set up in both: they hold no cameras.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras.aravis_library import PACKAGE, aravis
from lightpage.virtual_device import namespace
from tests.skips import NO_NETWORKS

MARKER = "own_network"
_RESULTS = "LIGHTPAGE_TEST_OWN_NETWORK"
"""Environment variable in the network: the file that takes the results, a line of JSON for each."""
_LONGEST_S = 540.0
_found = pytest.StashKey[dict[str, tuple[str, str]]]()
"""Outcome of each test in the network, and what is told of it."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Call the test here if this is its network, else see what became of it there."""
    if pyfuncitem.get_closest_marker(MARKER) is None or _RESULTS in os.environ:
        return None
    found = pyfuncitem.session.stash.setdefault(_found, {})
    if pyfuncitem.nodeid not in found:
        found |= _run(pyfuncitem)
    outcome, told = found[pyfuncitem.nodeid]
    if outcome == "skipped":
        pytest.skip(told)
    if outcome != "passed":
        pytest.fail(told, pytrace=False)
    return True


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note what became of a test in the network."""
    if _RESULTS in os.environ and (report.when == "call" or not report.passed):
        told = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longreprtext
        with open(os.environ[_RESULTS], "a") as results:
            results.write(json.dumps([report.nodeid, report.outcome, told.removeprefix("Skipped: ")]) + "\n")


def _run(first: pytest.Function) -> dict[str, tuple[str, str]]:
    """Run the marked tests of a file."""
    if namespace.available() is not None:
        pytest.skip(NO_NETWORKS)
    try:
        aravis()
    except SourceError:
        pytest.skip(f"{PACKAGE} is not installed")
    items = [item for item in first.session.items if item.path == first.path and item.get_closest_marker(MARKER)]
    names = [item.nodeid for item in items]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *names]
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder, "results")
        results.touch()
        environment = {**os.environ, _RESULTS: str(results), namespace.INSIDE: "1"}
        run = subprocess.run(
            namespace.enter(command),
            cwd=first.config.rootpath,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
        )
        found: dict[str, tuple[str, str]] = {}
        for name, outcome, told in map(json.loads, results.read_text().splitlines()):
            if name not in found or outcome == "failed":  # it may pass, and fail to clean up
                found[name] = outcome, told
    return {name: found.get(name, ("failed", run.stdout + run.stderr)) for name in names}
