"""Certificates: files that are no good are named, and new ones count without a restart."""

from __future__ import annotations

import os
import shutil
import ssl
import subprocess
from datetime import timedelta
from pathlib import Path

import pytest

from analysis.service.identity import commands_of, documented
from lightpage.errors import InvalidInputError
from runtime.identity.certificates import Certificates
from runtime.identity.roles import identity_of
from runtime.wire.tls import TlsFiles
from tests.runtime.identity.authority import Authority
from tests.waiting import eventually


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def test_files_are_read(authority: Authority) -> None:
    files = authority.service()
    pem = files.read()
    assert (pem.ca, pem.key) == (files.ca.read_bytes(), files.key.read_bytes())
    bash(f"openssl verify -x509_strict -purpose sslserver -CAfile {files.ca} {files.certificate}", authority.folder)


@pytest.mark.parametrize("name", ["ca", "certificate", "key"])
def test_a_missing_file_is_named(authority: Authority, name: str) -> None:
    files = authority.service()
    getattr(files, name).unlink()
    with pytest.raises(InvalidInputError, match=f"^{name} "):
        files.read()


def test_files_that_are_something_else_are_named(authority: Authority) -> None:
    files, other = authority.service(), authority.service("other")
    with pytest.raises(InvalidInputError, match=r"service\.key: got"):
        TlsFiles(files.key, files.certificate, files.key).read()
    for certificate, key in ((files.key, files.key), (files.certificate, other.key)):
        with pytest.raises(InvalidInputError, match=f"certificate {certificate} with"):
            TlsFiles(files.ca, certificate, key).read()
    bash(f"openssl ec -in {files.key} -aes128 -passout pass:secret -out {files.key}.locked", authority.folder)
    with pytest.raises(InvalidInputError, match="without a password"):  # which is not asked for
        TlsFiles(files.ca, files.certificate, Path(f"{files.key}.locked")).read()


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

    def changed() -> bool:  # its clock is coarse
        os.utime(files.ca, ns=times)
        return files.ca.stat().st_ctime_ns != before.st_ctime_ns

    eventually(changed)
    after = files.ca.stat()
    assert (after.st_ino, after.st_size, after.st_mtime_ns) == (before.st_ino, before.st_size, before.st_mtime_ns)
    assert certificates.context().get_ca_certs(binary_form=True) == [_der(other)]


def _der(path: Path) -> bytes:
    return ssl.PEM_cert_to_DER_cert(path.read_text())


def test_half_replaced_files_leave_the_earlier_ones(authority: Authority, caplog: pytest.LogCaptureFixture) -> None:
    files, newer = authority.service(), authority.service("newer")
    certificates = Certificates(files)
    before, context = certificates.pem(), certificates.context()  # of the service, and of the console
    os.replace(newer.certificate, files.certificate)
    for _ in range(2):
        assert certificates.pem() is before
        assert certificates.context() is context
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    os.replace(newer.key, files.key)
    assert certificates.pem() is not before
    assert certificates.context() is not context


def test_authorities_may_have_comments_of_any_letters(authority: Authority) -> None:
    files = authority.service()
    files.ca.write_bytes("Autorité de l’appareil, 設備\n".encode() + files.ca.read_bytes())
    certificates = Certificates(files)
    assert certificates.context().get_ca_certs()
    assert files.client_context().get_ca_certs()


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
        bash(commands_of("New certificates"), tmp_path)
    changed = {path.name for path in tls.iterdir() if path.read_bytes() != before.get(path.name)}
    assert changed == {*(f"{name}.pem" for name in ("service", *roles)), "ca.srl"}
    assert all(found[1][name].until >= found[0][name].until for name in roles)


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
    for wrong in (authority.service("late", timedelta(days=-1)), authority.caller("other", ["admin"])):
        caplog.clear()
        _replace(files, wrong)
        assert certificates.pem() is good
        assert str(files.certificate) in caplog.text
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
    for days in (30, 90):
        newer = longer.service(valid_for=timedelta(days=days))
        for source, target in zip(vars(newer).values(), vars(files).values(), strict=True):
            shutil.copy(source, target)
        assert certificates.ends_s() == until(newer.certificate), "nobody has connected meanwhile"
    between = longer.service("between", valid_for=timedelta(days=7))
    with files.certificate.open("ab") as chain:
        chain.write(between.certificate.read_bytes())
    assert certificates.ends_s() == until(between.certificate), "of a chain"


def test_a_certificate_for_callers_is_warned_of(authority: Authority, caplog: pytest.LogCaptureFixture) -> None:
    Certificates(authority.caller("caller", ["read"], timedelta(days=90)))
    assert "serverAuth" in caplog.text
