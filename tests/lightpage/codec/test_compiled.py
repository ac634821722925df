"""The compiled arithmetic gives what numpy's does, bit for bit, and reads nothing that it was not given."""

from collections.abc import Callable, Iterator
from types import ModuleType

import numpy as np
import pytest

from lightpage.codec.compiled.choice import COMPILED, NUMPY, VARIABLE, compiled, in_use, spread
from lightpage.codec.ldpc.code import LdpcCode
from lightpage.codec.ldpc.decoder import DecodedBlocks, decode
from lightpage.codec.likelihood.arithmetic import exponential, logarithm
from lightpage.codec.likelihood.information import page_information
from lightpage.codec.likelihood.neighbours import searches_of, table_of
from lightpage.codec.mapping import MOST_LLR, bit_information, bit_llrs, upper_bits
from lightpage.codec.page_codec import PageCodec
from lightpage.page.levels import Levels
from tests.lightpage.codec.light import codec_of, header_of, noisy, written
from tests.lightpage.codec.test_ldpc import SIZES
from tests.lightpage.codec.test_ldpc import noisy as noisy_blocks
from tests.lightpage.refused import refused
from tests.lightpage.uneven import overlapping, uneven

try:
    from lightpage.codec.compiled import page_code
except ImportError:
    pytest.skip("no compiled page code: a C compiler, the headers of Python, and `make setup`", allow_module_level=True)

VARIANTS = range(len(page_code.variants()))


@pytest.fixture(params=VARIANTS, ids=page_code.variants())
def variant(request: pytest.FixtureRequest) -> Iterator[None]:
    """Each set of instructions that this processor has."""
    page_code.use(request.param)
    yield
    page_code.use(len(VARIANTS) - 1)


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], list[object]]:
    """Calls something with numpy and with the compiled arithmetic."""

    def call(something: Callable[[], object]) -> list[object]:
        found = []
        for name in (NUMPY, COMPILED):
            monkeypatch.setenv(VARIABLE, name)
            found.append(something())
        return found

    return call


Both = Callable[[Callable[[], object]], list[object]]


def same(one: DecodedBlocks, other: DecodedBlocks) -> bool:
    names = ("information", "sent", "converged", "iterations")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.mark.usefixtures("variant")
class TestBitForBit:
    @pytest.mark.parametrize(("information", "sent", "lifting"), SIZES)
    def test_blocks(self, information: int, sent: int, lifting: int, both: Both) -> None:
        code = LdpcCode(information, sent)
        blocks = 3 if lifting > 100 else 12
        ends = set()
        for decibel in (8.0, 3.5, 1.0, -2.0, -20.0):
            _, llrs = noisy_blocks(code, blocks, decibel, 1)
            one, other = both(lambda llrs=llrs: decode(code, llrs, iterations=12))  # type: ignore[misc]
            assert same(one, other)
            assert one.iterations.dtype == other.iterations.dtype
            ends |= set(one.converged.tolist())
        assert ends == {False, True}

    def test_blocks_of_infinities_and_of_nothing(self, both: Both) -> None:
        code, rng = LdpcCode(136, 204), np.random.default_rng(0)
        for values in ([np.inf, -np.inf], [1e300, -3.0], [0.0, -0.0], [0.5, -0.5, 0.0]):
            assert same(*both(lambda values=values: decode(code, rng.permutation(np.resize(values, (5, 204))))))  # type: ignore[misc, arg-type]
        assert same(*both(lambda: decode(code, np.zeros((0, 204)))))
        assert same(*both(lambda: decode(code, np.ones((2, 204)), iterations=0)))
        with refused("LLRs", "NaN"):
            decode(code, np.full((1, 204), np.nan))

    @pytest.mark.parametrize("levels_of", [Levels, uneven, overlapping])
    @pytest.mark.parametrize(("bits", "coded"), [(m, b) for m in range(1, 9) for b in range(1, m + 1)])
    def test_ratios_information_and_upper_numbers(
        self, bits: int, coded: int, levels_of: Callable[[int], Levels], both: Both
    ) -> None:
        rng, levels = np.random.default_rng([bits, coded]), levels_of(1 << bits)
        # half ways between levels, and phases that have turned very often
        phase = np.concatenate(
            [rng.uniform(-12, 12, 600), np.pi / levels.count * np.arange(-9, 10), [1e9, -1e300, 0, -0.0]]
        )
        kappa = np.where(rng.random(phase.size) < 0.05, 0, 10 ** rng.uniform(-3, 6, phase.size))
        kappa[:5] = 10 ** rng.uniform(6, 300, 5)
        one, other = both(lambda: bit_llrs(phase, kappa, levels, coded))
        assert np.array_equal(one, other)
        assert not np.isnan(one).any()
        truth = rng.integers(0, 2, one.shape, np.uint8)
        for known in (truth, None):
            of_one, of_other = both(lambda known=known: page_information(one, known))  # type: ignore[misc]
            assert of_one == of_other == pytest.approx(bit_information(one, known), abs=1e-6)
        assert np.array_equal(*both(lambda: upper_bits(phase, truth, levels)))

    def test_ratios_of_a_page_that_is_near_its_levels(self, both: Both) -> None:
        """Many symbols at once, among them few of which nothing is known."""
        rng = np.random.default_rng(0)
        phase, kappa = rng.uniform(-4, 4, 3000), np.full(3000, 600.0)
        kappa[1000:1004] = 0
        for levels in (32, 64, 256):
            for kind in (Levels, uneven):
                one, other = both(lambda: bit_llrs(phase, kappa * levels**2 / 64**2, kind(levels), 2))  # noqa: B023
                assert np.array_equal(one, other)

    @pytest.mark.parametrize(
        ("levels", "coded", "rate", "corrections"), [(128, 2, 660, 2), (32, 5, 755, 3), (4, 1, 500, 0)]
    )
    def test_pages(self, levels: int, coded: int, rate: int, corrections: int, both: Both) -> None:
        codec, rng = codec_of(levels, coded, rate, corrections, shape=(56, 44)), np.random.default_rng(1)
        header = header_of(codec)
        data, symbols = written(codec, header, rng)
        losses = set()
        for spread_of in (0.1, 0.3, 0.45, 0.6, 1.0, 3.0):
            seen = noisy(symbols, levels, (levels / (2 * np.pi * spread_of)) ** 2, rng)
            for expected in (None, header):
                one, other = both(lambda seen=seen, expected=expected: codec.decode(*seen, expected))  # type: ignore[misc]
                assert one == other
                assert one.data in (None, data)
                losses.add(one.loss)
        assert None in losses
        assert len(losses) > 1


