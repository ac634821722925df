"""User bytes on a page and back: checksum, scrambler, Reed-Solomon words, LDPC blocks, interleaver, levels.

`docs/reference/formats.md` specifies the page bit by bit; this file follows its order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.checksum import CRC32C_BYTES, crc32c
from lightpage.codec.code import Code
from lightpage.codec.compiled.order import gathered, scatter
from lightpage.codec.header import decode_header, encode_headers, header_symbols
from lightpage.codec.ldpc.code import MOST_INFORMATION_BITS, Bits, LdpcCode
from lightpage.codec.ldpc.decoder import decode
from lightpage.codec.likelihood.information import page_information
from lightpage.codec.mapping import bit_llrs, decide_in_coset, to_levels, upper_bits
from lightpage.codec.page_bytes import FILE_BYTES, FileFacts, Header, Loss, PageBytes
from lightpage.codec.random_bits import random_bytes, random_order
from lightpage.codec.reed_solomon import LONGEST_WORD, SYMBOL_BITS, parity, repair
from lightpage.errors import InvalidInputError, PageError
from lightpage.page.levels import Levels

_INTERLEAVER_SEED = 0x4C50_494C
_FILLING_SEED = 0x4C50_464C


class PageCodec:
    """Puts bytes on pages, and takes them off.

    Args:
        code: its parameters.
        pilots: where the pilots are, bool [ny, nx].
        levels: levels of the pages that are read, where they are uneven; as many as the code has.
        threads: number of threads that share the work on a page where it is compiled.
        earlier: codecs of codes of as many levels with which other pages were written. A page is read with the code
            that its header names.

    Raises:
        InvalidInputError: the page is too small for this code.
    """

    def __init__(
        self,
        code: Code,
        pilots: NDArray[np.bool_],
        levels: Levels | None = None,
        threads: int = 1,
        earlier: Sequence[PageCodec] = (),
    ) -> None:
        self.code, self.pilots, self._levels, self._threads = code, pilots, levels or Levels(code.levels), threads
        self._earlier = {codec.code.id: codec for codec in earlier if codec.code.id != code.id}
        data = int(np.count_nonzero(~pilots))
        count = header_symbols(code.levels)
        if count >= data:
            raise InvalidInputError("page", f"{data} data symbols", f"more than the {count} of a header")
        in_header = np.zeros(data, np.bool_)
        in_header[(2 * np.arange(count) + 1) * data // (2 * count)] = True
        places = np.flatnonzero(~pilots)
        self._header, self._body = places[in_header], places[~in_header]
        self._coded_bits = len(self._body) * code.coded_bits
        self._upper_bits = code.level_bits - code.coded_bits
        self.blocks = -(-self._coded_bits * code.rate_per_mille // (1000 * MOST_INFORMATION_BITS))
        sent = self._coded_bits // self.blocks
        information = sent * code.rate_per_mille // 1000
        small = InvalidInputError("page", f"{data} data symbols", f"more, to hold user bytes ({code.describe()})")
        if information < 1:
            raise small
        self.ldpc = LdpcCode(information, sent)
        self._information = self.blocks * self.ldpc.information_bits
        self._total_bits = self._information + len(self._body) * self._upper_bits
        self._words = -(-(self._total_bits // SYMBOL_BITS) // LONGEST_WORD)
        parity_symbols = 2 * code.corrections * self._words
        self._data_symbols = self._total_bits // SYMBOL_BITS - parity_symbols if code.corrections else 0
        data_bits = SYMBOL_BITS * self._data_symbols if code.corrections else self._total_bits
        self._bytes = data_bits // 8
        self.user_bytes = self._bytes - FILE_BYTES - CRC32C_BYTES
        if self.user_bytes < 1:
            raise small

    @cached_property
    def _order(self) -> NDArray[np.int32]:
        """Bit of the body that each sent bit goes to."""
        return random_order(_INTERLEAVER_SEED, self._coded_bits).astype(np.int32)

    @cached_property
    def _filling(self) -> Bits:
        """Bits of the body that no block reaches."""
        count = self._coded_bits - self.blocks * self.ldpc.sent_bits
        return np.unpackbits(random_bytes(_FILLING_SEED, -(-count // 8)))[:count]

    def encode(
        self, headers: Sequence[Header], data: NDArray[np.uint8], file: FileFacts, pilots: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Symbols of pages.

        Args:
            headers: one a page; their code id must be this code's.
            data: user bytes, uint8 [pages, user_bytes].
            file: file of the pages' file.
            pilots: levels of the pilots in row order, uint8 [pilots].

        Returns:
            uint8 [pages, ny, nx], pilots included.

        Raises:
            PageError: data of another shape, or pilots that are not as many.
        """
        if data.shape != (len(headers), self.user_bytes):
            raise PageError("user data", f"shape {data.shape}", f"({len(headers)}, {self.user_bytes})")
        if pilots.shape != (int(np.count_nonzero(self.pilots)),):
            raise PageError("pilot levels", f"shape {pilots.shape}", f"({np.count_nonzero(self.pilots)},)")
        body = np.zeros((len(headers), self._bytes), np.uint8)
        body[:, :FILE_BYTES] = np.frombuffer(file.to_bytes(), np.uint8)
        body[:, FILE_BYTES:-CRC32C_BYTES] = data
        for row, header in zip(body, headers, strict=True):
            check = crc32c(header.fields() + row[:-CRC32C_BYTES].tobytes())
            row[-CRC32C_BYTES:] = np.frombuffer(check.to_bytes(CRC32C_BYTES, "big"), np.uint8)
            row ^= self._scrambler(header)
        bits = np.zeros((len(headers), self._total_bits), np.uint8)
        bits[:, : 8 * self._bytes] = np.unpackbits(body, axis=1)
        if self.code.corrections:
            self._add_parity(bits)
        pages = np.empty((len(headers), self.pilots.size), np.uint8)
        pages[:, np.flatnonzero(self.pilots)] = pilots
        pages[:, self._header] = encode_headers(list(headers), self.code.levels)
        label = self._labels(bits[:, : self._information])
        upper = bits[:, self._information :].reshape(len(label), self._upper_bits) @ self._upper_weights
        pages[:, self._body] = to_levels(label, upper, self.code.levels).reshape(len(headers), -1)
        return pages.reshape(len(headers), *self.pilots.shape)

    def encode_again(self, found: PageBytes, pilots: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Symbols of a page that was read, uint8 [ny, nx].

        Args:
            found: what it gave; not lost.
            pilots: as for `encode`.
        """
        assert found.header is not None
        assert found.data is not None
        assert found.file is not None
        data = np.frombuffer(found.data, np.uint8)[None]
        codec = self._earlier.get(found.header.code_id, self)
        return np.asarray(codec.encode([found.header], data, found.file, pilots)[0])

    def decode(
        self,
        phase: NDArray[np.floating],
        concentration: NDArray[np.floating],
        expected: Header | None = None,
    ) -> PageBytes:
        """User bytes of a decoded page.

        Args:
            phase: radians, piston removed, [ny, nx].
            concentration: von Mises kappa, [ny, nx].
            expected: the page that should be here; taken where its own header cannot be read, and believed only if
                the body's checksum confirms it.

        Raises:
            PageError: another shape, or values that are not finite.
        """
        if phase.shape != self.pilots.shape or concentration.shape != self.pilots.shape:
            shapes = phase.shape, concentration.shape
            raise PageError("phase, concentration", shapes, f"{self.pilots.shape} twice, as the pilots have")
        mu, kappa = phase.ravel(), concentration.ravel()
        header = decode_header(mu[self._header], kappa[self._header], self._levels)
        named = header or expected
        if named is not None and named.code_id in self._earlier:
            return self._earlier[named.code_id].decode(phase, concentration, expected)
        other = header is not None and header.code_id != self.code.id and expected is None
        own = mu[self._body].astype(np.float64)
        blocks = self._blocks(own, kappa[self._body])
        if other:
            return self._lost(header, Loss.CODE, blocks, 0, 0.0)
        found = decode(self.ldpc, blocks, threads=self._threads)
        failed, iterations = int(np.count_nonzero(~found.converged)), float(found.iterations.mean())
        label = self._interleaved(found.sent[None])
        bits = np.concatenate([found.information.ravel(), upper_bits(own, label, self._levels).ravel()])
        for candidate in (header, expected):
            if candidate is None:
                continue
            body, corrected = self._checked(bits, candidate)
            if body is not None:
                # the code words are right where the checksum holds, but for what Reed-Solomon has mended
                information = page_information(blocks, found.sent)
                margin = self.code.coded_bits * (information - self.code.needed_information)
                data = body[FILE_BYTES:-CRC32C_BYTES].tobytes()
                file = FileFacts.parse(body[:FILE_BYTES].tobytes())
                margin = min(margin, 0.0) if failed else margin
                return PageBytes(candidate, data, file, None, iterations, failed, self.blocks, corrected, margin)
        if header is None and not failed:
            loss = Loss.HEADER
        elif header is not None and header.code_id != self.code.id:
            loss = Loss.CODE
        else:
            loss = Loss.BODY if failed else Loss.CHECKSUM
        return self._lost(header, loss, blocks, failed, iterations)

    def decide(
        self, phase: NDArray[np.floating], concentration: NDArray[np.floating]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Levels of a page whose bytes may be out of reach.

        A block that converges is a word of the code, and so the cosets of its symbols are known. About the limit of the
        bench code, 0.11% at most are another word than was sent (`analysis.codec.safety`).

        Args:
            phase, concentration: as for `decode`.

        Returns:
            The nearest level of each symbol, or of its coset where blocks that converge settle that, uint8 [ny, nx];
            where they do, bool [ny, nx].
        """
        mu, kappa = phase.ravel(), concentration.ravel()
        levels, settled = self._levels.nearest(mu), np.zeros(mu.size, np.bool_)
        own = mu[self._body].astype(np.float64)
        found = decode(self.ldpc, self._blocks(own, kappa[self._body]), threads=self._threads)
        converged = np.repeat(found.converged[:, None], self.ldpc.sent_bits, axis=1).astype(np.uint8)
        sure = self._interleaved(converged[None], np.ones_like(self._filling)).all(axis=1)
        label = self._interleaved(found.sent[None])[sure]
        upper = decide_in_coset(own[sure], label, self._levels)
        levels[self._body[sure]], settled[self._body[sure]] = to_levels(label, upper, self.code.levels), True
        return levels.reshape(phase.shape), settled.reshape(phase.shape)

    def _blocks(self, phase: NDArray[np.float64], concentration: NDArray[np.floating]) -> NDArray[np.float32]:
        """LLRs of the sent bits of the body's symbols, [blocks, n]."""
        llrs = bit_llrs(phase, concentration, self._levels, self.code.coded_bits, self._threads).ravel()
        return gathered(llrs, self._order[: self.blocks * self.ldpc.sent_bits]).reshape(self.blocks, -1)

    def _lost(
        self, header: Header | None, loss: Loss, blocks: NDArray[np.float32], failed: int, iterations: float
    ) -> PageBytes:
        margin = self.code.coded_bits * (page_information(blocks) - self.code.needed_information)
        # what is wrong and claims to be certain is no margin
        return PageBytes(header, None, None, loss, iterations, failed, self.blocks, 0, min(margin, 0.0))

    def _checked(self, bits: Bits, header: Header) -> tuple[NDArray[np.uint8] | None, int]:
        """The body in the bits of a page where its checksum holds, mended if need be; and how much was mended."""
        body = np.packbits(bits[: 8 * self._bytes]) ^ self._scrambler(header)
        if self._holds(body, header):
            return body, 0
        if not self.code.corrections:
            return None, 0
        mended, corrected = self._mended(bits)
        body = np.packbits(mended[: 8 * self._bytes]) ^ self._scrambler(header)
        return (body, corrected) if corrected and self._holds(body, header) else (None, 0)

    @staticmethod
    def _holds(body: NDArray[np.uint8], header: Header) -> bool:
        check = int.from_bytes(body[-CRC32C_BYTES:].tobytes(), "big")
        return crc32c(header.fields() + body[:-CRC32C_BYTES].tobytes()) == check

    def _scrambler(self, header: Header) -> NDArray[np.uint8]:
        return random_bytes(header.volume << 24 | header.page, self._bytes)

    @property
    def _upper_weights(self) -> NDArray[np.int64]:
        """Bits of a number within its coset, the highest first."""
        return 1 << np.arange(self._upper_bits)[::-1]

    def _labels(self, information: Bits) -> Bits:
        """Label bits of the body's symbols, [pages * symbols, b], of information bits [pages, bits]."""
        sent = self.ldpc.encode(information.reshape(-1, self.ldpc.information_bits))
        return self._interleaved(sent.reshape(len(information), self.blocks, -1))

    def _interleaved(self, sent: Bits, filling: Bits | None = None) -> Bits:
        """Sent bits [pages, blocks, n] in the places that they have on the page, [pages * symbols, b]."""
        filling = self._filling if filling is None else filling
        pages = len(sent)
        label = np.empty((pages, self._coded_bits), np.uint8)
        reached = self.blocks * self.ldpc.sent_bits
        for page, bits in zip(label, sent.reshape(pages, -1), strict=True):
            scatter(bits, self._order[:reached], page)
            scatter(filling, self._order[reached:], page)
        return label.reshape(-1, self.code.coded_bits)

    def _symbols(self, bits: Bits) -> NDArray[np.int64]:
        """All whole 12-bit symbols of bits [..., total bits], the highest bit first."""
        whole = self._total_bits // SYMBOL_BITS
        parts = bits[..., : whole * SYMBOL_BITS].reshape(*bits.shape[:-1], whole, SYMBOL_BITS)
        return np.asarray(parts @ (1 << np.arange(SYMBOL_BITS, dtype=np.int64)[::-1]))

    def _add_parity(self, bits: Bits) -> None:
        """Fill in the Reed-Solomon parity behind the data, [pages, total bits]; symbol i is of word i mod words."""
        for page in bits:
            symbols = self._symbols(page)
            for word in range(self._words):
                ends = parity(symbols[None, word : self._data_symbols : self._words], self.code.corrections)[0]
                symbols[self._data_symbols + word :: self._words] = ends
            self._put(page, symbols, self._data_symbols)

    def _put(self, page: Bits, symbols: NDArray[np.int64], start: int) -> None:
        """Write symbols from `start` on into the bits of a page."""
        parts = symbols[start:, None] >> np.arange(SYMBOL_BITS)[::-1] & 1
        page[start * SYMBOL_BITS : len(symbols) * SYMBOL_BITS] = parts.ravel()

    def _mended(self, bits: Bits) -> tuple[Bits, int]:
        """The bits of a page with what Reed-Solomon mends, and how many symbols that were; 0 where a word fails."""
        symbols, corrected = self._symbols(bits), 0
        for word in range(self._words):
            places = np.concatenate(
                [
                    np.arange(word, self._data_symbols, self._words),
                    np.arange(self._data_symbols + word, len(symbols), self._words),
                ]
            )
            found = repair(symbols[places], self.code.corrections)
            if found is None:
                return bits, 0
            data, wrong = found
            symbols[places[: len(data)]] = data
            corrected += wrong
        mended = bits.copy()
        self._put(mended, symbols, 0)
        return mended, corrected
