"""Facts of an RPC that the server needs before its handler runs, written at the handler."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from lightpage.runtime.service.caller import Role

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Rpc:
    """Way in which an RPC is served.

    Attributes:
        role: role that its callers need.
        is_watch: whether it lasts as long as its caller likes: it holds no thread, is no load, and ends with the
            service.
        is_upload: whether it changes something once its caller has closed the stream.
        is_range: whether it may take `Limits.range_s`.
        reads_later: whether its handler takes, in place of the request, an asynchronous function that returns the
            request's bytes: they are so many that they are not read before there is time for what is asked.
    """

    role: Role
    is_watch: bool = False
    is_upload: bool = False
    is_range: bool = False
    reads_later: bool = False


def rpc(role: Role, **served: bool) -> Callable[[F], F]:
    """Mark a method as the handler of the RPC of its name; see `Rpc`."""
    marked = Rpc(role, **served)

    def mark(handler: F) -> F:
        handler.rpc = marked  # type: ignore[attr-defined]
        return handler

    return mark
