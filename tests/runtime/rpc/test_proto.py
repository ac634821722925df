"""The contract: its committed stubs, and what earlier clients know of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from google.protobuf import descriptor_pb2

from runtime.pb.lightpage.v1 import lightpage_pb2 as pb

ROOT = Path(__file__).resolve().parents[3]


def stubs(folder: Path) -> dict[str, str]:
    paths = [path for path in folder.rglob("*.py*") if path.suffix in (".py", ".pyi")]
    return {str(path.relative_to(folder)): path.read_text("utf-8") for path in paths}


def test_the_committed_stubs_are_what_the_contract_generates(tmp_path: Path) -> None:
    generate = [sys.executable, ROOT / "proto" / "generate.py", tmp_path]
    subprocess.run(generate, check=True, capture_output=True, timeout=120)
    assert stubs(tmp_path) == stubs(ROOT / "runtime" / "pb"), "run python proto/generate.py"


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
