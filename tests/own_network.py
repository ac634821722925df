"""Tests with the marker `own_network` run in a private network each: fake cameras need two addresses, and one port.

Such a test is run by a second pytest inside that network. Its fixtures are set up in both, so they must not hold
cameras.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from runtime.cameras.aravis_library import PACKAGE, aravis
from runtime.errors import SourceError
from runtime.virtual_device.namespace import available, enter
from tests.skips import NO_NETWORKS

_INSIDE = "LIGHTPAGE_TEST_OWN_NETWORK"
_LONGEST_S = 120.0


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Call the test here if this is its network, else there."""
    if pyfuncitem.get_closest_marker("own_network") is None or os.environ.get(_INSIDE) == "1":
        return None
    if shutil.which("unshare") is None:
        pytest.skip("no unshare: util-linux is not installed")
    if available() is not None:
        pytest.skip(NO_NETWORKS)
    try:
        aravis()
    except SourceError:
        pytest.skip(f"{PACKAGE} is not installed")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", pyfuncitem.nodeid]
    run = subprocess.run(
        enter(command),
        cwd=pyfuncitem.config.rootpath,
        env={**os.environ, _INSIDE: "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=_LONGEST_S,
    )
    if run.returncode != 0:
        pytest.fail(run.stdout + run.stderr, pytrace=False)
    return True
