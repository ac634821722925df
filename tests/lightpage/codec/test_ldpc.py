"""LDPC blocks: the standard's code bit for bit, and a decoder that loses nothing against independent ones."""

import numpy as np
import pytest
import torch
from ldpc import BpDecoder
from scipy.sparse import csr_matrix
from sionna.phy.fec.ldpc import LDPC5GEncoder

from lightpage.codec.ldpc.code import LdpcCode
from lightpage.codec.ldpc.decoder import MOST_ITERATIONS, MOST_LLR, decode
from tests.lightpage.refused import refused

SIZES = [
    # K, n, Z
    (136, 204, 7),  # the header's: 18 fillers
    (44, 132, 2),  # none: Z = 2, lowest rate
    (66, 70, 3),  # hardly any parity bits: not even those of the four core rows are all sent
    (110, 200, 5),
    (190, 201, 9),
    (242, 600, 11),
    (280, 400, 13),
    (330, 348, 15),
    (1001, 1537, 48),
    (8448, 9000, 384),
]
"""Every family of lifting sizes, with and without fillers, rates from a third to 0.95."""


def random_bits(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, shape, np.uint8)


def parity_checks(code: LdpcCode) -> csr_matrix:
    """H, sparse [checks, bits of the whole word]."""
    columns = np.concatenate([check.T.ravel() for check in code.checks])
    starts = np.cumsum([0, *(len(check) for check in code.checks for _ in range(code.lifting))])
    return csr_matrix((np.ones(len(columns), np.uint8), columns, starts), shape=(len(starts) - 1, code.word_bits))


