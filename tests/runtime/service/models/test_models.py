"""The models over the endpoint: listed, rolled back and forward, uploaded, put in service, pinned."""

import errno
import hashlib
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import click
import pytest
from click.testing import CliRunner

from lightpage.errors import (
    BundleError,
    InvalidInputError,
    LightpageError,
    LimitError,
    MalformedError,
    ModelExistsError,
    OtherModelError,
    SlotsTakenError,
    StalledError,
    StoreError,
)
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.commands.client.models import models as models_command
from lightpage.runtime.commands.client.recalibrate import rollback as rollback_command
from lightpage.runtime.model.bundle.bundle import write_bundle
from lightpage.runtime.model.bundle.manifest import DECODER
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.models.models import KEPT_MODELS
from tests.runtime import toy
from tests.runtime.service.stage import Running, Start, refused, until_told
from tests.waiting import eventually


@pytest.fixture
def new(tmp_path: Path) -> Path:
    """A bundle for the same device."""
    return toy.write_toy_bundle(tmp_path / "new.zip", version="toy-2")


@pytest.fixture
def stored(start: Start, tmp_path: Path) -> Start:
    """Starts services with a store, the same one each time."""
    return partial(start, store=tmp_path / "store")


def sent(service: Running, *parts: pb.UploadModelRequest) -> pb.UploadModelReply:
    return service.stub.UploadModel(iter(parts), timeout=20)  # type: ignore[no-any-return]


def header(data: bytes, **changes: object) -> pb.UploadModelRequest:
    return pb.UploadModelRequest(header=pb.UploadModelHeader(**{"bytes": len(data), **changes}))


def chunk(data: bytes) -> pb.UploadModelRequest:
    return pb.UploadModelRequest(chunk=data)


def test_an_uploaded_model_is_kept_put_in_service_and_rolled_back(stored: Start, new: Path, toy_zip: Path) -> None:
    service = stored()
    client = service.client
    model = client.models.upload(new)
    assert (model.version, model.origin, model.current, model.loaded) == ("toy-2", "uploaded", False, False)
    assert service.store.bundle("toy-2").read_bytes() == new.read_bytes()
    for bundle in (new, toy_zip):  # a version that is there is not taken again
        with pytest.raises(ModelExistsError):
            client.models.upload(bundle)
    assert client.models.activate("toy-2", "toy-1") == ("toy-2", "toy-1")
    for change in (partial(client.models.activate, "toy-2"), client.models.roll_back, client.models.roll_forward):
        with pytest.raises(OtherModelError, match="got toy-2"):  # a call that is repeated steps once
            change("toy-1")
    assert client.pages.read().model_version == "toy-2"
    client.jobs.recalibrate(count=2)
    assert client.models.roll_back("toy-2+r1") == ("toy-2", "toy-2+r1")
    assert client.models.pin("toy-2").pinned
    assert [model.version for model in client.models.list() if model.pinned] == ["toy-2"]
    assert client.models.roll_forward("toy-2") == ("toy-2+r1", "toy-2")
    assert not client.models.pin("toy-2", False).pinned
    assert [client.models.roll_back()[0] for _ in range(2)] == ["toy-2", "toy-1"]
    for step in (client.models.roll_back, lambda: client.models.activate("toy-9"), lambda: client.models.pin("../new")):
        with pytest.raises(BundleError):
            step()
    assert service.left_behind == []


def test_models_are_listed_with_what_is_known_of_them(stored: Start, new: Path) -> None:
    service = stored()
    service.client.models.upload(new)
    for number in range(1, KEPT_MODELS + 1):
        assert service.client.jobs.recalibrate(count=2).model_version == f"toy-1+r{number}"
    (service.store.path / "damaged.zip").write_bytes(b"no zip")
    listed = {model.version: model for model in service.client.models.list(stored=True)}
    assert list(listed) == ["toy-1", "toy-2", *(f"toy-1+r{number}" for number in range(1, KEPT_MODELS + 1))]
    assert [model.origin for model in listed.values()] == ["given", "uploaded"] + ["recalibrated"] * KEPT_MODELS
    assert [model.loaded for model in listed.values()] == [False, False] + [True] * KEPT_MODELS
    assert [version for version, model in listed.items() if model.current] == [f"toy-1+r{KEPT_MODELS}"]
    assert [model.version for model in service.client.models.list()] == list(listed)[2:]
    assert listed["toy-1+r1"].metrics["recalibration_pages"] == 2


def test_bundles_that_could_not_serve_are_refused_and_leave_nothing(stored: Start, tmp_path: Path) -> None:
    service = stored()
    files = toy.files() | {DECODER: toy.decoder_onnx(9)}
    golden = write_bundle(tmp_path / "golden.zip", toy.manifest(version="toy-3"), files)
    narrow = toy.PROFILE_TOML.replace("columns = 24", "columns = 20")
    foreign = write_bundle(tmp_path / "foreign.zip", toy.manifest(version="toy-4", profile=narrow), toy.files())
    for bundle in (golden, foreign):
        with pytest.raises(BundleError) as error:
            service.client.models.upload(bundle)
        assert ".upload-" not in str(error.value)
        assert service.left_behind == service.store.versions() == []
    with pytest.raises(InvalidInputError):
        service.client.models.upload(tmp_path / "absent.zip")


