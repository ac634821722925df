"""Checksums of headers and bodies."""

from __future__ import annotations

import binascii

CRC32C_BYTES = 4


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x1021 and start value 0xFFFF (CRC-16/IBM-3740); of b"123456789" it is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


class Checksum:
    """CRC-32C of bytes that come in parts."""

    def __init__(self) -> None:
        self.value = 0

    def add(self, data: bytes) -> None:
        """Take in the next part."""
        import google_crc32c

        self.value = int(google_crc32c.extend(self.value, data))


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli, RFC 3720); of b"123456789" it is 0xE3069283."""
    import google_crc32c

    return int(google_crc32c.value(data))
