"""Certificates: files that are no good are named, and new ones count without a restart."""

from __future__ import annotations

import os
import shutil
import ssl
import subprocess
import time
from datetime import timedelta
from pathlib import Path

import pytest

from analysis.service.identity import commands_of, documented
from lightpage.errors import InvalidInputError
from runtime.identity.certificates import Certificates
from runtime.identity.roles import identity_of
from runtime.wire.tls import TlsFiles
from tests.runtime.identity.authority import Authority


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def test_files_are_read(authority: Authority) -> None:
    files = authority.service()
    pem = files.read()
    assert (pem.ca, pem.key) == (files.ca.read_bytes(), files.key.read_bytes())


@pytest.mark.parametrize("name", ["ca", "certificate", "key"])
def test_a_missing_file_is_named(authority: Authority, name: str) -> None:
    files = authority.service()
    getattr(files, name).unlink()
    with pytest.raises(InvalidInputError, match=f"^{name} .*No such file"):
        files.read()


def test_a_file_that_is_no_certificate_is_named(authority: Authority) -> None:
    files = authority.service()
    with pytest.raises(InvalidInputError, match=r"service\.key: got no certificate"):
        TlsFiles(files.key, files.certificate, files.key).read()
    with pytest.raises(InvalidInputError, match=r"certificate .*service\.key with key"):
        TlsFiles(files.ca, files.key, files.key).read()


def test_a_key_of_another_certificate_is_refused(authority: Authority) -> None:
    files, other = authority.service(), authority.service("other")
    with pytest.raises(InvalidInputError, match="KEY_VALUES_MISMATCH"):
        TlsFiles(files.ca, files.certificate, other.key).read()


def test_a_key_with_a_password_is_refused_without_asking_for_it(authority: Authority) -> None:
    from cryptography.hazmat.primitives import serialization

    files = authority.service()
    key = serialization.load_pem_private_key(files.key.read_bytes(), None)
    locked = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.TraditionalOpenSSL,
        serialization.BestAvailableEncryption(b"secret"),
    )
    files.key.write_bytes(locked)
    with pytest.raises(InvalidInputError, match="without a password"):
        files.read()


def test_new_files_count(authority: Authority) -> None:
    files, newer = authority.service(), authority.service("newer")
    certificates = Certificates(files)
    before = certificates.pem()
    assert certificates.pem() is before
    _replace(files, newer)
    assert certificates.pem().certificate == newer.certificate.read_bytes() != before.certificate


def _mounted(folder: Path, files: TlsFiles, version: str) -> TlsFiles:
    """Have a folder hold files as kubelet mounts a Secret: names that never change, behind one link that is swapped."""
    names = {"ca": "ca.crt", "certificate": "tls.crt", "key": "tls.key"}
    (folder / f"..{version}").mkdir(parents=True)
    for kind, name in names.items():
        shutil.copy(getattr(files, kind), folder / f"..{version}" / name)
        if not (folder / name).is_symlink():
            (folder / name).symlink_to(f"..data/{name}")
    earlier = (folder / "..data").readlink() if (folder / "..data").is_symlink() else None
    (folder / "..data_tmp").symlink_to(f"..{version}")
    os.replace(folder / "..data_tmp", folder / "..data")
    if earlier is not None:
        shutil.rmtree(folder / earlier)
    return TlsFiles(**{kind: folder / name for kind, name in names.items()})


def test_new_files_of_a_mounted_secret_count(authority: Authority, tmp_path: Path) -> None:
    mounted = _mounted(tmp_path / "mount", authority.service(), "2026_01_01")
    certificates = Certificates(mounted)
    before, context = certificates.pem(), certificates.context()
    assert certificates.pem() is before
    newer = authority.service("newer")
    assert _mounted(tmp_path / "mount", newer, "2026_02_01") == mounted
    assert certificates.pem().certificate == newer.certificate.read_bytes() != before.certificate
    assert certificates.context() is not context


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
        assert certificates.context().get_ca_certs(binary_form=True) == [_der(folder / "ca.pem")]


def test_files_that_are_overwritten_with_their_times_kept_count(authority: Authority, tmp_path: Path) -> None:
    """As by `cp -p`; one that is made readable for the service changes no more than this either."""
    files, other = authority.service(), Authority(tmp_path / "other").folder / "ca.pem"
    texts = [path.read_text() for path in (files.ca, other)]
    size = max(map(len, texts))
    files.ca.write_text(texts[0].ljust(size, "\n"))
    certificates, before = Certificates(files), files.ca.stat()
    files.ca.write_text(texts[1].ljust(size, "\n"))
    times = before.st_atime_ns, before.st_mtime_ns
    until = time.monotonic() + 5
    os.utime(files.ca, ns=times)
    while files.ca.stat().st_ctime_ns == before.st_ctime_ns and time.monotonic() < until:  # its clock is coarse
        os.utime(files.ca, ns=times)
    after = files.ca.stat()
    assert (after.st_ino, after.st_size, after.st_mtime_ns) == (before.st_ino, before.st_size, before.st_mtime_ns)
    assert certificates.context().get_ca_certs(binary_form=True) == [_der(other)]


def _der(path: Path) -> bytes:
    return ssl.PEM_cert_to_DER_cert(path.read_text())


