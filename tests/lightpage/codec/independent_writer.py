"""A second writer of pages of user bytes, made from docs/formats.md alone and from the public standards that it names.

It shares no code with the project; only the table of base graph 1, which the page names, and the profiles are read from
there. Run as a program, it makes vectors.json.
"""

from __future__ import annotations

import csv
import functools
import hashlib
import json
import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np

PACKAGE = Path(__file__).parents[3] / "lightpage"
TABLE = PACKAGE / "codec" / "ldpc" / "base_graph_1.csv"
PROFILES = PACKAGE / "device" / "profiles"
VECTORS = Path(__file__).with_name("vectors.json")
MASK_32, MASK_64, MASK_128 = (1 << 32) - 1, (1 << 64) - 1, (1 << 128) - 1
HEADER_SEED, ORDER_SEED, FILL_SEED = 0x4C504844, 0x4C50494C, 0x4C50464C
HEADER_INFORMATION = 136


def up(numerator: int, denominator: int) -> int:
    """A whole division, rounded up."""
    return -(-numerator // denominator)


# Bits and checksums


def bits_of_number(value: int, width: int) -> list[int]:
    """The bits of a whole number, the highest first."""
    return [value >> shift & 1 for shift in range(width - 1, -1, -1)]


def bits_of_bytes(data: bytes) -> list[int]:
    """The bits of bytes, the highest of each first."""
    return [bit for byte in data for bit in bits_of_number(byte, 8)]


def number_of_bits(bits: Sequence[int]) -> int:
    """The whole number whose bits these are, the highest first."""
    value = 0
    for bit in bits:
        value = value << 1 | bit
    return value


def crc_16(data: bytes) -> int:
    """CRC-16 with polynomial 0x1021 and start 0xFFFF, nothing reflected."""
    state = 0xFFFF
    for byte in data:
        state ^= byte << 8
        for _ in range(8):
            state = (state << 1 ^ (0x1021 if state & 0x8000 else 0)) & 0xFFFF
    return state


def crc_32c(data: bytes) -> int:
    """CRC-32C of Castagnoli: reflected, polynomial 0x1EDC6F41, start and end inverted."""
    state = MASK_32
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0x82F63B78 if state & 1 else 0)
    return state ^ MASK_32


# Random numbers


def split_mix(seed: int, count: int) -> list[int]:
    """The first outputs of SplitMix64."""
    outputs = []
    for index in range(count):
        z = (seed + (index + 1) * 0x9E3779B97F4A7C15) & MASK_64
        z = ((z ^ z >> 30) * 0xBF58476D1CE4E5B9) & MASK_64
        z = ((z ^ z >> 27) * 0x94D049BB133111EB) & MASK_64
        outputs.append(z ^ z >> 31)
    return outputs


def random_bytes(seed: int, count: int) -> bytes:
    """The random bytes of a seed."""
    return b"".join(output.to_bytes(8, "little") for output in split_mix(seed, up(count, 8)))[:count]


def random_order(seed: int, count: int) -> list[int]:
    """The numbers 0 to count - 1 by ascending output of their index."""
    outputs = split_mix(seed, count)
    return sorted(range(count), key=outputs.__getitem__)


def scrambled(data: bytes, seed: int) -> bytes:
    """The bytes XORed with the random bytes of a seed."""
    return bytes(a ^ b for a, b in zip(data, random_bytes(seed, len(data)), strict=True))


def seed_words(entropy: Sequence[int], count: int) -> list[int]:
    """32-bit words that numpy's SeedSequence makes from whole numbers."""
    words: list[int] = []
    for number in entropy:
        words.append(number & MASK_32)
        while number := number >> 32:
            words.append(number & MASK_32)
    constant = 0x43B0D7E5

    def hashed(value: int) -> int:
        nonlocal constant
        value ^= constant
        constant = constant * 0x931E8875 & MASK_32
        value = value * constant & MASK_32
        return value ^ value >> 16

    def mixed(x: int, y: int) -> int:
        value = (0xCA01F9DD * x - 0x4973F715 * y) & MASK_32
        return value ^ value >> 16

    pool = [hashed(words[i] if i < len(words) else 0) for i in range(4)]
    for source in range(4):
        for target in range(4):
            if source != target:
                pool[target] = mixed(pool[target], hashed(pool[source]))
    for word in words[4:]:
        for target in range(4):
            pool[target] = mixed(pool[target], hashed(word))
    constant = 0x8B51F9DD
    state = []
    for index in range(count):
        value = pool[index % 4] ^ constant
        constant = constant * 0x58F38DED & MASK_32
        value = value * constant & MASK_32
        state.append(value ^ value >> 16)
    return state


