"""User bytes on pages: the page code, and its parts for those who bring a code of their own.

What most users need is here by name: `bit_llrs` gives the log-likelihood ratios of a decoded page's bits.
Each name is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lightpage.codec.code import Code, load_code
    from lightpage.codec.ldpc.code import LdpcCode
    from lightpage.codec.ldpc.decoder import decode
    from lightpage.codec.mapping import bit_information, bit_llrs, decide_in_coset, to_levels
    from lightpage.codec.page_bytes import PageBytes
    from lightpage.codec.page_codec import PageCodec

_HOMES = {
    "Code": "lightpage.codec.code",
    "LdpcCode": "lightpage.codec.ldpc.code",
    "PageBytes": "lightpage.codec.page_bytes",
    "PageCodec": "lightpage.codec.page_codec",
    "bit_information": "lightpage.codec.mapping",
    "bit_llrs": "lightpage.codec.mapping",
    "decide_in_coset": "lightpage.codec.mapping",
    "decode": "lightpage.codec.ldpc.decoder",
    "load_code": "lightpage.codec.code",
    "to_levels": "lightpage.codec.mapping",
}

__all__ = [
    "Code",
    "LdpcCode",
    "PageBytes",
    "PageCodec",
    "bit_information",
    "bit_llrs",
    "decide_in_coset",
    "decode",
    "load_code",
    "to_levels",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