def test_half_replaced_files_leave_the_earlier_ones(authority: Authority, caplog: pytest.LogCaptureFixture) -> None:
    files, newer = authority.service(), authority.service("newer")
    certificates = Certificates(files)
    before = certificates.pem()
    os.replace(newer.certificate, files.certificate)
    assert certificates.pem() is before
    assert certificates.pem() is before
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "the earlier ones stay" in caplog.text
    os.replace(newer.key, files.key)
    assert certificates.pem() is not before


def test_the_certificates_of_these_tests_are_those_that_a_strict_client_takes(authority: Authority) -> None:
    files = authority.service()
    bash(f"openssl verify -x509_strict -purpose sslserver -CAfile {files.ca} {files.certificate}", authority.folder)


def test_authorities_may_have_comments_of_any_letters(authority: Authority) -> None:
    files = authority.service()
    files.ca.write_bytes("Autorité de l’appareil, 設備\n".encode() + files.ca.read_bytes())
    certificates = Certificates(files)
    assert certificates.context().get_ca_certs()
    assert files.client_context().get_ca_certs()


def test_the_console_keeps_the_earlier_certificates_too(authority: Authority) -> None:
    files, newer = authority.service(), authority.service("newer")
    certificates = Certificates(files)
    before = certificates.context()
    assert certificates.context() is before
    os.replace(newer.certificate, files.certificate)
    assert certificates.context() is before
    os.replace(newer.key, files.key)
    assert certificates.context() is not before


def test_the_commands_for_operators_make_good_certificates(tmp_path: Path) -> None:
    commands, _ = documented()
    bash(commands, tmp_path)
    roles = {"watcher": {"read"}, "controller": {"decode"}, "keeper": {"decode", "recalibrate"}, "operator": {"admin"}}
    for name in ("service", *roles):
        TlsFiles(*(tmp_path / "tls" / file for file in ("ca.pem", f"{name}.pem", f"{name}.key"))).read()
    for name, expected in roles.items():
        identity = identity_of((tmp_path / "tls" / f"{name}.pem").read_bytes())
        assert (identity.name, identity.roles) == (name, expected)
    # Python from 3.13 on has its clients look as closely.
    for name, purpose in (("service", "sslserver"), *((name, "sslclient") for name in roles)):
        bash(f"openssl verify -x509_strict -purpose {purpose} -CAfile ca.pem {name}.pem", tmp_path / "tls")


def test_the_commands_that_renew_certificates_keep_the_authority_the_keys_and_the_roles(tmp_path: Path) -> None:
    bash(commands_of("Certificates from nothing"), tmp_path)
    tls = tmp_path / "tls"
    before = {path.name: path.read_bytes() for path in tls.iterdir()}
    bash(commands_of("New certificates"), tmp_path)
    changed = {path.name for path in tls.iterdir() if path.read_bytes() != before.get(path.name)}
    names = ("service", "watcher", "controller", "keeper", "operator")
    assert changed == {*(f"{name}.pem" for name in names), "ca.srl"}
    for name in names:
        now, earlier = identity_of((tls / f"{name}.pem").read_bytes()), identity_of(before[f"{name}.pem"])
        assert (now.name, now.roles) == (earlier.name, earlier.roles)
        assert now.until >= earlier.until
        TlsFiles(tls / "ca.pem", tls / f"{name}.pem", tls / f"{name}.key").read()
        bash(f"openssl verify -x509_strict -CAfile ca.pem {name}.pem", tls)


def bash(commands: str, folder: Path) -> None:
    subprocess.run(["bash", "-ec", commands], cwd=folder, check=True, capture_output=True, timeout=60)


def _replace(files: TlsFiles, newer: TlsFiles) -> None:
    shutil.copy(newer.certificate, files.certificate)
    shutil.copy(newer.key, files.key)


def test_new_certificates_that_no_caller_takes_do_not_count(
    authority: Authority, caplog: pytest.LogCaptureFixture
) -> None:
    files = authority.service()
    certificates = Certificates(files)
    good = certificates.pem()
    for newer, told in (
        (authority.service("late", timedelta(days=-1)), "has expired"),
        (authority.caller("other", ["admin"]), "extendedKeyUsage=serverAuth"),
    ):
        caplog.clear()
        _replace(files, newer)
        assert certificates.pem() is good
        assert f"the earlier ones stay: certificate {files.certificate}: got one" in caplog.text
        assert told in caplog.text
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
    files = authority.service(valid_for=timedelta(days=90))
    certificates, day_s = Certificates(files), 86_400
    now = time.time()
    assert certificates.ends_s() - now == pytest.approx(day_s, abs=60), "the authority's comes first"
    longer = Authority(tmp_path / "longer", valid_for=timedelta(days=400))
    for days in (30, 90):
        newer = longer.service(valid_for=timedelta(days=days))
        for source, target in zip(vars(newer).values(), vars(files).values(), strict=True):
            shutil.copy(source, target)
        assert certificates.ends_s() - now == pytest.approx(days * day_s, abs=60), "nobody has connected meanwhile"
    between = longer.service("between", valid_for=timedelta(days=7))
    with files.certificate.open("ab") as chain:
        chain.write(between.certificate.read_bytes())
    assert certificates.ends_s() - now == pytest.approx(7 * day_s, abs=60), "of a chain"


def test_a_certificate_for_callers_is_warned_of(authority: Authority, caplog: pytest.LogCaptureFixture) -> None:
    Certificates(authority.caller("caller", ["read"], timedelta(days=90)))
    assert "serverAuth" in caplog.text