def uniform(pilot_seed: int, stream: int) -> Iterator[float]:
    """The uniform numbers of PCG64 that numpy's default_rng([pilot_seed, stream]) gives."""
    words = seed_words([pilot_seed, stream], 8)
    a, b, c, d = (words[i] | words[i + 1] << 32 for i in range(0, 8, 2))
    increment = ((c << 64 | d) << 1 | 1) & MASK_128
    multiplier = 0x2360ED051FC65DA44385DF649FCCF645
    state = (increment + (a << 64 | b)) & MASK_128
    state = (state * multiplier + increment) & MASK_128
    while True:
        state = (state * multiplier + increment) & MASK_128
        value = (state >> 64 ^ state) & MASK_64
        rotation = state >> 122
        output = (value >> rotation | value << (64 - rotation)) & MASK_64
        yield (output >> 11) / 2**53


# Pilots


@dataclass(frozen=True)
class Layout:
    """A page's size and its pilots: for each symbol, row by row, its level where it is a pilot, else None."""

    rows: int
    columns: int
    pilots: tuple[int | None, ...]


def profile_layout(rows: int, columns: int, pilot_fraction: float, pilot_seed: int, levels: int) -> Layout:
    """The layout that follows from a profile."""
    count = min(max(round(pilot_fraction * rows * columns), 4), rows * columns)
    cell_rows = min(max(round(math.sqrt(count * rows / columns)), 1), rows)
    cell_columns = min(max(up(count, cell_rows), 1), columns)
    cell_rows = min(max(cell_rows, up(count, cell_columns)), rows)
    places = uniform(pilot_seed, 0)
    down = [next(places) for _ in range(cell_rows * cell_columns)]
    along = [next(places) for _ in range(cell_rows * cell_columns)]
    values = uniform(pilot_seed, 1)
    numbers = [int(next(values) * levels) for _ in range(rows * columns)]
    pilots: list[int | None] = [None] * (rows * columns)
    for i in range(cell_rows):
        top, bottom = i * rows // cell_rows, (i + 1) * rows // cell_rows
        for j in range(cell_columns):
            left, right = j * columns // cell_columns, (j + 1) * columns // cell_columns
            y = top + int(down[i * cell_columns + j] * (bottom - top))
            x = left + int(along[i * cell_columns + j] * (right - left))
            pilots[y * columns + x] = numbers[y * columns + x]
    return Layout(rows, columns, tuple(pilots))


def shipped_layout(name: str, levels: int) -> Layout:
    """The layout of a profile that comes with the project."""
    page = tomllib.loads((PROFILES / f"{name}.toml").read_text("utf-8"))["page"]
    return profile_layout(page["rows"], page["columns"], page["pilot_fraction"], page["pilot_seed"], levels)


# The LDPC code of 5G New Radio, base graph 1


