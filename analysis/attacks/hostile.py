"""Messages that nobody should send: what they cost, and whether anything breaks.

    python -m analysis.attacks.hostile --json FILE

First bytes that cannot be parsed, then pairs of another size, many times the same: the service's memory must not grow
by them. Then requests of every kind, made from the contract's own descriptors and by mutating the bytes of good ones. A
call may end with any status but INTERNAL and UNKNOWN, must end in time, and the service must decode a good page behind
each round.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
import grpc
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from analysis.service.running import PagesToSend, RunningService, stub
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.frames.inference_calls import INFERENCE
from lightpage.runtime.service.server.dispatcher import SERVICE

_CALL_S = 30.0
_ROUND = 500
_HEAD = 150
"""Bytes of a ModelInfer that are not pixels."""
_BEYOND = {
    FieldDescriptor.CPPTYPE_INT32: 2**31,
    FieldDescriptor.CPPTYPE_INT64: 2**63,
    FieldDescriptor.CPPTYPE_UINT32: 2**32,
    FieldDescriptor.CPPTYPE_UINT64: 2**64,
}
_INTEGERS = (0, 1, 2, 7, 255, 256, 65_535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
_DOUBLES = (0.0, -1.0, 1.0, 1e300, float("inf"), float("nan"))
_TEXTS = ("", "bench", "../../etc/passwd", "a" * 5000, "\u202e", "known.h5", "\x00")


def filled(message: Message, chance: random.Random, depth: int = 0) -> Message:
    """The message with some of its fields set to values at the edges of their types, and beyond what makes sense."""
    for field in message.DESCRIPTOR.fields:
        if chance.random() < 0.35 or (depth > 3 and field.message_type):
            continue
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            value = field.message_type.fields_by_name["value"]
            if value.message_type is not None:
                filled(getattr(message, field.name)[chance.choice(_TEXTS)], chance, depth + 1)
            continue
        count = chance.choice((0, 1, 2, 5)) if field.is_repeated else 1
        for _ in range(count):
            if field.message_type is not None:
                inner = getattr(message, field.name)
                filled(inner.add() if field.is_repeated else inner, chance, depth + 1)
                continue
            value = scalar(field, chance)
            if field.is_repeated:
                getattr(message, field.name).append(value)
            else:
                setattr(message, field.name, value)
    return message


def edged(message: pb.DecodeHeader, chance: random.Random) -> pb.DecodeHeader:
    """The header with some of its own integers at the edges of their types."""
    for field in message.DESCRIPTOR.fields:
        if field.cpp_type in _BEYOND and not field.is_repeated and chance.random() < 0.3:
            setattr(message, field.name, scalar(field, chance))
    return message


def scalar(field: Any, chance: random.Random) -> Any:
    """A value of a field's type."""
    kind = field.cpp_type
    if kind == FieldDescriptor.CPPTYPE_BOOL:
        return chance.random() < 0.5
    if kind in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return chance.choice(_DOUBLES)
    if kind == FieldDescriptor.CPPTYPE_STRING:
        if field.type == FieldDescriptor.TYPE_BYTES:
            return chance.randbytes(chance.choice((0, 1, 100, 5000)))
        return chance.choice(_TEXTS)
    if kind == FieldDescriptor.CPPTYPE_ENUM:
        return chance.choice((0, 1, 2, 7, 1000))
    largest = _BEYOND[kind]
    return chance.choice([value for value in _INTEGERS if value < largest])


def mutated(data: bytes, chance: random.Random) -> bytes:
    """The bytes with some flipped, cut, doubled or put in."""
    changed = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        if not changed:
            return chance.randbytes(10)
        place = chance.randrange(len(changed))
        way = chance.randrange(4)
        if way == 0:
            changed[place] ^= 1 << chance.randrange(8)
        elif way == 1:
            del changed[place:]
        elif way == 2:
            changed[place:place] = chance.randbytes(chance.randint(1, 8))
        else:
            changed += changed[:place]
    return bytes(changed)


def requests_of(method: Any, chance: random.Random, pages: PagesToSend) -> list[bytes]:
    """Bytes that one call sends."""
    kind = GetMessageClass(method.input_type)
    if not method.client_streaming:
        if method.name == "ModelInfer" and chance.random() < 0.5:
            good = pages.inference()
            return [mutated(good[:_HEAD], chance) + good[_HEAD:]]
        data: bytes = filled(kind(), chance).SerializePartialToString()
        return [mutated(data, chance) if chance.random() < 0.4 else data]
    if method.name.startswith("Decode") and chance.random() < 0.5:
        if chance.random() < 0.5:  # DecodePages takes many where some are of no pixels
            headers = [edged(pages.header(), chance) for _ in range(8)]
            return [pb.DecodeFramesRequest(header=header).SerializeToString() for header in headers]
        begun = [each.SerializeToString() for each in pages.requests()[:2]]
        return [mutated(begun[0], chance), *([begun[1]] if chance.random() < 0.3 else [])]
    count = chance.choice((0, 1, 2, 3))
    found = [filled(kind(), chance).SerializePartialToString() for _ in range(count)]
    return [mutated(data, chance) if chance.random() < 0.4 else data for data in found]


