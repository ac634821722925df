"""What a caller wants to have of a page."""

from __future__ import annotations

from typing import TypedDict

from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of


class PageOptions(TypedDict, total=False):
    """What a caller wants to have of a page, and whose pages it is followed with. All may be left out.

    Attributes:
        want_concentration: also get kappa.
        want_phase: also get the phase.
        quantised: get the confidence in one byte a symbol.
        user_data: also get the page's bytes; the level count must then be that of the model's code, or 0.
        session: of the pages that this one is followed with; by default those of the connection, at a Unix socket those
            of the client, or of the device where the service reads the page.
        stateless: decode the page as if it were the first, so that the same frames give the same answer.
    """

    want_concentration: bool
    want_phase: bool
    quantised: bool
    user_data: bool
    session: str
    stateless: bool


def options_message(levels: int, options: PageOptions) -> pb.DecodeOptions:
    """The message; `levels` 0 stands for the default.

    Raises:
        InvalidInputError: values that no message can hold.
        TypeError: an option that there is not.
    """
    if unknown := sorted(options.keys() - PageOptions.__annotations__.keys()):
        raise TypeError(f"unexpected option {', '.join(unknown)}: there are {', '.join(PageOptions.__annotations__)}")
    quantised, stateless = options.get("quantised", False), options.get("stateless", False)
    return message_of(
        pb.DecodeOptions,
        levels=levels,
        confidence_format=pb.CONFIDENCE_FORMAT_UINT8 if quantised else pb.CONFIDENCE_FORMAT_FLOAT32,
        want_concentration=options.get("want_concentration", False),
        want_phase=options.get("want_phase", False),
        want_user_data=options.get("user_data", False),
        session=options.get("session", ""),
        tracking=pb.TRACKING_STATELESS if stateless else pb.TRACKING_SESSION,
    )
