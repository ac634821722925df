"""The contract: committed stubs, what earlier clients know; messages with frames, written and read without copies."""

import os
import random
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError
from grpc_tools import protoc

from lightpage.errors import LimitError, MalformedError
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import CHUNK_BYTES, chunks_of, parsed_part, serialized_part
from lightpage.runtime.service.frames.inference_calls import MOST_FIELDS, take_apart
from tests.runtime.service.stage import Start

MOST = 10_000
ROOT = Path(__file__).resolve().parents[4]
UV = Path(sys.executable).with_name("uv")
SETTINGS: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())


def stubs(folder: Path) -> dict[str, str]:
    paths = [path for path in folder.rglob("*.py*") if path.suffix in (".py", ".pyi")]
    return {str(path.relative_to(folder)): path.read_text("utf-8") for path in paths}


@pytest.mark.parametrize(("module", "name"), [(pb, "lightpage/v1/lightpage"), (oip, "inference/open_inference")])
def test_the_committed_stubs_are_of_the_contract(module: ModuleType, name: str, tmp_path: Path) -> None:
    assert protoc.main(["protoc", f"-I{ROOT / 'proto'}", f"-o{tmp_path / 'out'}", f"{name}.proto"]) == 0
    (wanted,) = descriptor_pb2.FileDescriptorSet.FromString((tmp_path / "out").read_bytes()).file
    found = descriptor_pb2.FileDescriptorProto.FromString(module.DESCRIPTOR.serialized_pb)
    assert str(found) == re.sub(r" *json_name: .*\n", "", str(wanted)), "run make proto"


@pytest.mark.long  # uv installs the protoc that made them
def test_the_committed_stubs_are_what_the_contract_generates(tmp_path: Path) -> None:
    generate = [UV, "run", "--python", sys.executable, ROOT / "proto" / "generate.py", tmp_path]
    subprocess.run(generate, check=True, capture_output=True, timeout=120)
    for home in ("runtime/client/pb", "runtime/model/execution/pb"):
        assert stubs(tmp_path / home) == stubs(ROOT / home), "run make proto"


@pytest.mark.long  # uv installs tritonclient and all that we need, 300 MB
@pytest.mark.parametrize(("major", "more"), [("6", ["tritonclient[grpc]"]), ("7", [])])
def test_client_and_service_live_beside_tritonclient_and_with_the_newest_protobuf(
    major: str, more: list[str], start: Start, tmp_path: Path
) -> None:
    """Tritonclient wants a protobuf below 7. In one process with it runs the client alone."""
    call = f"""
import google.protobuf, lightpage{", tritonclient.grpc" if more else ""}
with lightpage.LightpageClient({start().client.target!r}) as client:
    print(google.protobuf.__version__.split(".")[0], client.pages.read().symbols.shape)
"""
    wanted = [f"protobuf=={major}.*", *more, *SETTINGS["project"]["dependencies"], "onnxruntime"]
    command = [UV, "run", "--quiet", "--isolated", "--no-project", "--python", sys.executable]
    command += [word for requirement in wanted for word in ("--with", requirement)]
    own = {**os.environ, "PYTHONPATH": str(ROOT)}
    for script in (call, "import lightpage.runtime.service.server.server"):
        line = [*command, "python", "-c", script]
        done = subprocess.run(line, cwd=tmp_path, env=own, capture_output=True, text=True, timeout=500)
        assert done.returncode == 0, done.stderr[-1000:]
        assert done.stdout.split()[:1] == ([major] if script == call else [])


def test_nothing_of_the_contract_of_0_1_was_renumbered_or_renamed() -> None:
    packed = (Path(__file__).parent / "lightpage-0.1.0.desc").read_bytes()
    (before,) = descriptor_pb2.FileDescriptorSet.FromString(packed).file
    now = descriptor_pb2.FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(now)
    assert (before.package, before.syntax) == (now.package, now.syntax)
    messages = {one.name: one for one in now.message_type}
    for message in before.message_type:
        fields = {one.name: one for one in messages[message.name].field}
        for field in message.field:
            kept = fields[field.name]
            for what in ("number", "type", "type_name", "label"):
                assert getattr(kept, what) == getattr(field, what), f"{message.name}.{field.name}"
    enums = {one.name: {value.name: value.number for value in one.value} for one in now.enum_type}
    for enum in before.enum_type:
        assert {value.name: value.number for value in enum.value}.items() <= enums[enum.name].items()
    (service,), (served,) = before.service, now.service
    methods = {one.name: one for one in served.method}
    for method in service.method:
        assert methods[method.name] == method
    assert len(before.message_type) > 20


