"""Facts of a page of user bytes: its header and the outcome of decoding it. They need no code."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum

from lightpage.codec.checksum import CRC32C_BYTES, crc16

VERSION = 1
"""Of the header's layout."""

FILE_BYTES = 2 + CRC32C_BYTES
"""Before the user bytes: data and parity pages of a group, one byte each, and the checksum of the whole file."""


@dataclass(frozen=True)
class Header:
    """The fields of a page's header.

    Attributes:
        code_id: `Code.id` of the body.
        volume: a number that tells files on one medium apart, 32 bits.
        page: number of the page in its volume, 24 bits.
        volume_bytes: user bytes of the whole volume, 40 bits.
        version: version of this layout.
    """

    code_id: int
    volume: int
    page: int
    volume_bytes: int
    version: int = VERSION

    def fields(self) -> bytes:
        """Big-endian: version 1 byte, code id 2, volume 4, page 3, volume bytes 5."""
        return struct.pack(">BHI", self.version, self.code_id, self.volume) + (
            self.page.to_bytes(3, "big") + self.volume_bytes.to_bytes(5, "big")
        )

    def to_bytes(self) -> bytes:
        """Fields and their CRC-16."""
        fields = self.fields()
        return fields + crc16(fields).to_bytes(2, "big")


class Loss(StrEnum):
    """Why a page gives no bytes."""

    STORAGE = "storage"
    """Its frames could not be read from the recording, which says nothing of the page."""
    OPTICS = "optics"
    """It could not be decoded into symbols."""
    HEADER = "header"
    """Its header could not be read, and it is not the page that was expected."""
    CODE = "code"
    """Its header names another code."""
    BODY = "body"
    """Its blocks did not converge, and the rest could not be mended."""
    CHECKSUM = "checksum"
    """Its blocks converged, and the checksum does not hold all the same."""


LOSSES = {
    Loss.STORAGE: "its frames cannot be read from the recording",
    Loss.OPTICS: "it was not decoded into symbols",
    Loss.HEADER: "its header cannot be read",
    Loss.CODE: "its header names another code",
    Loss.BODY: "its code does not converge",
    Loss.CHECKSUM: "its checksum does not hold",
}
"""Losses for people."""


@dataclass(frozen=True)
class FileFacts:
    """The file that a page belongs to, as each of its pages states it.

    Attributes:
        data_pages, parity_pages: k and m of a group, 0 to 255.
        checksum: CRC-32C of the whole file.
    """

    data_pages: int
    parity_pages: int
    checksum: int

    def to_bytes(self) -> bytes:
        """Return the bytes of the header as they stand on the page."""
        return bytes([self.data_pages, self.parity_pages]) + self.checksum.to_bytes(CRC32C_BYTES, "big")

    @classmethod
    def parse(cls, data: bytes) -> FileFacts:
        """Return what `to_bytes` has made."""
        return cls(data[0], data[1], int.from_bytes(data[2:FILE_BYTES], "big"))


@dataclass(frozen=True)
class PageBytes:
    """The outcome of decoding a page.

    Attributes:
        header: as it stands on the page; to be believed only where there is data. None where it could not be read.
        data: user bytes, None where the page is lost: nothing that fails its checksum is given out.
        file: what it says of its file, None where the page is lost.
        loss: why there is no data, None where there is.
        iterations: mean of the LDPC blocks.
        failed_blocks: LDPC blocks that did not converge.
        blocks: all of them.
        corrected: Reed-Solomon symbols that were mended.
        margin_bits: information of a symbol's coded bits beyond what the code needs, bits; negative where the page
            should be lost. Of a lost page, by what its confidences claim, and at most 0.
    """

    header: Header | None
    data: bytes | None
    file: FileFacts | None
    loss: Loss | None
    iterations: float
    failed_blocks: int
    blocks: int
    corrected: int
    margin_bits: float