def test_numbers_that_have_no_such_arithmetic_are_close() -> None:
    x = np.linspace(-80, 0, 10_001, dtype=np.float32)
    np.testing.assert_allclose(exponential(x), np.exp(x.astype(float)), rtol=2.5e-7)
    y = np.concatenate([exponential(x), 1 + x / -80, 1 + np.float32(2.0**-20) * np.arange(100, dtype=np.float32)])
    np.testing.assert_allclose(logarithm(y), np.log(y.astype(float)), rtol=2.5e-7, atol=1e-9)


def test_threads_change_nothing() -> None:
    code = LdpcCode(136, 204)
    _, llrs = noisy_blocks(code, 7, 1.0, 2)
    assert all(same(decode(code, llrs), decode(code, llrs, threads=threads)) for threads in (2, 3, 20))
    rng = np.random.default_rng(0)
    phase, kappa = rng.uniform(-4, 4, 1001), rng.uniform(0, 1e4, 1001)
    assert np.array_equal(bit_llrs(phase, kappa, 64, 2), bit_llrs(phase, kappa, 64, 2, threads=3))
    one = codec_of(64, 2, 700, shape=(40, 40))
    many = PageCodec(one.code, one.pilots, threads=3)
    _, symbols = written(one, header_of(one), rng)
    seen = noisy(symbols, 64, 1000, rng)
    assert one.decode(*seen) == many.decode(*seen)


def test_a_failure_in_any_thread_is_raised() -> None:
    def work(some: slice) -> None:
        if some.start:
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011
        spread(work, 4, 2)


def test_the_variable_chooses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert compiled() is page_code
    assert in_use() == f"{COMPILED} ({page_code.variants()[-1]})"
    monkeypatch.setenv(VARIABLE, NUMPY)
    assert compiled() is None
    assert in_use() == NUMPY
    monkeypatch.setenv(VARIABLE, "fortran")
    with refused(VARIABLE, "fortran"):
        in_use()


