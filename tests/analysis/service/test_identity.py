"""The judge of certificates and roles takes no broken connection for a call that was let in."""

from __future__ import annotations

import pytest

from analysis.service.identity import CALLERS, expected, outcome


@pytest.mark.parametrize(
    ("caller", "role", "right"),
    [
        ("none", "read", {"UNAVAILABLE"}),
        ("expired", "admin", {"UNAVAILABLE"}),
        ("nobody", "read", {"PERMISSION_DENIED"}),
        ("watcher", "decode", {"PERMISSION_DENIED"}),
        ("watcher", "read", {"OK", "INVALID_ARGUMENT"}),
        ("keeper", "recalibrate", {"OK", "INVALID_ARGUMENT"}),
        ("operator", "decode", {"OK", "INVALID_ARGUMENT"}),
    ],
)
def test_each_caller_has_one_right_outcome(caller: str, role: str, right: set[str]) -> None:
    codes = ("OK", "INVALID_ARGUMENT", "PERMISSION_DENIED", "UNAVAILABLE")
    assert {code for code in codes if outcome(code) == expected(caller, role)} == right


def test_a_service_that_cannot_be_reached_is_right_for_nobody_with_a_certificate() -> None:
    with_certificate = CALLERS.keys() - {"none", "wrong", "expired", "service"}
    roles = ("read", "decode", "recalibrate", "admin")
    assert not [
        caller for caller in with_certificate for role in roles if outcome("UNAVAILABLE") == expected(caller, role)
    ]
