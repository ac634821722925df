"""Callers with certificates: each may do what its roles say, and nobody else gets in."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import grpc
import pytest
from cryptography import x509
from google.protobuf.message_factory import GetMessageClass
from grpc_health.v1 import health_pb2, health_pb2_grpc

from analysis.attacks.identity import documented
from lightpage.errors import BundleError, NotAllowedError
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.inference import open_inference_pb2_grpc as oip_grpc
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.wire.channel import TlsFiles, open_channel
from lightpage.runtime.commands.service.healthcheck import is_serving
from lightpage.runtime.service.caller import Role
from lightpage.runtime.service.frames.inference_calls import INFERENCE, PREFIX
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.dispatcher import SERVICE
from lightpage.runtime.service.server.health_server import HealthServer
from lightpage.runtime.service.server.server import LightpageServer
from tests.runtime.service.server.authority import Authority
from tests.runtime.service.stage import Remembering, Running, Start, a_page
from tests.waiting import eventually


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path / "certificates")


@pytest.fixture
def secured(start: Start, authority: Authority, tmp_path: Path) -> Iterator[Running]:
    """A service that asks for certificates, but for its client, who talks to another server of it."""
    service = start(tracker=Remembering, audit=tmp_path / "audit.jsonl")
    certificates = Certificates(authority.service())
    with LightpageServer(service.plane, service.recalibrator, certificates=certificates) as server:
        yield replace(service, server=server)


def code_of(channel: grpc.Channel, method: str) -> grpc.StatusCode:
    """How a call with an empty request ends; a stream of answers by its first one."""
    service, name = (INFERENCE, method.removeprefix(PREFIX)) if method.startswith(PREFIX) else (SERVICE, method)
    found = service.methods_by_name[name]
    request: Any = GetMessageClass(found.input_type)()
    stub: Any = (pb_grpc.LightpageStub if service is SERVICE else oip_grpc.GRPCInferenceServiceStub)(channel)
    call = getattr(stub, name)
    try:
        answer = call(iter([request]) if found.client_streaming else request, timeout=20)
        if found.server_streaming:
            next(answer, None)
            answer.cancel()
    except grpc.RpcError as error:
        ended: Any = error
        return ended.code()  # type: ignore[no-any-return]
    return grpc.StatusCode.OK


def ended(target: str, tls: TlsFiles | None, method: str = "ReadPage") -> grpc.StatusCode:
    """How a call on a connection of its own ends."""
    with open_channel(target, tls) as channel:
        return code_of(channel, method)


def test_each_role_may_do_the_calls_that_are_documented_and_no_other(secured: Running, authority: Authority) -> None:
    needed = documented()[1]
    for roles in ((), *((role,) for role in Role), (Role.DECODE, Role.RECALIBRATE)):
        tls = authority.caller("caller", roles)
        with open_channel(secured.server.target, tls) as channel:
            refused = {name for name in needed if code_of(channel, name) is grpc.StatusCode.PERMISSION_DENIED}
        allowed = {name for name, role in needed.items() if role in roles or Role.ADMIN in roles}
        allowed |= {name for name, role in needed.items() if roles and role == Role.READ}
        assert refused == needed.keys() - allowed, roles


def test_nobody_gets_in_without_a_certificate_of_the_authority(
    secured: Running, authority: Authority, tmp_path: Path
) -> None:
    target = secured.server.target
    foreign = Authority(tmp_path / "foreign").caller("caller", ["admin"])
    wrong = TlsFiles(authority.folder / "ca.pem", foreign.certificate, foreign.key)
    expired = authority.caller("late", ["admin"], -timedelta(seconds=1))
    service = authority.service("another")
    for tls in (None, wrong, expired, service):
        assert ended(target, tls) is grpc.StatusCode.UNAVAILABLE
    with open_channel(target, authority.caller("nobody")) as channel:  # health needs no role
        health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=20)
    good = authority.caller("good", ["admin"])
    deceived = TlsFiles(tmp_path / "foreign" / "ca.pem", good.certificate, good.key)
    assert ended(target, deceived) is grpc.StatusCode.UNAVAILABLE, "the caller believes another authority"
    assert ended(target, good) is grpc.StatusCode.OK


def test_a_refusal_says_what_is_lacking_and_the_record_of_changes_who_asked(
    secured: Running, authority: Authority, tmp_path: Path
) -> None:
    with LightpageClient(secured.server.target, tls=authority.caller("reader", ["read"])) as client:
        with pytest.raises(NotAllowedError) as error:
            client.models.roll_back()
        assert (error.value.subject, error.value.got) == ("call Rollback", "reader with role read")
    assert secured.count("lightpage_calls_total", method="Rollback", code="PERMISSION_DENIED") == 1
    tls = authority.caller("operator 7", ["admin"])
    with LightpageClient(secured.server.target, tls=tls) as client, pytest.raises(BundleError):
        client.models.roll_back()
    (line,) = (tmp_path / "audit.jsonl").read_text().splitlines()
    assert json.loads(line)["who"].startswith("operator 7 at ipv4:127.0.0.1:")


def test_callers_of_other_names_share_no_session_and_no_request_id(secured: Running, authority: Authority) -> None:
    answers, pistons, pair = [], [], a_page()[1]
    for name in ("one", "two", "one"):
        with LightpageClient(secured.server.target, tls=authority.caller(name, ["decode"])) as client:
            pistons.append(client.frames.decode(pair, 16, session="a").piston_rad)
            answers.append(client.pages.read(request_id="shot"))
    assert pistons == [1, 1, 2]
    assert [answer.replayed for answer in answers] == [False, False, True]
    assert answers[0].page == answers[2].page != answers[1].page


def test_new_certificates_count_without_a_restart(start: Start, authority: Authority, tmp_path: Path) -> None:
    files = authority.service()
    target = start(certificates=Certificates(files)).server.target
    old, other = authority.caller("old", ["decode"]), Authority(tmp_path / "other")
    new, newer = other.caller("new", ["decode"]), other.service()
    assert [ended(target, tls) for tls in (old, new)] == [grpc.StatusCode.OK, grpc.StatusCode.UNAVAILABLE]
    before = TlsFiles(tmp_path / "earlier.pem", old.certificate, old.key)
    shutil.copy(files.ca, before.ca)
    for source, copy in zip(vars(newer).values(), vars(files).values(), strict=True):
        shutil.copy(source, copy)
    assert [ended(target, tls) for tls in (before, new)] == [grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.OK]


def test_metrics_say_when_the_first_certificate_ends(secured: Running, authority: Authority) -> None:
    first = x509.load_pem_x509_certificate((authority.folder / "ca.pem").read_bytes()).not_valid_after_utc
    assert secured.count("lightpage_certificate_ends_seconds") == first.timestamp()


def test_health_checks_with_tls_need_no_certificate(authority: Authority) -> None:
    files = authority.service()
    with HealthServer("127.0.0.1:0", lambda: {"": True}, files) as health:
        tls = authority.caller("anybody")
        eventually(lambda: is_serving(health.target, tls=tls)[0])
        credentials = grpc.ssl_channel_credentials(files.ca.read_bytes())
        with grpc.secure_channel(health.target, credentials) as channel:
            reply = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=20)
        assert reply.status == health_pb2.HealthCheckResponse.SERVING
