"""Failure of skipped tests where everything must be tested: `.ci/run` sets LIGHTPAGE_REQUIRE_ALL=1."""

import os
from collections.abc import Generator
from typing import TypeVar

import pytest

REQUIRE_ALL = "LIGHTPAGE_REQUIRE_ALL"
NO_FILTERS = "this kernel lets no process filter its own system calls"
NO_GLIBC = "another C library"
NO_NETWORKS = "this kernel lets no process make a network of its own"
NO_KUSTOMIZE = "no kubectl with kustomize 5, which Debian does not have"
ALLOWED = {NO_FILTERS, NO_GLIBC, NO_NETWORKS, NO_KUSTOMIZE}
"""Reasons to skip that no installation removes."""

Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A test that was skipped."""
    return _judged((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """A whole file that was skipped."""
    return _judged((yield))


def _judged(report: Report) -> Report:
    """The report, failed if it was skipped for what the machine lacks and everything is required."""
    if report.outcome == "skipped" and os.environ.get(REQUIRE_ALL) == "1" and not hasattr(report, "wasxfail"):
        where = report.longrepr
        reason = (where[2] if isinstance(where, tuple) else str(where)).removeprefix("Skipped: ")
        if reason not in ALLOWED:
            report.outcome, report.longrepr = "failed", f"{REQUIRE_ALL}=1 allows no skip: {reason}"
    return report
