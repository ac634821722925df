"""Roles: what a certificate says, what a call needs, and that the page for operators says the same."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from analysis.service.identity import documented
from runtime.errors import NotAllowedError
from runtime.identity.roles import LOCAL, NEEDED, Role, identity_of
from runtime.rpc.call import SERVICE
from runtime.rpc.inference_calls import INFERENCE, PREFIX
from tests.runtime.identity.authority import Authority


def test_a_certificate_says_who_and_what(tmp_path: Path) -> None:
    files = Authority(tmp_path).caller("controller 1", ["decode", "recalibrate", "king"])
    identity = identity_of(files.certificate.read_bytes())
    assert identity.name == "controller 1"
    assert identity.roles == {Role.DECODE, Role.RECALIBRATE}


def test_a_certificate_without_roles_may_nothing(tmp_path: Path) -> None:
    identity = identity_of(Authority(tmp_path).caller("nobody").certificate.read_bytes())
    assert not any(identity.may(role) for role in Role)
    with pytest.raises(NotAllowedError, match="call X"):
        identity.check(Role.READ, "call X", 0.0)


@pytest.mark.parametrize("role", list(Role))
def test_a_role_is_itself_and_may_look(tmp_path: Path, role: Role) -> None:
    identity = identity_of(Authority(tmp_path).caller("one", [role]).certificate.read_bytes())
    allowed = {other for other in Role if identity.may(other)}
    assert allowed == (set(Role) if role is Role.ADMIN else {Role.READ, role})


def test_a_certificate_that_ends_while_connected_is_refused(tmp_path: Path) -> None:
    files = Authority(tmp_path).caller("one", ["admin"], timedelta(hours=1))
    identity = identity_of(files.certificate.read_bytes())
    identity.check(Role.READ, "call X", identity.until - 1)
    with pytest.raises(NotAllowedError, match="expired"):
        identity.check(Role.READ, "call X", identity.until)


def test_a_name_cannot_make_a_line_of_its_own(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    authority.caller("a\nFAKE\x1b[31m", ["read"]).certificate.rename(tmp_path / "odd.pem")
    assert identity_of((tmp_path / "odd.pem").read_bytes()).name == "a\\nFAKE\\x1b[31m"


def test_what_is_no_certificate_is_refused() -> None:
    for data in (b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", b"\x30\x03abc"):
        with pytest.raises(NotAllowedError, match="certificate"):
            identity_of(data)


def test_who_needs_no_certificate_may_do_everything() -> None:
    assert all(LOCAL.may(role) for role in Role)


def test_every_call_needs_a_role() -> None:
    own, other = ({method.name for method in service.methods} for service in (SERVICE, INFERENCE))
    assert own | {PREFIX + name for name in other} == NEEDED.keys()


def test_the_page_for_operators_says_the_same() -> None:
    assert documented()[1] == NEEDED