def test_a_message_is_understood_as_by_the_library() -> None:
    request = oip.ModelInferRequest(model_name="lightpage", id="a" * 200)
    for size in (0, 1, 127, 128, 5000):
        tensor = request.inputs.add(name=f"input-{size}", datatype="UINT8", shape=[2**40, 3])
        tensor.contents.uint_contents.extend(range(size // 50))
        request.raw_input_contents.append(random.Random(size).randbytes(size))
    request.parameters["levels"].int64_param = -1
    data = request.SerializeToString()
    for unknown in (b"", b"\xf8\x07\xac\x02", b"\xf9\x07" + bytes(8), b"\xfd\x07" + bytes(4), b"\xfa\x07\x02ab"):
        found, raw = take_apart(unknown + data + unknown, MOST)
        assert [bytes(each) for each in raw] == list(request.raw_input_contents)
        assert not found.raw_input_contents
        found.raw_input_contents.extend(request.raw_input_contents)
        assert found == oip.ModelInferRequest.FromString(unknown + data + unknown)
        assert {id(each.obj) for each in raw if each} == {id(raw[-1].obj)}  # views of the message


@pytest.mark.parametrize("data", [b"\x3a", b"\x3a\x05abcd", b"\xff", b"\x80" * 11, b"\x0b\x0c", b"\x09123"])
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(MalformedError) as error:
        take_apart(data, MOST)
    assert error.value.subject == "message of inference/ModelInfer"


def test_what_would_take_many_times_its_size_is_refused_before_it_is_parsed() -> None:
    take_apart(b"\x2a\x00" * MOST_FIELDS, MOST)
    with pytest.raises(LimitError):
        take_apart(b"\x2a\x00" * (MOST_FIELDS + 1), MOST)
    tensor = oip.ModelInferRequest.InferInputTensor(contents=oip.InferTensorContents(uint_contents=[0] * MOST))
    with pytest.raises(LimitError):
        take_apart(oip.ModelInferRequest(inputs=[tensor]).SerializeToString(), MOST)
    take_apart(oip.ModelInferRequest(raw_input_contents=[bytes(2 * MOST)]).SerializeToString(), MOST)


@pytest.mark.parametrize("size", [0, 127, 128, 16_384, (1 << 21) + 5])
def test_a_chunk_is_written_and_read_as_protobuf_does(size: int) -> None:
    chunk = np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()
    message = pb.DecodeFramesRequest(chunk=chunk).SerializeToString()
    assert serialized_part(memoryview(chunk)) == message
    assert parsed_part(message) == chunk
    assert pb.DecodeFramesRequest.FromString(message).chunk == chunk


def test_a_chunk_is_read_without_a_copy_and_all_else_as_a_message() -> None:
    message = pb.DecodeFramesRequest(chunk=bytes(1000)).SerializeToString()
    part = parsed_part(message)
    assert isinstance(part, memoryview)
    assert part.obj is message

    header = pb.DecodeFramesRequest(header=pb.DecodeHeader(rows_px=3, correlation_id="x"))
    assert parsed_part(header.SerializeToString()) == header
    chunk, other = pb.DecodeFramesRequest(chunk=b"abc").SerializeToString(), b"\xf8\x07\x01"  # an unknown field
    assert parsed_part(chunk + other) == b"abc"
    assert parsed_part(chunk + pb.DecodeFramesRequest(chunk=b"de").SerializeToString()) == b"de"
    assert parsed_part(b"\x12\x83\x00abc") == b"abc"  # a longer number than need be

    frame = np.arange(CHUNK_BYTES, dtype=">u2").reshape(4, -1)
    chunks = list(chunks_of([frame, frame[:1].T]))
    assert [chunk.nbytes for chunk in chunks] == [CHUNK_BYTES, CHUNK_BYTES, CHUNK_BYTES // 2]
    assert b"".join(chunks[:2]) == frame.astype("<u2").tobytes()


@pytest.mark.parametrize("data", [b"\x12", b"\x12\x05abc", b"\x12\xff\xff\xff\xff\xff\xff"])
def test_what_cannot_be_parsed_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        parsed_part(data)