@functools.cache
def base_graph() -> list[tuple[int, int, tuple[int, ...]]]:
    """Row, column and the shifts of the eight sets of lifting sizes, of each entry of the table."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        entries = [[int(value) for value in row] for row in list(csv.reader(file))[1:]]
    return [(entry[0], entry[1], tuple(entry[2:])) for entry in entries]


def lifting(information: int) -> tuple[int, int]:
    """The smallest lifting size for so many information bits, and the number of its set."""
    sizes = {a << j: i for i, a in enumerate((2, 3, 5, 7, 9, 11, 13, 15)) for j in range(8) if a << j <= 384}
    size = min(size for size in sizes if 22 * size >= information)
    return size, sizes[size]


@functools.cache
def checks(size: int, set_number: int) -> list[dict[int, int]]:
    """The shift of every column, of each of the 46 rows."""
    rows: list[dict[int, int]] = [{} for _ in range(46)]
    for row, column, shifts in base_graph():
        rows[row][column] = shifts[set_number] % size
    return rows


def ldpc_sent(information: Sequence[int], sent: int) -> list[int]:
    """The sent bits of a block."""
    size, set_number = lifting(len(information))
    rows = checks(size, set_number)
    full = (1 << size) - 1

    def turned(block: int, shift: int) -> int:
        """Bit r of the result is bit (r + shift) mod size: a matrix shifted to the right, times the block."""
        return (block >> shift | block << (size - shift)) & full

    padded = [*information, *[0] * (22 * size - len(information))]
    # bit r of a number is bit r of its block
    blocks = [number_of_bits(padded[i * size : (i + 1) * size][::-1]) for i in range(22)]
    partial = [0] * 4
    for row in range(4):
        for column, shift in rows[row].items():
            if column < 22:
                partial[row] ^= turned(blocks[column], shift)
    # The sum of the first four rows leaves nothing but one shift of the first parity block.
    first = [rows[row].get(22) for row in range(4)]
    assert first[0] == first[3] is not None
    assert first[1] is not None
    assert first[2] is None
    total = partial[0] ^ partial[1] ^ partial[2] ^ partial[3]
    p_0 = turned(total, (size - first[1]) % size)
    p_1 = partial[0] ^ turned(p_0, first[0])
    p_2 = partial[1] ^ turned(p_0, first[1]) ^ p_1
    p_3 = partial[2] ^ p_2
    assert partial[3] ^ turned(p_0, first[3]) ^ p_3 == 0
    blocks += [p_0, p_1, p_2, p_3]
    for row in range(4, 46):
        value = 0
        for column, shift in rows[row].items():
            if column < 26:
                value ^= turned(blocks[column], shift)
        blocks.append(value)
    parity = [block >> r & 1 for block in blocks[22:] for r in range(size)]
    return [*information[2 * size :], *parity][:sent]


# Reed-Solomon words over GF(2^12), parity pages over GF(2^8)


class Field:
    """A field of 2^width elements, by the logarithms to the base x."""

    def __init__(self, width: int, polynomial: int) -> None:
        self.order = (1 << width) - 1
        self.power = [1]
        for _ in range(self.order - 1):
            value = self.power[-1] << 1
            self.power.append(value ^ polynomial if value >> width else value)
        self.log = {value: i for i, value in enumerate(self.power)}
        assert len(self.log) == self.order

    def product(self, a: int, b: int) -> int:
        return self.power[(self.log[a] + self.log[b]) % self.order] if a and b else 0

    def inverse(self, a: int) -> int:
        return self.power[-self.log[a] % self.order]


@functools.cache
def field(width: int, polynomial: int) -> Field:
    return Field(width, polynomial)


def reed_solomon_parity(data: Sequence[int], corrections: int) -> list[int]:
    """The parity symbols of a word, the highest power first."""
    words = field(12, 0x1053)
    generator = [1]  # highest power first
    for i in range(2 * corrections):
        root = words.power[i]
        generator = [a ^ words.product(b, root) for a, b in zip([*generator, 0], [0, *generator], strict=True)]
    remainder = [0] * (2 * corrections)
    for symbol in data:
        lead = symbol ^ remainder[0]
        remainder = [*remainder[1:], 0]
        if lead:
            remainder = [a ^ words.product(lead, b) for a, b in zip(remainder, generator[1:], strict=True)]
    return remainder


def parity_page(group: Sequence[bytes], index: int) -> bytes:
    """Parity page index of a group's data pages."""
    pages = field(8, 0x11D)
    total = bytes(len(group[0]))
    for j, data in enumerate(group):
        factor = pages.inverse((len(group) + index) ^ j)
        product = data.translate(bytes(pages.product(value, factor) for value in range(256)))
        total = bytes(a ^ b for a, b in zip(total, product, strict=True))
    return total


# A page


@dataclass(frozen=True)
class Parameters:
    """A code's parameters that the symbols depend on."""

    levels: int
    coded_bits: int
    rate_per_mille: int
    corrections: int


@dataclass(frozen=True)
class Sizes:
    """What follows from a code and a number of data symbols."""

    header_symbols: int
    body_symbols: int
    blocks: int
    information: int
    sent: int
    total: int
    words: int
    body_bytes: int

    @property
    def user_bytes(self) -> int:
        return self.body_bytes - 10