def unparsable(service: RunningService, count: int) -> dict[str, float]:
    """Bytes that are no message, `count` times; what each leaves in the service's memory."""
    return _left_behind(service, f"/{SERVICE.full_name}/ReadPage", b"\xff" * 50, count, "unparsable messages")


def refused(service: RunningService, count: int) -> dict[str, float]:
    """Pairs of another size than the device's, `count` times; what each leaves in the service's memory."""
    request = oip.ModelInferRequest.FromString(PagesToSend().inference())
    request.inputs[0].shape[0] += 1
    data = request.SerializeToString()
    return _left_behind(service, f"/{INFERENCE.full_name}/ModelInfer", data, count, "pairs of another size")


def _left_behind(service: RunningService, method: str, data: bytes, count: int, what: str) -> dict[str, float]:
    grown = list[int]()
    with service.channel() as channel:
        call = channel.unary_unary(method, None, None)
        for number in track(range(count), what, total=count):
            try:
                call(data, timeout=_CALL_S)
            except grpc.RpcError as error:
                if error.code() is not grpc.StatusCode.INVALID_ARGUMENT:
                    raise
            if number in (count // 5, count - 1):
                grown.append(service.resident_bytes())
    return {"messages": count, "bytes_per_message": (grown[1] - grown[0]) / (0.8 * count)}


def hostile(service: RunningService, count: int, seed: int) -> dict[str, Any]:
    """Send `count` requests of every kind."""
    chance, pages = random.Random(seed), PagesToSend()
    ended: Counter[str] = Counter()
    bad: list[str] = []
    methods = [method for service_of in (SERVICE, INFERENCE) for method in service_of.methods]
    methods = [method for method in methods if not method.name.startswith("Watch")]  # without end
    good = pages.requests()
    for start in track(range(0, count, _ROUND), "hostile requests", total=count // _ROUND):
        with service.channel() as channel:
            for number in range(start, min(count, start + _ROUND)):
                method = methods[number % len(methods)]
                sent = requests_of(method, chance, pages)
                begun = time.monotonic()
                code = _ended(channel, method, sent)
                ended[code] += 1
                if code in ("INTERNAL", "UNKNOWN") or time.monotonic() - begun > _CALL_S:
                    bad.append(f"{method.name}: {code} for {b''.join(sent)[:200]!r}")
            if not stub(channel).DecodeFrames(iter(good), timeout=120).symbols:
                bad.append("no answer to a good page")
    return {"requests": count, "ended": dict(ended), "bad": bad}


def _ended(channel: grpc.Channel, method: Any, sent: list[bytes]) -> str:
    path = f"/{method.containing_service.full_name}/{method.name}"
    ways = (method.client_streaming, method.server_streaming)
    try:
        if ways == (False, False):
            channel.unary_unary(path, None, None)(sent[0], timeout=_CALL_S)
        elif ways == (True, False):
            channel.stream_unary(path, None, None)(iter(sent), timeout=_CALL_S)
        elif ways == (False, True):
            _taken(channel.unary_stream(path, None, None)(sent[0], timeout=_CALL_S))
        else:
            _taken(channel.stream_stream(path, None, None)(iter(sent), timeout=_CALL_S))
    except grpc.RpcError as error:
        name: str = error.code().name
        return name
    return "OK"


def _taken(call: Any) -> None:
    """Take a few replies of a stream, and leave."""
    for _ in zip(range(3), call, strict=False):
        pass
    call.cancel()


@click.command()
@click.option(
    "--messages", default=20_000, show_default=True, type=click.IntRange(100), help="Messages that cannot be parsed."
)
@click.option("--requests", default=20_000, show_default=True, type=click.IntRange(100), help="Requests of every kind.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(messages: int, requests: int, seed: int, json_path: Path | None) -> None:
    """Print memory per unparsable message, and how hostile requests end."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder, ExitStack() as stack:
        source = PagesToSend().record(Path(folder) / "pages.h5")
        service = stack.enter_context(RunningService("--source", f"recording:{source}", "--threads", "1"))
        memory = unparsable(service, messages)
        click.echo(f"{messages} unparsable messages: {memory['bytes_per_message']:.0f} bytes of memory each")
        large = refused(service, messages // 10)
        click.echo(f"{messages // 10} refused pairs: {large['bytes_per_message']:.0f} bytes of memory each")
        found = hostile(service, requests, seed)
        log = service.log()
        status = service.stop()
    told = ", ".join(f"{count} {name}" for name, count in sorted(found["ended"].items()))
    click.echo(f"{requests} hostile requests: {told}; {len(found['bad'])} bad; exit status {status}")
    for each in found["bad"][:10]:
        click.echo(f"  {each}")
    figures = {
        "unparsable": memory,
        "refused": large,
        **found,
        "exit_status": status,
        "tracebacks": log.count("Traceback"),
    }
    click.echo(f"tracebacks in the log: {figures['tracebacks']}")
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.hostile"))
