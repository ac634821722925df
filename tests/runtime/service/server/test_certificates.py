"""Certificates count anew without a restart, and are named where they are no good; what they say of who calls."""

import os
import shutil
import ssl
import subprocess
from datetime import timedelta
from pathlib import Path

import pytest

from analysis.attacks.identity import commands_of, documented
from lightpage.errors import InvalidInputError, NotAllowedError
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.service.caller import Role
from lightpage.runtime.service.frames.inference_calls import INFERENCE, PREFIX
from lightpage.runtime.service.server.certificates import Certificates, identity_of
from lightpage.runtime.service.server.dispatcher import SERVICE
from tests.runtime.service.server.authority import Authority


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def test_files_that_are_missing_or_something_else_are_named(authority: Authority, tmp_path: Path) -> None:
    files, other = authority.service(), authority.service("other")
    for name in ("ca", "certificate", "key"):
        with pytest.raises(InvalidInputError, match=f"^{name} "):
            TlsFiles(**{**vars(files), name: tmp_path / "none"}).read()
    with pytest.raises(InvalidInputError, match=r"service\.key: got"):
        TlsFiles(files.key, files.certificate, files.key).read()
    for certificate, key in ((files.key, files.key), (files.certificate, other.key)):
        with pytest.raises(InvalidInputError, match=f"certificate {certificate} with"):
            TlsFiles(files.ca, certificate, key).read()
    bash(f"openssl ec -in {files.key} -aes128 -passout pass:secret -out {files.key}.locked", authority.folder)
    with pytest.raises(InvalidInputError, match="without a password"):  # which is not asked for
        TlsFiles(files.ca, files.certificate, Path(f"{files.key}.locked")).read()


def test_earlier_files_that_are_put_back_count(tmp_path: Path) -> None:
    folders = [tmp_path / "earlier", tmp_path / "wider"]
    for folder in folders:
        Authority(folder).service()
    link = tmp_path / "tls"
    link.symlink_to(folders[0])
    certificates = Certificates(TlsFiles(link / "ca.pem", link / "service.pem", link / "service.key"))
    for folder in (*folders, *folders):  # each time with the same number, size and time of change
        link.unlink()
        link.symlink_to(folder)
        assert certificates.pem().ca == (folder / "ca.pem").read_bytes()
        assert certificates.context().get_ca_certs(binary_form=True) == [
            ssl.PEM_cert_to_DER_cert((folder / "ca.pem").read_text())
        ]


def test_half_replaced_files_leave_the_earlier_ones(authority: Authority) -> None:
    files, newer = authority.service(), authority.service("newer")
    certificates = Certificates(files)
    before, context = certificates.pem(), certificates.context()  # of the service, and of the console
    os.replace(newer.certificate, files.certificate)
    for _ in range(2):
        assert certificates.pem() is before
        assert certificates.context() is context
    os.replace(newer.key, files.key)
    assert certificates.pem() is not before
    assert certificates.context() is not context


def test_the_commands_for_operators_make_good_certificates_and_renew_them(tmp_path: Path) -> None:
    commands, _ = documented()
    bash(commands, tmp_path)
    tls = tmp_path / "tls"
    roles = {"watcher": {"read"}, "controller": {"decode"}, "keeper": {"decode", "recalibrate"}, "operator": {"admin"}}
    before = {path.name: path.read_bytes() for path in tls.iterdir()}
    found = []
    for _ in range(2):
        for name in ("service", *roles):
            TlsFiles(*(tls / file for file in ("ca.pem", f"{name}.pem", f"{name}.key"))).read()
            purpose = "sslserver" if name == "service" else "sslclient"
            # Python from 3.13 on has its clients look as closely.
            bash(f"openssl verify -x509_strict -purpose {purpose} -CAfile ca.pem {name}.pem", tls)
        found.append({name: identity_of((tls / f"{name}.pem").read_bytes()) for name in roles})
        assert {name: (each.name, each.roles) for name, each in found[-1].items()} == {
            name: (name, expected) for name, expected in roles.items()
        }
        bash(commands_of("Renew certificates"), tmp_path)
    changed = {path.name for path in tls.iterdir() if path.read_bytes() != before.get(path.name)}
    assert changed == {*(f"{name}.pem" for name in ("service", *roles)), "ca.srl"}
    assert all(found[1][name].until >= found[0][name].until for name in roles)


