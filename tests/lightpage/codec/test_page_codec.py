"""A page of user bytes: what goes in comes out, or nothing does; never other bytes."""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from lightpage.codec.choose import DrawnPage, needed_information
from lightpage.codec.code import Code
from lightpage.codec.header import header_symbols
from lightpage.codec.page_bytes import Loss
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import InvalidInputError, PageError
from lightpage.page.levels import Levels
from tests.lightpage.codec.light import GROUP, SHAPE, codec_of, header_of, noisy, pilot_mask, written
from tests.lightpage.refused import refused
from tests.lightpage.uneven import uneven

CODES = [
    # M, b, rate in thousandths, t
    (2, 1, 700, 0),
    (4, 2, 340, 0),
    (8, 3, 600, 1),
    (8, 1, 960, 0),
    (16, 2, 700, 0),
    (32, 2, 755, 3),
    (64, 1, 700, 2),
    (128, 2, 850, 8),
    (256, 2, 700, 2),
    (256, 8, 800, 32),
]


def header_places(codec: PageCodec) -> np.ndarray:
    """Return the header's places in the flat page, by the specification."""
    data, count = np.flatnonzero(~codec.pilots), header_symbols(codec.code.levels)
    return data[[(2 * j + 1) * len(data) // (2 * count) for j in range(count)]]


def body_places(codec: PageCodec) -> np.ndarray:
    """Return the body's places in the flat page, in its order."""
    return np.setdiff1d(np.flatnonzero(~codec.pilots), header_places(codec))


def kappa_of(levels: int, deviation: float) -> float:
    """Concentration of noise whose standard deviation is a share of the distance between levels."""
    return (levels / (2 * np.pi * deviation)) ** 2


def test_blocks_that_converge_on_a_page_that_fails_settle_their_symbols() -> None:
    codec, rng = codec_of(256, 2, 900, 2, shape=(100, 100)), np.random.default_rng(0)
    _, symbols = written(codec, header_of(codec), rng)
    seen = noisy(symbols, 256, kappa_of(256, 0.24), rng)
    assert (codec.decode(*seen).failed_blocks, codec.blocks) == (1, 3)
    decided, settled = codec.decide(*seen)
    assert settled.mean() == pytest.approx(4 / 9, abs=0.05)  # both bits of a symbol lie in the two of three
    np.testing.assert_array_equal(decided[settled], symbols[settled])
    assert np.mean(decided != symbols) > 0.01


def test_pages_of_an_earlier_code_are_read_by_the_code_that_their_header_names() -> None:
    first, rng = codec_of(64, 2, 700, 2, shape=(28, 44)), np.random.default_rng(4)
    code = codec_of(64, 2, 750, 2, shape=(28, 44)).code
    header = header_of(first)
    data, symbols = written(first, header, rng)
    seen = noisy(symbols, 64, np.inf, rng)
    later = PageCodec(code, first.pilots, earlier=[first])
    found = later.decode(*seen)
    assert (found.data, found.header) == (data, header)
    np.testing.assert_array_equal(later.encode_again(found, symbols[first.pilots]), symbols)
    assert PageCodec(code, first.pilots).decode(*seen).loss is Loss.CODE
    own, symbols = written(later, header_of(later), rng)
    assert later.decode(*noisy(symbols, 64, np.inf, rng)).data == own


class TestRoundTrip:
    @pytest.mark.parametrize(("levels", "coded", "rate", "corrections"), CODES)
    def test_what_is_written_is_read(self, levels: int, coded: int, rate: int, corrections: int) -> None:
        codec, rng = codec_of(levels, coded, rate, corrections, shape=(28, 44)), np.random.default_rng(levels)
        for page in (0, 3, (1 << 24) - 1):
            header = header_of(codec, page)
            data, symbols = written(codec, header, rng)
            assert int(symbols.max()) < levels
            found = codec.decode(*noisy(symbols, levels, np.inf, rng))
            assert found.data == data
            assert found.header == header
            assert found.file == GROUP
            assert (found.loss, found.failed_blocks, found.corrected) == (None, 0, 0)
            assert found.blocks == codec.blocks == 1
            assert found.iterations <= 3  # bits that are not sent must be found first

    @pytest.mark.parametrize(("levels", "coded", "rate", "corrections"), CODES[-6:])
    def test_what_an_uneven_modulator_shows_is_read(self, levels: int, coded: int, rate: int, corrections: int) -> None:
        even, rng = codec_of(levels, coded, rate, corrections, shape=(28, 44)), np.random.default_rng(levels)
        codec = PageCodec(even.code, even.pilots, uneven(levels))
        data, symbols = written(codec, header_of(codec), rng)
        seen = noisy(symbols, uneven(levels), kappa_of(levels, 0.1), rng)
        assert codec.decode(*seen).data == data
        assert even.decode(*seen).data is None

    def test_several_blocks_and_words(self) -> None:
        codec, rng = codec_of(256, 2, 900, 2, shape=(100, 100)), np.random.default_rng(1)
        assert codec.blocks == 3
        header = header_of(codec)
        data, symbols = written(codec, header, rng)
        phase, kappa = noisy(symbols, 256, kappa_of(256, 0.2), rng)
        assert codec.decode(phase, kappa).data == data
        # two wrong upper numbers, 12 bits apart and more: one in each word
        wrong = body_places(codec)[[1000, 1002]]
        phase.flat[wrong] += 4 * 2 * np.pi / 256
        found = codec.decode(phase, kappa)
        assert found.data == data
        assert 2 <= found.corrected <= 4
        phase.flat[body_places(codec)[1000:1040]] += 4 * 2 * np.pi / 256
        assert codec.decode(phase, kappa).loss == Loss.CHECKSUM


def changed_bits(codec: PageCodec, symbols: np.ndarray, which: np.ndarray) -> set[int]:
    """Return which of the T bits change where these body symbols are decided one upper number too high."""
    code, start = codec.code, codec.blocks * codec.ldpc.information_bits
    bits = code.level_bits - code.coded_bits
    upper = symbols.ravel()[body_places(codec)[which]].astype(int) >> code.coded_bits
    changed = upper ^ (upper + 1) % (1 << bits)
    return {
        start + number * bits + bit
        for number, change in zip(which, changed, strict=True)
        for bit in range(bits)
        if change >> (bits - 1 - bit) & 1
    }


class TestCorrections:
    @pytest.mark.parametrize(("levels", "coded", "corrections"), [(64, 2, 4), (256, 2, 16), (64, 1, 8)])
    def test_wrong_upper_numbers_are_mended_and_counted(self, levels: int, coded: int, corrections: int) -> None:
        codec, rng = codec_of(levels, coded, 700, corrections), np.random.default_rng([levels, coded])
        step = 2 * np.pi / levels * (1 << coded)
        seen = set()
        for trial in range(30):
            data, symbols = written(codec, header_of(codec), rng)
            phase, kappa = noisy(symbols, levels, np.inf, rng)
            which = rng.choice(len(body_places(codec)) - 12, trial % (corrections + 3), replace=False)
            phase.flat[body_places(codec)[which]] += step
            bits = changed_bits(codec, symbols, which)
            wrong = len({bit // 12 for bit in bits})
            found = codec.decode(phase, kappa)
            assert found.failed_blocks == 0
            if all(bit >= 8 * (codec.user_bytes + 10) for bit in bits):  # the body, before the parity, needs no mending
                assert (found.data, found.corrected, found.loss) == (data, 0, None)
            elif wrong <= corrections:
                assert (found.data, found.corrected, found.loss) == (data, wrong, None)
            else:
                assert (found.data, found.corrected, found.loss) == (None, 0, Loss.CHECKSUM)
            seen.add(wrong - corrections)
        assert {-1, 0, 1} <= seen


def any_light(codec: PageCodec, symbols: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Phases and concentrations of a page in light about the code's limit and below, claims right or wrong."""
    levels = codec.code.levels
    kappa = kappa_of(levels, rng.uniform(0.2, 0.45) * (1 if codec.code.coded_bits > 1 else 0.8))
    phase, concentration = noisy(symbols, levels, kappa, rng)
    return phase, concentration * rng.choice([0.1, 1, 1, 1, 1, 30])


def spoilt_region(codec: PageCodec, symbols: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A page with a rectangle of anything: of no light, of certain nonsense, or shifted by some levels."""
    levels = codec.code.levels
    phase, concentration = noisy(symbols, levels, kappa_of(levels, rng.uniform(0.1, 0.25)), rng)
    (top, left), (height, width) = rng.integers(0, SHAPE), rng.integers(1, (9, 13))
    region = np.s_[top : top + height, left : left + width]
    kind = rng.integers(4)
    if kind == 0:
        concentration[region] = 0
    elif kind == 1:
        phase[region] = rng.uniform(-10, 10, phase[region].shape)
    elif kind == 2:
        phase[region] += 2 * np.pi * rng.integers(levels) / levels
    else:
        phase[region], concentration[region] = 0, 1e6
    return phase, concentration


Draw = Callable[[PageCodec, np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]


@pytest.mark.parametrize(
    ("pages", "some"),
    [(80, 12), pytest.param(5000, 750, marks=pytest.mark.long)],  # rare failures show in many pages
)
@pytest.mark.parametrize("draw", [any_light, spoilt_region])
def test_drawn_pages_give_the_right_bytes_or_none(pages: int, some: int, draw: Draw) -> None:
    rng, seen = np.random.default_rng(2), Counter[Loss | None]()
    codecs = [codec_of(16, 2, 700, 0), codec_of(64, 2, 700, 2), codec_of(64, 1, 700, 4), codec_of(256, 2, 700, 16)]
    for trial in range(pages):
        codec = codecs[trial % len(codecs)]
        header = header_of(codec, int(rng.integers(1 << 24)), int(rng.integers(1 << 32)))
        data, symbols = written(codec, header, rng)
        phase, concentration = draw(codec, symbols, rng)
        expected = [None, header, header_of(codec, header.page ^ 1, header.volume)][rng.integers(3)]
        found = codec.decode(phase, concentration, expected)
        assert found.data in (data, None)
        if found.data is not None:
            assert found.header == header
            assert found.loss is None
        else:
            assert found.loss is not None
            assert (found.file, found.corrected) == (None, 0)
        seen[found.loss] += 1
    assert seen[None] > some
    assert seen[Loss.BODY] > some


class TestHeader:
    CODEC = codec_of(64, 2, 700, 2)

    def page(self, damaged: bool = True, code_id: int | None = None) -> tuple[bytes, np.ndarray, np.ndarray]:
        """User bytes, phases and concentrations of page 3, its header unreadable if damaged."""
        rng, header = np.random.default_rng(0), header_of(self.CODEC)
        header = header if code_id is None else replace(header, code_id=code_id)
        data, symbols = written(self.CODEC, header, rng)
        phase, kappa = noisy(symbols, 64, kappa_of(64, 0.2), rng)
        if damaged:
            places = header_places(self.CODEC)
            phase.flat[places] = rng.uniform(-np.pi, np.pi, len(places))
        return data, phase, kappa

    @pytest.mark.parametrize(
        ("change", "read"),
        [
            (None, False),
            ({}, True),
            ({"page": 4}, False),
            ({"volume": 1}, False),
            ({"volume_bytes": 999_999}, False),
            ({"code_id": 1}, False),
        ],
    )
    def test_without_it_only_the_page_expected_is_read(self, change: dict[str, int] | None, read: bool) -> None:
        data, phase, kappa = self.page()
        header = header_of(self.CODEC)
        found = self.CODEC.decode(phase, kappa, None if change is None else replace(header, **change))
        assert (found.header, found.data, found.loss) == ((header, data, None) if read else (None, None, Loss.HEADER))
        assert found.failed_blocks == 0

    def test_it_is_believed_with_its_own_body_only(self) -> None:
        """A header that can be read on the body of another page: the body's checksum says which page it is."""
        data, phase, kappa = self.page(damaged=False)
        _, other = written(self.CODEC, header_of(self.CODEC, 4), np.random.default_rng(3))
        places = header_places(self.CODEC)
        phase.flat[places] = noisy(other, 64, np.inf, np.random.default_rng(4))[0].flat[places]
        found = self.CODEC.decode(phase, kappa)
        assert (found.header, found.data, found.loss) == (header_of(self.CODEC, 4), None, Loss.CHECKSUM)
        found = self.CODEC.decode(phase, kappa, header_of(self.CODEC))
        assert (found.header, found.data, found.loss) == (header_of(self.CODEC), data, None)

    def test_a_page_of_another_code_is_known_as_such(self) -> None:
        other = self.CODEC.code.id ^ 1
        _, phase, kappa = self.page(damaged=False, code_id=other)
        found = self.CODEC.decode(phase, kappa)
        assert found.header is not None
        assert (found.header.code_id, found.data, found.loss) == (other, None, Loss.CODE)
        assert found.margin_bits < 0  # its bits are not made for this code, whose need is all of them

    def test_the_body_is_lost_and_the_header_tells_which(self) -> None:
        _, phase, kappa = self.page(damaged=False)
        places = body_places(self.CODEC)
        phase.flat[places] = np.random.default_rng(2).uniform(-np.pi, np.pi, len(places))
        found = self.CODEC.decode(phase, kappa)
        assert (found.header, found.data, found.loss) == (header_of(self.CODEC), None, Loss.BODY)
        assert found.failed_blocks == found.blocks == 1


@pytest.mark.parametrize(("levels", "coded", "rate", "corrections"), [CODES[0], CODES[5], CODES[9]])
def test_darkness_and_noise_are_lost_however_sure(levels: int, coded: int, rate: int, corrections: int) -> None:
    codec = codec_of(levels, coded, rate, corrections, shape=(28, 44))
    phase = np.random.default_rng([levels, coded]).uniform(-np.pi, np.pi, codec.pilots.shape)
    for expected in (None, header_of(codec)):
        dark = codec.decode(0 * phase, 0 * phase, expected)
        assert (dark.header, dark.data) == (None, None)
        assert dark.loss is not None
        assert dark.margin_bits == pytest.approx(-coded)  # no information, where the code needs one bit of each
        for kappa in (3.0, 1e6):
            found = codec.decode(phase, np.full(phase.shape, kappa), expected)
            assert (found.header, found.data, found.loss) == (None, None, Loss.BODY)


class TestMargin:
    SHAPE = (56, 44)

    def needed(self, codec: PageCodec, rng: np.random.Generator) -> float:
        """Measure the information that the code needs, as on choosing it."""
        pages = []
        for _ in range(20):
            _, symbols = written(codec, header_of(codec), rng)
            phase, kappa = noisy(symbols, codec.code.levels, kappa_of(codec.code.levels, 0.25), rng)
            body = body_places(codec)
            pages.append(DrawnPage(phase.flat[body], kappa.flat[body], symbols.flat[body], Levels(codec.code.levels)))
        return needed_information(codec.ldpc, pages, codec.code.coded_bits, rng)

    def test_it_falls_with_noise_and_is_near_zero_where_pages_begin_to_fail(self) -> None:
        rng = np.random.default_rng(3)
        plain = codec_of(64, 2, 700, 2, self.SHAPE)
        codec = codec_of(64, 2, 700, 2, self.SHAPE, self.needed(plain, rng))
        # loss of pages and the mean margin of those read and of those lost
        before, beginning = np.inf, []
        for deviation in np.arange(0.2, 0.44, 0.03):
            found = []
            for _ in range(6):
                _, symbols = written(codec, header_of(codec), rng)
                found.append(codec.decode(*noisy(symbols, 64, kappa_of(64, deviation), rng)))
            margin = float(np.mean([page.margin_bits for page in found]))
            lost = np.mean([page.data is None for page in found])
            assert margin < before
            before = margin
            if margin > 0.12:
                assert lost == 0
            elif margin < -0.12:
                assert lost == 1
            if 0 < lost < 1:
                beginning.append(margin)
            for page in found:
                # a page's information deviates by 0.01 of each of two bits from that of the mean
                assert page.margin_bits > -0.12 if page.data is not None else page.margin_bits < 0.12
        assert beginning
        assert np.abs(beginning).max() < 0.12

    def test_it_is_all_that_the_code_does_not_need_on_a_perfect_page(self) -> None:
        codec, rng = codec_of(64, 2, 700, 2, needed=0.75), np.random.default_rng(4)
        _, symbols = written(codec, header_of(codec), rng)
        assert codec.decode(*noisy(symbols, 64, np.inf, rng)).margin_bits == pytest.approx(0.5)

    def test_it_is_of_the_truth_on_pages_that_are_read_and_nothing_on_lost_ones_that_are_sure(self) -> None:
        codec, rng = codec_of(64, 2, 700, 2, needed=0.75), np.random.default_rng(5)
        _, symbols = written(codec, header_of(codec), rng)
        phase, kappa = noisy(symbols, 64, kappa_of(64, 0.25), rng)
        honest, bold = codec.decode(phase, kappa), codec.decode(phase, 30 * kappa)
        assert honest.data is not None
        assert bold.data == honest.data
        assert bold.margin_bits < honest.margin_bits - 0.1  # claims that mislead carry less
        noise = codec.decode(np.random.default_rng(6).uniform(-9, 9, SHAPE), np.full(SHAPE, 1e6))
        assert noise.data is None
        assert noise.margin_bits == 0


class TestRefusals:
    CODEC = codec_of(16, 2, 700, 0)

    def test_data_and_pilots_of_another_shape(self) -> None:
        size, count = self.CODEC.user_bytes, np.count_nonzero(self.CODEC.pilots)
        for shape in ((1, size - 1), (1, size + 1), (2, size), (0, size), (size,)):
            with refused("user data", shape, PageError):
                self.CODEC.encode([header_of(self.CODEC)], np.zeros(shape, np.uint8), GROUP, np.zeros(count, np.uint8))
        for pilots in (count - 1, count + 1):
            with refused("pilot levels", pilots, PageError):
                data = np.zeros((1, size), np.uint8)
                self.CODEC.encode([header_of(self.CODEC)], data, GROUP, np.zeros(pilots, np.uint8))

    @pytest.mark.parametrize("shape", [(24, 16), (16, 25), (384,), (1, 16, 24)])
    def test_a_page_of_another_shape(self, shape: tuple[int, ...]) -> None:
        for phase, kappa in ((shape, SHAPE), (SHAPE, shape)):
            with refused("phase, concentration", shape, PageError):
                self.CODEC.decode(np.zeros(phase), np.ones(kappa))

    @pytest.mark.parametrize("levels", [2, 16, 256])
    def test_a_page_without_room(self, levels: int) -> None:
        code, sizes = Code(levels=levels, coded_bits=1, rate_per_mille=700), list[int]()
        count = header_symbols(levels)
        with refused("page", f"{count} data symbols"):
            PageCodec(code, np.zeros((1, count), bool))
        for symbols in range(count + 1, count + 400):
            with suppress(InvalidInputError):
                sizes.append(PageCodec(code, np.zeros((1, symbols), bool)).user_bytes)
        assert sizes[0] == 1
        assert np.all(np.diff(sizes) >= 0)

    def test_a_page_that_is_all_parity(self) -> None:
        with refused("page", "data symbols"):
            PageCodec(Code(levels=16, coded_bits=2, rate_per_mille=700, corrections=32), pilot_mask())