class TestRefusals:
    """Wrong arguments are refused before they are read."""

    CODE = LdpcCode(136, 204)

    def arguments(self) -> list[object]:
        code = self.CODE
        graph = (*code.rows, code.lifting, 136, 204)
        out = np.zeros((2, 136), np.uint8), np.zeros((2, 204), np.uint8), np.zeros(2, np.int32)
        return [graph, 5, 0.5, 40.0, 1e4, np.ones((2, 204), np.float32), *out]

    @pytest.mark.parametrize(
        ("place", "value"),
        [
            (1, 0),
            (5, np.ones((2, 204))),  # float64
            (5, np.ones((2, 203), np.float32)),
            (5, np.ones((2, 408), np.float32)[:, ::2]),
            (5, np.ones((2, 204), ">f4")),
            (5, np.frombuffer(bytes(2 * 204 * 4 + 1), np.uint8)[1:].view(np.float32)),
            (5, b""),
            (6, np.zeros((2, 135), np.uint8)),
            (7, np.zeros((1, 204), np.uint8)),
            (7, b"\0" * 408),  # cannot be written to
            (8, np.zeros(3, np.int32)),
            (8, np.zeros(2, np.int64)),
            (8, None),
        ],
    )
    def test_blocks(self, place: int, value: object) -> None:
        arguments = self.arguments()
        page_code.decode_blocks(*arguments)  # type: ignore[arg-type]
        arguments[place] = value
        with pytest.raises((ValueError, TypeError, BufferError)):
            page_code.decode_blocks(*arguments)  # type: ignore[arg-type]

    def test_graphs(self) -> None:
        arguments = self.arguments()
        degrees, edges = self.CODE.rows
        wrong_edges = []
        for place, value in (((0, 0), -1), ((0, 0), 68), ((0, 1), 7), ((0, 1), -1), ((1, 0), edges[0, 0])):
            wrong_edges.append(edges.copy())
            wrong_edges[-1][place] = value
        graphs: list[tuple[object, ...]] = [(degrees, wrong, 7, 136, 204) for wrong in wrong_edges]
        graphs += [(wrong, edges, 7, 136, 204) for wrong in (degrees + 1, degrees * 0, degrees[:3])]
        graphs += [(degrees, edges[:-1], 7, 136, 204), (degrees, edges.ravel()[:-1].copy(), 7, 136, 204)]
        graphs += [(degrees, edges, z, 136, 204) for z in (0, -1, 385, 6)]
        graphs += [(degrees, edges, 7, information, 204) for information in (0, 155)]
        graphs += [(degrees, edges, 7, 136, sent) for sent in (0, -5, 10, 10**6)]
        for graph in graphs:
            arguments[0] = graph
            with pytest.raises((ValueError, TypeError)):
                page_code.decode_blocks(*arguments)  # type: ignore[arg-type]

    def test_ratios(self) -> None:
        phase, out = np.zeros(9), np.zeros((9, 2), np.float32)

        def call(levels: object, phase: np.ndarray = phase, out: np.ndarray = out) -> None:
            page_code.llrs(phase, np.ones(9), levels, MOST_LLR, out)  # type: ignore[arg-type]

        for of in (Levels, uneven):
            packed = table_of(of(32), 2).packed
            call(packed)
            wrong: dict[int, list[object]] = {0: [31, 512, 0], 1: [0, 6], 2: [not packed[2]], 3: [-2, 32]}
            wrong |= {4: [np.zeros(0)], 5: [np.zeros(3)]}
            for place in (8, 9):
                near: tuple[object, ...] = packed[place]  # type: ignore[assignment]
                wrong[place] = [(width, *near[1:]) for width in (0, 3, 64, -16)]
            for place, values in wrong.items():
                for value in values:
                    with pytest.raises((ValueError, TypeError)):
                        call((*packed[:place], value, *packed[place + 1 :]))
            with pytest.raises(ValueError, match="1e6"):
                call(packed, phase=np.full(9, 1e7))
            with pytest.raises((ValueError, TypeError)):
                call(packed, phase=np.zeros(8))
            with pytest.raises((ValueError, TypeError)):
                call(packed, out=np.zeros((8, 2), np.float32))
        search = list(packed[6])  # type: ignore[call-overload]
        search[3] = search[3] + 32
        with pytest.raises(ValueError, match="starts"):
            call((*packed[:6], tuple(search), *packed[7:]))

    def test_orders(self) -> None:
        values, bits = np.ones(5, np.float32), np.ones(3, np.uint8)
        for order in ([0, 1, 5], [0, -1, 2]):
            numbers = np.array(order, np.int32)
            with pytest.raises(ValueError, match="order"):
                page_code.gather(values, numbers, np.zeros(3, np.float32))
            with pytest.raises(ValueError, match="order"):
                page_code.scatter(bits, numbers, np.zeros(5, np.uint8))
        with pytest.raises(ValueError, match="gathered"):
            page_code.gather(values, np.zeros(3, np.int32), np.zeros(2, np.float32))

    def test_numbers(self) -> None:
        phase, label, out = np.zeros(4), np.zeros((4, 2), np.uint8), np.zeros((4, 3), np.uint8)
        assert page_code.upper_bits(phase, label, 2, 5, None, out)
        assert not page_code.upper_bits(np.full(4, np.nan), label, 2, 5, None, out)
        for bits, all_bits in ((0, 5), (6, 5), (2, 9), (2, 4)):
            with pytest.raises(ValueError, match="expected"):
                page_code.upper_bits(phase, label, bits, all_bits, None, out)
        first, borders, starts, most, order = searches_of(uneven(32), 2)
        assert page_code.upper_bits(phase, label, 2, 5, (first, borders, starts, most, order), out)  # type: ignore[arg-type]
        wrong: list[object] = [(), 0, (first, borders, starts, -1, order), (first, borders, starts + 8, most, order)]  # type: ignore[operator]
        wrong += [(order, borders, starts, most, order), (first, first, starts, most, order)]
        for searches in (*wrong, (first, borders, starts, most, first), (first, borders, first, most, order)):
            with pytest.raises((ValueError, TypeError)):
                page_code.upper_bits(phase, label, 2, 5, searches, out)  # type: ignore[arg-type]
        for number in (-1, len(VARIANTS)):
            with pytest.raises(ValueError, match="variant"):
                page_code.use(number)


def test_it_is_a_module_of_the_stable_interface() -> None:
    assert isinstance(page_code, ModuleType)
    assert ".abi3." in str(page_code.__file__) or str(page_code.__file__).endswith(".pyd")