def bash(commands: str, folder: Path) -> None:
    subprocess.run(["bash", "-ec", commands], cwd=folder, check=True, capture_output=True, timeout=60)


def _replace(files: TlsFiles, newer: TlsFiles) -> None:
    shutil.copy(newer.certificate, files.certificate)
    shutil.copy(newer.key, files.key)


def test_new_certificates_that_no_caller_takes_do_not_count(authority: Authority) -> None:
    files = authority.service()
    certificates = Certificates(files)
    good = certificates.pem()
    for wrong in (authority.service("late", timedelta(days=-1)), authority.caller("other", ["admin"])):
        _replace(files, wrong)
        assert certificates.pem() is good
    newer = authority.service("newer")
    _replace(files, newer)
    assert certificates.pem().certificate == newer.certificate.read_bytes()


@pytest.mark.parametrize(("days", "told"), [(-1, "has expired"), (13, "expires soon"), (15, "")])
def test_a_certificate_that_ends_is_warned_of(
    authority: Authority, caplog: pytest.LogCaptureFixture, days: int, told: str
) -> None:
    Certificates(authority.service(valid_for=timedelta(days=days)))
    assert (told in caplog.text) if told else not caplog.records


def test_the_first_end_is_told(authority: Authority, tmp_path: Path) -> None:
    def until(path: Path) -> float:
        return identity_of(path.read_bytes()).until

    files = authority.service(valid_for=timedelta(days=90))
    certificates = Certificates(files)
    assert certificates.ends_s() == until(files.ca) < until(files.certificate)
    longer = Authority(tmp_path / "longer", valid_for=timedelta(days=400))
    newer = longer.service(valid_for=timedelta(days=30))
    shutil.copy(newer.ca, files.ca)
    _replace(files, newer)
    assert certificates.ends_s() == until(newer.certificate), "nobody has connected meanwhile"
    between = longer.service("between", valid_for=timedelta(days=7))
    with files.certificate.open("ab") as chain:
        chain.write(between.certificate.read_bytes())
    assert certificates.ends_s() == until(between.certificate), "of a chain"


def test_a_certificate_says_who_and_what_and_counts_until_it_ends(authority: Authority) -> None:
    files = authority.caller("controller 1", ["decode", "recalibrate", "king"], timedelta(hours=1))
    identity = identity_of(files.certificate.read_bytes())
    assert (identity.name, identity.roles) == ("controller 1", {Role.DECODE, Role.RECALIBRATE})
    identity.check(Role.READ, "call X", identity.until - 1)
    with pytest.raises(NotAllowedError, match="expired"):
        identity.check(Role.READ, "call X", identity.until)


def test_a_name_cannot_make_a_line_of_its_own(authority: Authority, tmp_path: Path) -> None:
    authority.caller("a\nFAKE\x1b[31m", ["read"]).certificate.rename(tmp_path / "odd.pem")
    assert identity_of((tmp_path / "odd.pem").read_bytes()).name == "a\\nFAKE\\x1b[31m"


def test_what_is_no_certificate_is_refused() -> None:
    for data in (b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", b"\x30\x03abc"):
        with pytest.raises(NotAllowedError, match="certificate"):
            identity_of(data)


def test_every_call_needs_a_role_and_the_page_for_operators_says_the_same() -> None:
    own, other = ({method.name for method in service.methods} for service in (SERVICE, INFERENCE))
    assert own | {PREFIX + name for name in other} == documented()[1].keys()