def noisy(code: LdpcCode, blocks: int, decibel: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Information bits, and the LLRs of their sent bits +-1 in Gaussian noise of Es/N0 in dB."""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2, (blocks, code.information_bits), np.uint8)
    variance = 10 ** (-decibel / 10) / 2
    received = 1 - 2.0 * code.encode(bits) + np.sqrt(variance) * rng.standard_normal((blocks, code.sent_bits))
    return bits, 2 * received / variance


class TestEncoder:
    @pytest.mark.filterwarnings("ignore:Effective coderate")  # above 948 / 1024, which the standard does not schedule
    @pytest.mark.parametrize(("information", "sent", "lifting"), SIZES)
    def test_it_is_sionnas_bit_for_bit(self, information: int, sent: int, lifting: int) -> None:
        code = LdpcCode(information, sent)
        assert code.lifting == lifting
        theirs = LDPC5GEncoder(information, sent, bg="bg1")
        bits = random_bits((3, information))
        expected = theirs(torch.tensor(bits, dtype=torch.float32)).numpy()
        assert np.array_equal(code.encode(bits), expected)

    @pytest.mark.parametrize(("information", "longest"), [(44, 132), (40, 128), (8448, 25344)])
    def test_bits_out_of_range_are_refused(self, information: int, longest: int) -> None:
        assert len(LdpcCode(information, longest).sent) == longest
        assert LdpcCode(information, information + 1).rate < 1
        for sent in (information, longest + 1):
            with refused("sent bits", sent):
                LdpcCode(information, sent)
        for wrong in (0, 8449):
            with refused("information bits", wrong):
                LdpcCode(wrong, 20_000)

    @pytest.mark.parametrize("shape", [(2, 135), (136,), (1, 2, 136)])
    def test_blocks_of_another_length_are_refused(self, shape: tuple[int, ...]) -> None:
        with refused("information", shape):
            LdpcCode(136, 204).encode(np.zeros(shape, np.uint8))


def failures(found: np.ndarray, bits: np.ndarray) -> int:
    """Blocks that are not what was sent."""
    return int(np.count_nonzero((found != bits).any(axis=1)))


def by_ldpc_package(code: LdpcCode, llrs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whole words, and whether they are code words, by the sum-product algorithm of the package `ldpc`."""
    wrong = np.full((len(llrs), code.word_bits), 0.5)
    wrong[:, code.fillers] = 1e-9
    wrong[:, code.sent] = 1 / (1 + np.exp(np.abs(llrs)))
    guess = np.zeros(wrong.shape, np.uint8)
    guess[:, code.sent] = llrs < 0
    decoder = BpDecoder(
        parity_checks(code),
        error_channel=list(wrong[0]),
        max_iter=100,
        bp_method="product_sum",
        input_vector_type="received_vector",
    )
    words, converged = np.empty_like(guess), np.empty(len(llrs), bool)
    for block in range(len(llrs)):
        decoder.update_channel_probs(wrong[block])
        words[block] = decoder.decode(guess[block])
        converged[block] = decoder.converge
    return words, converged


class TestNearTheLimit:
    """Light in which some of the blocks fail."""

    LOSS_DB = 0.2
    """Largest loss of offset min-sum against the sum-product algorithm. Measured on 600 blocks: at most 0.12 dB."""
    BLOCKS = 60

    @pytest.mark.parametrize(("information", "sent", "decibel"), [(136, 204, 0.6), (440, 500, 2.9), (330, 960, -4.0)])
    def test_it_agrees_with_the_ldpc_package(self, information: int, sent: int, decibel: float) -> None:
        code = LdpcCode(information, sent)
        bits, llrs = noisy(code, self.BLOCKS, decibel, 1)
        ours = decode(code, llrs, iterations=100)
        words, converged = by_ldpc_package(code, llrs)
        both = ours.converged & converged
        assert np.array_equal(ours.information[both], words[both, :information])
        assert np.array_equal(ours.sent[both], words[both][:, code.sent])
        wrong = failures(ours.information, bits)
        assert 0 < wrong < 0.6 * self.BLOCKS  # neither all nor none fail: else the comparison says nothing
        assert failures(ours.information[both], bits[both]) <= 3
        # the same noise in light that is weaker by what this algorithm may cost
        _, weaker = noisy(code, self.BLOCKS, decibel - self.LOSS_DB, 1)
        assert wrong <= failures(by_ldpc_package(code, weaker)[0][:, :information], bits)


class TestDecoder:
    CODE = LdpcCode(136, 204)

    @pytest.mark.parametrize(("information", "sent"), [(136, 204), (66, 70), (44, 132)])
    def test_it_stops_at_once_where_all_is_clear(self, information: int, sent: int) -> None:
        code = LdpcCode(information, sent)
        bits = random_bits((5, information))
        words = code.encode(bits)
        found = decode(code, 20.0 * (1 - 2.0 * words))
        assert found.converged.all()
        assert found.iterations.max() <= 2  # the first fills in the punctured bits, which each check lacks
        assert np.array_equal(found.information, bits)
        assert np.array_equal(found.sent, words)
        assert found.information.dtype == found.sent.dtype == np.uint8

    def test_blocks_that_fail_are_flagged_and_do_not_disturb_the_others(self) -> None:
        bits, llrs = noisy(self.CODE, 40, 2.0, 3)
        alone = decode(self.CODE, llrs)
        spoilt = llrs.copy()
        lost = np.arange(40) % 3 == 1
        spoilt[lost] = np.random.default_rng(4).choice([-MOST_LLR, MOST_LLR], (np.count_nonzero(lost), 204))
        found = decode(self.CODE, spoilt)
        assert not found.converged[lost].any()
        assert (found.iterations[lost] == MOST_ITERATIONS).all()
        assert np.array_equal(found.information[~lost], alone.information[~lost])
        assert np.count_nonzero(found.converged) > 20
        assert np.array_equal(found.information[found.converged], bits[found.converged])

    def test_the_result_does_not_depend_on_the_batch(self) -> None:
        _, llrs = noisy(self.CODE, 37, 0.8, 5)
        whole, single = decode(self.CODE, llrs), [decode(self.CODE, llrs[i : i + 1]) for i in range(37)]
        assert 0 < np.count_nonzero(whole.converged) < 37
        for name in ("information", "sent", "converged", "iterations"):
            assert np.array_equal(np.concatenate([getattr(one, name) for one in single]), getattr(whole, name))

    def test_converged_means_that_every_check_holds(self) -> None:
        _, llrs = noisy(self.CODE, 60, 0.3, 7)
        found = decode(self.CODE, llrs)
        encoded = self.CODE.encode(found.information)
        assert np.array_equal((encoded == found.sent).all(axis=1), found.converged)
        assert 0 < np.count_nonzero(found.converged) < 60
        assert decode(self.CODE, llrs, iterations=3).iterations.max() == 3

    def test_nan_and_other_shapes_are_refused(self) -> None:
        llrs = np.ones((3, 204))
        llrs[1, 7] = np.nan
        with refused("LLRs", "NaN"):
            decode(self.CODE, llrs)
        for shape in ((204,), (3, 203), (1, 3, 204)):
            with refused("LLRs", shape):
                decode(self.CODE, np.ones(shape))