def test_an_upload_is_what_was_announced(stored: Start, new: Path) -> None:
    service, data = stored(limits=Limits(model_bytes=1 << 20)), new.read_bytes()
    half = len(data) // 2
    good, other = hashlib.sha256(data).digest(), hashlib.sha256(b"").digest()
    cases: list[tuple[list[pb.UploadModelRequest], type[LightpageError], str]] = [
        ([], MalformedError, "no header"),
        ([header(data), header(data)], MalformedError, "second header"),
        ([header(data), pb.UploadModelRequest()], MalformedError, "empty message"),
        ([header(data, bytes=0)], InvalidInputError, "header.bytes"),
        ([header(data, bytes=(1 << 20) + 1)], LimitError, "1048577"),
        ([header(data, sha256=other), chunk(data)], BundleError, good.hex()),
        ([header(data), chunk(data[:half])], InvalidInputError, f"{half} bytes"),
        ([header(data), chunk(data), chunk(b"x")], InvalidInputError, f"{len(data)}"),
    ]
    for parts, kind, named in cases:
        answer = refused(lambda parts=parts: sent(service, *parts))  # type: ignore[misc]
        assert type(answer.error) is kind
        assert named in answer.text
        assert service.left_behind == service.store.versions() == []
    assert sent(service, header(data), chunk(data[:half]), chunk(data[half:])).model.version == "toy-2"


def test_a_caller_who_is_slow_leaves_nothing(stored: Start, new: Path) -> None:
    service, data, over = stored(limits=Limits(model_s=0.2)), new.read_bytes(), threading.Event()

    def messages() -> Iterator[pb.UploadModelRequest]:
        yield header(data)
        while not over.wait(0.05):
            yield chunk(b"x")

    answer = refused(lambda: service.stub.UploadModel(messages(), timeout=60))
    over.set()
    assert (type(answer.error), answer.subject) == (StalledError, "uploaded model")
    eventually(lambda: service.left_behind == [])
    assert service.store.versions() == []


def test_a_caller_who_leaves_leaves_nothing_and_one_upload_is_taken_at_a_time(stored: Start, new: Path) -> None:
    service, data, more = stored(), new.read_bytes(), threading.Event()
    call = service.stub.UploadModel.future(until_told([header(data), chunk(data[:9])], more), timeout=60)
    eventually(lambda: service.plane.uploads.busy == 1 and service.left_behind != [])
    with pytest.raises(SlotsTakenError):
        service.client.models.upload(new)
    call.cancel()
    more.set()
    eventually(lambda: service.left_behind == [] and service.plane.uploads.busy == 0)
    assert service.client.models.upload(new).version == "toy-2"


def test_a_caller_who_leaves_while_the_bundle_is_checked_leaves_nothing(
    stored: Start, new: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, data = stored(), new.read_bytes()
    loader, checking = service.plane.models.loader, threading.Event()
    as_it_was = loader.tracked

    def slow_check(decoder: Decoder, current: Decoder) -> Model:
        checking.set()
        eventually(lambda: service.plane.uploads.busy == 0)
        return as_it_was(decoder, current)

    monkeypatch.setattr(loader, "tracked", slow_check)
    call = service.stub.UploadModel.future(iter([header(data), chunk(data)]), timeout=60)
    assert checking.wait(60)
    call.cancel()
    eventually(lambda: service.left_behind == [])
    assert service.store.versions() == []


def test_without_a_store_there_is_nowhere_to_put_a_model(stored: Start, new: Path) -> None:
    service = stored(store=None)
    with pytest.raises(StoreError):
        service.client.models.upload(new)
    assert service.client.models.pin("toy-1").pinned


def test_a_disk_that_fails_during_an_upload_leaves_nothing(
    stored: Start, new: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = stored()
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    with monkeypatch.context() as patch:
        patch.setattr("lightpage.runtime.service.models.uploads.give_new_name", full)
        with pytest.raises(StoreError):
            service.client.models.upload(new)
        eventually(lambda: service.left_behind == service.store.versions() == [])
    assert service.client.models.upload(new).version == "toy-2"


def test_the_command_line_does_all_of_it(stored: Start, new: Path) -> None:
    service = stored()

    def told(*arguments: object, command: click.Command = models_command) -> list[str]:
        line = ["--target", service.server.target, *map(str, arguments)]
        return CliRunner().invoke(command, line, standalone_mode=False, catch_exceptions=False).output.split()

    assert told("upload", new)[0] == "toy-2"
    assert told() == told("list") == ["*", "toy-1", "2026-01-01T00:00:00Z", "given"]
    assert told("list", "--stored")[:4] == ["toy-2", "2026-01-01T00:00:00Z", "uploaded,", "stored"]
    assert told("activate", "toy-2", "--expect", "toy-1")[0] == "toy-2"
    assert "pinned" in told("pin", "toy-2")
    assert "pinned" not in told("unpin", "toy-2")
    with pytest.raises(OtherModelError):
        told("--expect", "toy-1", command=rollback_command)
    assert told("--expect", "toy-2", command=rollback_command)[0] == "toy-1"
    assert told("forward")[0] == "toy-2"
