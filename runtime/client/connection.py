"""A connection to a service: its deadlines, and errors of the classes that the service raised."""

import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from lightpage.clock import Clock
from lightpage.runtime.client.answers import Description, description
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.address import check_address
from lightpage.runtime.client.wire.channel import TlsFiles, open_channel
from lightpage.runtime.client.wire.messages import message_of, serialized_part
from lightpage.runtime.client.wire.status import error_of

DATA_S = 600.0
"""Deadline of a call that moves many pages, or a model, where none is given."""

_Sent = Iterable[Message | memoryview] | None
_SERVICE = pb.DESCRIPTOR.services_by_name["Lightpage"]


class Connection:
    """Carries the calls of a client. Its parts share one.

    Args:
        target, timeout_s, tls, clock: see `LightpageClient`.

    Attributes:
        target, clock: as given.
        session: session of frames that name none. At a Unix socket it is the client's own, for the service cannot tell
            connections apart there; elsewhere it is empty.

    Raises:
        InvalidInputError: no address, or certificates that are no good.
    """

    def __init__(self, target: str, timeout_s: float, tls: TlsFiles | None, clock: Clock) -> None:
        check_address("target", target)
        self.target, self.clock, self._timeout_s = target, clock, timeout_s
        self.session = f"client {secrets.token_hex(16)}" if target.startswith("unix:") else ""
        self._channel = open_channel(target, tls)
        self._description: Description | None = None

    def call(self, name: str, sent: _Sent, timeout_s: float | None, **fields: object) -> Any:
        """Begin the call of the contract with this name: with a message of `fields`, or with the messages `sent`."""
        method = _SERVICE.methods_by_name[name]
        way = f"{'unary' if sent is None else 'stream'}_{'stream' if method.server_streaming else 'unary'}"
        reply = GetMessageClass(method.output_type).FromString
        begin = getattr(self._channel, way)(f"/{_SERVICE.full_name}/{name}", serialized_part, reply)
        message = message_of(GetMessageClass(method.input_type), **fields) if sent is None else sent
        return begin(message, timeout=timeout_s)

    def ask(self, name: str, sent: _Sent = None, timeout_s: float | None = None, **fields: object) -> Any:
        """Return the one reply of a `call`; by default within the client's own deadline.

        Raises:
            InvalidInputError: fields that no message can hold.
            LightpageError: the error that the service raised, or why there is no reply.
        """
        with self._errors():
            return self.call(name, sent, self._timeout_s if timeout_s is None else timeout_s, **fields)

    @contextmanager
    def replies(
        self, name: str, sent: _Sent = None, timeout_s: float | None = DATA_S, **fields: object
    ) -> Iterator[Any]:
        """Yield the replies of a `call`, which ends with the `with` statement; raises as `ask`, as they come."""
        call = self.call(name, sent, timeout_s, **fields)
        try:
            with self._errors():
                yield call
        finally:
            call.cancel()

    def describe(self) -> Description:
        """Ask what the service is now; raises as `ask`."""
        self._description = description(self.ask("Describe"))
        return self._description

    @property
    def description(self) -> Description:
        """Return what the service was when it was last asked; raises as `ask` where it is asked for the first time."""
        return self._description or self.describe()

    def close(self) -> None:
        """End all calls and close the connection."""
        self._channel.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise error_of(error, self.target) from None


class SubClient:
    """A client's part for one kind of calls.

    Args:
        connection: connection to the service.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection, self._ask, self._replies = connection, connection.ask, connection.replies
