"""An audit that could not look a package up does not end as one that found nothing."""

import json

import pytest

from tests.release.scripts import script

audit = script("audit")
PACKAGES = ["click==8.5.1", "torch==2.13.0"]
GOOD = {"name": "click", "version": "8.5.1", "vulns": []}
BAD = {"name": "torch", "version": "2.13.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2.14"]}]}
SKIPPED = {"name": "torch", "skip_reason": "Dependency not found on PyPI"}


@pytest.mark.parametrize(
    ("rows", "status", "named"),
    [
        ([GOOD, {**BAD, "vulns": []}], 0, "2 of 2"),
        ([GOOD, BAD], audit.FOUND, "torch 2.13.0: PYSEC-1"),
        ([BAD, {"name": "click", "skip_reason": "no"}], audit.FOUND, "torch 2.13.0: PYSEC-1"),
        ([GOOD, SKIPPED], audit.UNKNOWN, "not audited: torch"),
        ([GOOD], audit.UNKNOWN, "1 of 2"),
    ],
)
def test_what_pip_audit_found_decides(rows: list[dict[str, object]], status: int, named: str) -> None:
    found, lines = audit.judged(PACKAGES, json.dumps({"dependencies": rows, "fixes": []}), "")
    assert found == status
    assert any(line.startswith(named) for line in lines)


@pytest.mark.parametrize("printed", ["", "Traceback", "[]", "{}"])
def test_a_database_that_does_not_answer_is_no_success(printed: str) -> None:
    said = "Traceback\nrequests.exceptions.ConnectionError: no route\n"
    status, [line] = audit.judged(PACKAGES, printed, said)
    assert (status, line[:6]) == (audit.UNKNOWN, "0 of 2")
    assert "ConnectionError: no route" in line


def test_a_build_of_its_own_is_looked_up_by_its_version() -> None:
    assert "torch==2.13.0" in audit.pins(audit.LOCKS / "deep.txt")