def header_bits(levels: int) -> int:
    """The bits of a header symbol."""
    return max(2, levels // 8).bit_length() - 1


def header_sent(levels: int) -> int:
    """Sent bits of the header."""
    return 408 if levels <= 4 else 204


def sizes(code: Parameters, data_symbols: int) -> Sizes:
    """The sizes of a page's parts."""
    bits = code.levels.bit_length() - 1
    header_symbols = up(header_sent(code.levels), header_bits(code.levels))
    body_symbols = data_symbols - header_symbols
    coded = body_symbols * code.coded_bits
    blocks = up(coded * code.rate_per_mille, 1000 * 8448)
    sent = coded // blocks
    information = sent * code.rate_per_mille // 1000
    total = blocks * information + body_symbols * (bits - code.coded_bits)
    words = up(total // 12, 4095) if code.corrections else 0
    data = 12 * (total // 12 - 2 * code.corrections * words) if code.corrections else total
    return Sizes(header_symbols, body_symbols, blocks, information, sent, total, words, data // 8)


def page_user_bytes(code: Parameters, layout: Layout) -> int:
    """How many user bytes a page carries."""
    return sizes(code, layout.pilots.count(None)).user_bytes


def coset_level(label: Sequence[int]) -> int:
    """The coset number of label bits, L_0 first."""
    gray = number_of_bits(label[::-1])
    value = 0
    while gray:
        value ^= gray
        gray >>= 1
    return value


def header(code: Parameters, volume: int, page: int, file_bytes: int) -> bytes:
    """The header's 17 bytes."""
    text = f"{code.levels} {code.coded_bits} {code.rate_per_mille} {code.corrections}"
    fields = (1, 1), (crc_16(text.encode("ascii")), 2), (volume, 4), (page, 3), (file_bytes, 5)
    start = b"".join(value.to_bytes(width, "big") for value, width in fields)
    return start + crc_16(start).to_bytes(2, "big")


def header_levels(code: Parameters, data: bytes) -> list[int]:
    """The levels of the header's symbols."""
    width = header_bits(code.levels)
    bits = ldpc_sent(bits_of_bytes(scrambled(data, HEADER_SEED)), header_sent(code.levels))
    bits += [0] * (-len(bits) % width)
    step = code.levels >> width
    return [coset_level(bits[i : i + width]) * step for i in range(0, len(bits), width)]


def protected_bits(code: Parameters, sizes: Sizes, body: bytes) -> list[int]:
    """The T bits: the body, zeros and the Reed-Solomon parity."""
    bits = bits_of_bytes(body)
    bits += [0] * (sizes.total - len(bits))
    if code.corrections:
        data = sizes.total // 12 - 2 * code.corrections * sizes.words
        symbols = [number_of_bits(bits[12 * i : 12 * i + 12]) for i in range(data)]
        for word in range(sizes.words):
            for j, symbol in enumerate(reed_solomon_parity(symbols[word :: sizes.words], code.corrections)):
                place = 12 * (data + j * sizes.words + word)
                bits[place : place + 12] = bits_of_number(symbol, 12)
    return bits


def body_levels(code: Parameters, sizes: Sizes, body: bytes) -> list[int]:
    """The levels of the body's symbols."""
    bits = protected_bits(code, sizes, body)
    sent = []
    for block in range(sizes.blocks):
        information = bits[block * sizes.information : (block + 1) * sizes.information]
        sent += ldpc_sent(information, sizes.sent)
    count = sizes.body_symbols * code.coded_bits
    left = count - len(sent)
    sent += bits_of_bytes(random_bytes(FILL_SEED, up(left, 8)))[:left]
    coded = [0] * count
    for place, bit in zip(random_order(ORDER_SEED, count), sent, strict=True):
        coded[place] = bit
    width = code.levels.bit_length() - 1 - code.coded_bits
    start = sizes.blocks * sizes.information
    levels = []
    for symbol in range(sizes.body_symbols):
        label = coded[symbol * code.coded_bits : (symbol + 1) * code.coded_bits]
        upper = number_of_bits(bits[start + symbol * width : start + (symbol + 1) * width])
        levels.append(coset_level(label) + (upper << code.coded_bits))
    return levels


def page_symbols(
    code: Parameters,
    layout: Layout,
    user: bytes,
    *,
    volume: int,
    page: int,
    file_bytes: int,
    checksum: int,
    k: int,
    m: int,
) -> list[int]:
    """A page's symbols, pilots included, row by row."""
    data_symbols = layout.pilots.count(None)
    parts = sizes(code, data_symbols)
    if len(user) != parts.user_bytes:
        raise ValueError("wrong number of user bytes")
    head = header(code, volume, page, file_bytes)
    body = bytes([k, m]) + checksum.to_bytes(4, "big") + user
    body += crc_32c(head[:15] + body).to_bytes(4, "big")
    body = scrambled(body, (volume << 24) + page)
    count = parts.header_symbols
    places = {(2 * j + 1) * data_symbols // (2 * count) for j in range(count)}
    in_header, in_body = iter(header_levels(code, head)), iter(body_levels(code, parts, body))
    data = iter([next(in_header) if i in places else next(in_body) for i in range(data_symbols)])
    return [next(data) if pilot is None else pilot for pilot in layout.pilots]


# A file


def page_users(file: bytes, length: int, *, k: int, m: int) -> dict[int, bytes]:
    """The user bytes of all pages of a file by their numbers, `length` bytes each."""
    count = max(up(len(file), length), 1)
    pieces = [file[i * length : (i + 1) * length].ljust(length, b"\0") for i in range(count)]
    users: dict[int, bytes] = {}
    for group in range(up(count, k)):
        first = group * (k + m)
        members = pieces[group * k : (group + 1) * k]
        users |= {first + i: member for i, member in enumerate(members)}
        members += [bytes(length)] * (k - len(members))
        users |= {first + k + i: parity_page(members, i) for i in range(m)}
    return users


def file_pages(code: Parameters, layout: Layout, file: bytes, *, volume: int, k: int, m: int) -> dict[int, np.ndarray]:
    """All pages of a file by their numbers: uint8 [rows, columns]."""
    users = page_users(file, page_user_bytes(code, layout), k=k, m=m)
    facts = {"volume": volume, "file_bytes": len(file), "checksum": crc_32c(file), "k": k, "m": m}
    return {
        page: np.array(page_symbols(code, layout, user, page=page, **facts), dtype=np.uint8).reshape(
            layout.rows, layout.columns
        )
        for page, user in users.items()
    }


def write_pages(
    path: Path,
    code: Parameters,
    layout: Layout,
    file: bytes,
    *,
    volume: int,
    k: int,
    m: int,
    profile: str,
    needed_information: float,
) -> None:
    """A file's pages to write, as HDF5."""
    symbols = np.stack(list(file_pages(code, layout, file, volume=volume, k=k, m=m).values()))
    attribute = {
        "levels": code.levels,
        "coded_bits": code.coded_bits,
        "rate_per_mille": code.rate_per_mille,
        "corrections": code.corrections,
        "needed_information": needed_information,
        "volume": volume,
        "file_bytes": len(file),
        "page_bytes": page_user_bytes(code, layout),
        "data_pages": k,
        "parity_pages": m,
        "checksum": crc_32c(file),
    }
    with h5py.File(path, "w") as out:
        out.attrs["format"] = "lightpage-pages"
        out.attrs["version"] = 1
        out.attrs["levels"] = code.levels
        out.attrs["profile"] = profile
        out.attrs["code"] = json.dumps(attribute)
        out.create_dataset("symbols", data=symbols, chunks=(1, layout.rows, layout.columns))


# Test vectors

VECTOR_CODES = Parameters(2, 1, 500, 0), Parameters(64, 6, 870, 0), Parameters(128, 2, 800, 3)


def vector_file(count: int) -> bytes:
    """The file that vectors are made of: byte i is i mod 256."""
    return bytes(i % 256 for i in range(count))


def make_vector(code: Parameters, *, volume: int, k: int, m: int) -> dict[str, object]:
    """What a file of k + 1 data pages, the last with 100 bytes, comes to on bench pages."""
    layout = shipped_layout("bench", code.levels)
    length = page_user_bytes(code, layout)
    file = vector_file(k * length + 100)
    users = page_users(file, length, k=k, m=m)
    return {
        "profile": "bench",
        "code": asdict(code),
        "volume": volume,
        "k": k,
        "m": m,
        "file": "byte i is i mod 256",
        "file_bytes": len(file),
        "page_bytes": length,
        "pages": [
            {
                "number": page,
                "user_bytes_sha256": hashlib.sha256(users[page]).hexdigest(),
                "header": header(code, volume, page, len(file)).hex(),
                "first_symbols": symbols.ravel()[:64].tolist(),
                "symbols_sha256": hashlib.sha256(symbols.tobytes()).hexdigest(),
            }
            for page, symbols in file_pages(code, layout, file, volume=volume, k=k, m=m).items()
        ],
    }


def make_vectors() -> list[dict[str, object]]:
    """All test vectors."""
    volumes = 1, 0x89ABCDEF, 4242
    return [make_vector(code, volume=volume, k=2, m=1) for code, volume in zip(VECTOR_CODES, volumes, strict=True)]


if __name__ == "__main__":
    text = json.dumps(make_vectors(), indent=1)
    text = re.sub(r"\[([\d,\s]+)\]", lambda found: f"[{' '.join(found[1].split())}]", text)
    VECTORS.write_text(text + "\n", "utf-8")
