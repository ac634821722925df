"""Chooses a page's code from pages whose data are known: the levels, the rate and the corrections that carry most.

A page of any level count is drawn from a known one: the decoder's phase errors and concentrations stay, the symbols are
new. That holds because the channel does not depend on the phase that is sent. What counts is how pages differ: the rate
is the one that the weakest page of a thousand still carries, as far as the pages that were seen can say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import nct, poisson

from lightpage.codec.code import Code
from lightpage.codec.ldpc.code import LdpcCode
from lightpage.codec.ldpc.decoder import decode
from lightpage.codec.mapping import bit_information, bit_llrs, decide_in_coset, labels, level_bits
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import InvalidInputError
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS, Levels

FEWEST_PAGES = 3
"""Fewer say nothing of how pages differ."""

HEADROOM = 0.0075
"""Share of what a symbol carries that is kept for drift, so that it is noticed before pages are lost."""

_QUANTILE = 3.0902
"""Standard deviations below the mean of the page that one of a thousand falls short of."""
_CONFIDENCE = 0.95
"""Share of cases in which the pages that were seen say no more than they know: a one-sided tolerance bound."""
_RATE_STEP = 2
"""Thousandths."""
_MOST_BITS = MAX_LEVELS.bit_length() - 1
_CODED_BITS = 2
"""Label bits of a level that the inner code protects, where the level has so many: the rest lies in the coset. It
protects more where wrong upper numbers are more than Reed-Solomon mends."""
_CORRECTIONS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_PAGE_LOSS = 1e-3
"""Share of pages whose upper bits Reed-Solomon does not mend: small beside the loss that the rate allows."""
_UNSEEN = 3.0
"""Errors that may have been there where so many pages show none, with 95% confidence."""
_SPREAD = 2
"""Reed-Solomon symbols over which an upper number may spread."""
_BISECTIONS = 7
_LOWEST_RATE, _HIGHEST_RATE = 340, 960
_LOWEST_RATE_OF_TWO_LEVELS = 460
"""Lowest rate, per mille, where a symbol has one bit: the header's code is no better than the body's would be below."""
_FIRST_GAP, _MOST_TRIED = 0.04, 30
"""Information beyond the rate that a code is first thought to need; rates that are tried."""
_DRAWS = 3
"""Code words drawn for each page when a choice is checked."""


@dataclass(frozen=True)
class DrawnPage:
    """A page with drawn symbols.

    Attributes:
        phase: decoded, radians, of the data symbols, [symbols].
        concentration: kappa, [symbols].
        symbols: symbols that were drawn.
        levels: levels that they were drawn from.
    """

    phase: NDArray[np.float64]
    concentration: NDArray[np.float64]
    symbols: NDArray[np.uint8]
    levels: Levels


Draw = Callable[[int, np.random.Generator], Sequence[DrawnPage]]
"""Draws every known page anew, at so many levels."""


class Drift(NamedTuple):
    """Pages as they are read before and after a drift of the device."""

    before: Draw
    after: Draw


@dataclass(frozen=True)
class Choice:
    """A code with what was found of it.

    Attributes:
        code: parameters of the code.
        user_bytes: user bytes of a page.
        information: mean information of a coded bit.
        deviation: standard deviation of the information from page to page; of pages that do not show it, the one that
            their margin allows for.
        upper_errors: mean wrong upper numbers of a page.
        kept: information of a coded bit that was to be kept for drift.
        spare: information that the weakest page of a thousand carries beyond the need: `kept`, and what steps of the
            rate leave.
    """

    code: Code
    user_bytes: int
    information: float
    deviation: float
    upper_errors: float
    kept: float
    spare: float

    def line(self) -> str:
        """The choice for people."""
        return (
            f"{self.code.levels:>6} {self.information:>9.4f} {self.deviation:>9.4f} "
            f"{self.code.needed_information:>9.4f} {self.code.rate_per_mille / 1000:>7.3f} "
            f"{self.upper_errors:>9.3f} {self.code.corrections:>6} {self.user_bytes:>9}"
        )


HEADER = (
    f"{'levels':>6} {'carried':>9} {'deviation':>9} {'needed':>9} {'rate':>7} {'errors':>9} {'mended':>6} {'bytes':>9}"
)
"""Information of a coded bit that pages carry, its deviation from page to page, what the code needs; rate; errors that
are left on a page, and those that a Reed-Solomon word mends; user bytes of a page."""


def choose(
    draw: Draw,
    air_bits: float,
    pilots: NDArray[np.bool_],
    headroom: float = HEADROOM,
    seed: int = 0,
    drift: Drift | None = None,
    margin: float | None = None,
) -> tuple[Choice, list[Choice]]:
    """The code that carries most, and the best of each level count.

    Args:
        draw: draws the known pages.
        air_bits: information of a symbol, bits: level counts near it are tried, and fewer levels where none carries.
        pilots: bool [ny, nx].
        headroom: share of what a symbol carries that is kept for drift.
        seed: seed of the draws.
        drift: drift that pages are to survive, where it costs more than that share.
        margin: share of a page's information that the weakest page may lack. It is used when there are too few pages to
            measure their spread; None otherwise.

    Raises:
        InvalidInputError: too few pages to show it, or no code carries a page.
    """
    tried: list[Choice] = []
    near = range(max(1, int(air_bits) - 1), min(_MOST_BITS, int(np.ceil(air_bits)) + 1) + 1)
    count = 0
    for bits in [*near, *range(near.start - 1, 0, -1)]:
        if tried and bits < near.start:
            break
        rng = np.random.default_rng([seed, bits])
        pages = draw(1 << bits, rng)
        count = len(pages)
        if count < FEWEST_PAGES and margin is None:
            raise InvalidInputError("pages to choose a code by", count, f"at least {FEWEST_PAGES}")
        choice = _best_of(draw, pages, 1 << bits, pilots, headroom * air_bits, rng, drift, margin)
        if choice is not None:
            tried.append(choice)
    if not tried:
        raise InvalidInputError(
            "pages to choose a code by",
            f"{count} that carry {air_bits:.2f} bits a symbol",
            "pages that some code carries: more of them, or a decoder that reads them better",
        )
    return max(tried, key=lambda choice: choice.user_bytes), tried


def _best_of(
    draw: Draw,
    pages: Sequence[DrawnPage],
    levels: int,
    pilots: NDArray[np.bool_],
    kept_bits: float,
    rng: np.random.Generator,
    drift: Drift | None,
    margin: float | None,
) -> Choice | None:
    """The best code of a level count that leaves `kept_bits` of a symbol, or what a drift costs, whichever is more.

    Returns:
        None where no code carries the pages.
    """
    bits = level_bits(levels)
    for coded in range(min(_CODED_BITS, bits), bits + 1):
        seen = [_information(page, coded) for page in pages]
        information, wrong = np.array([each[0] for each in seen]), np.array([each[1] for each in seen])
        lost, more = (0.0, 0.0) if drift is None else _drift_costs(drift, levels, coded)
        corrections = _corrections(_SPREAD * max((float(wrong.sum()) + _UNSEEN) / len(wrong), more))
        if corrections is not None:
            break
    else:
        return None
    mean = float(information.mean())
    if margin is None:
        deviation = float(information.std(ddof=1))
        below = tolerance_factor(len(pages)) * deviation
    else:
        below = margin * mean
        deviation = below / _QUANTILE
    kept = max(kept_bits / coded, lost)
    weakest = mean - below - kept
    lowest = _LOWEST_RATE_OF_TWO_LEVELS if levels == MIN_LEVELS else _LOWEST_RATE
    rate, tried = min(_HIGHEST_RATE, _stepped(weakest - _FIRST_GAP)), 0
    while True:  # the gap to the code's limit changes little with the rate
        tried += 1
        if rate < lowest or tried > _MOST_TRIED:
            return None
        code = Code(levels=levels, coded_bits=coded, rate_per_mille=rate, corrections=corrections)
        needed = needed_information(PageCodec(code, pilots).ldpc, pages, coded, rng)
        if needed > weakest:
            rate = min(rate - _RATE_STEP, _stepped(weakest - (needed - rate / 1000)))
            continue
        code = Code(**{**code.model_dump(), "needed_information": needed})
        if all(_all_decode(each, code, pilots, rng) for each in (draw, *([drift.after] if drift else []))):
            break
        rate -= 2 * _RATE_STEP
    user_bytes = PageCodec(code, pilots).user_bytes
    spare = weakest + kept - needed
    return Choice(code, user_bytes, mean, deviation, float(wrong.mean()), kept, spare)


def survives(choice: Choice, drift: Drift, pilots: NDArray[np.bool_]) -> tuple[bool, float]:
    """Estimate whether the weakest page of a thousand is still read after a drift, and what the drift costs.

    Few pages are drawn for it. The cost is information of a coded bit, of which `Choice.spare` may be lost.
    """
    code = choice.code
    cost, wrong = _drift_costs(drift, code.levels, code.coded_bits)
    mended = poisson.sf(code.corrections, _SPREAD * wrong) <= _PAGE_LOSS
    read = cost <= choice.spare and mended and _all_decode(drift.after, code, pilots, np.random.default_rng(0))
    return bool(read), cost


def bytes_without_headroom(choice: Choice, pilots: NDArray[np.bool_]) -> int:
    """User bytes of a page, about, if nothing were kept for drift: the gap to a code's limit changes little."""
    rate = min(_HIGHEST_RATE, choice.code.rate_per_mille + _stepped(choice.kept))
    return PageCodec(choice.code.model_copy(update={"rate_per_mille": rate}), pilots).user_bytes


def _drift_costs(drift: Drift, levels: int, coded: int) -> tuple[float, float]:
    """Information of a coded bit that a drift costs, and how many upper numbers of a page are wrong after it."""
    before, after = (
        np.mean([_information(page, coded) for page in draw(levels, np.random.default_rng(levels))], axis=0)
        for draw in drift  # the same symbols: what is left is the drift
    )
    return float(before[0] - after[0]), float(after[1])


def tolerance_factor(count: int) -> float:
    """Standard deviations below the mean of `count` pages above which all but one page of a thousand lie.

    The factor of a one-sided tolerance interval of a normal distribution, by the noncentral t distribution.
    """
    root = np.sqrt(count)
    return float(nct.ppf(_CONFIDENCE, count - 1, _QUANTILE * root) / root)


def _stepped(information: float) -> int:
    """The highest rate of the grid that is no more than some information, thousandths."""
    return int(1000 * information / _RATE_STEP) * _RATE_STEP


def _label_bits(symbols: NDArray[np.uint8], coded: int) -> NDArray[np.uint8]:
    """Label bits of symbols, [symbols, b]."""
    coset = symbols.astype(np.int64) % (1 << coded)
    return np.asarray(labels(coded)[coset][:, None] >> np.arange(coded) & 1, np.uint8)


def _information(page: DrawnPage, coded: int) -> tuple[float, int]:
    """Information of a coded bit of a page, and how many of its symbols' upper numbers are decided wrongly."""
    label = _label_bits(page.symbols, coded)
    llrs = bit_llrs(page.phase, page.concentration, page.levels, coded)
    wrong = decide_in_coset(page.phase, label, page.levels) != page.symbols >> coded
    return bit_information(llrs, label), int(np.count_nonzero(wrong))


def _corrections(expected: float) -> int | None:
    """Corrections that a page of so many errors needs; None where no word has so many."""
    # a word of a large page has only its share of them; counting all of them is on the safe side
    return next((t for t in _CORRECTIONS if poisson.sf(t, expected) <= _PAGE_LOSS), None)


def _blocks(
    pages: Sequence[DrawnPage], code: LdpcCode, coded: int, noise: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], float]:
    """LLRs of the zero word in the light of pages with more noise, [blocks, n], and their information.

    The bits' LLRs are taken with the sign that says they are right: the decoder is as good for one word as for another.
    """
    ratios = []
    for page in pages:
        worse = page.phase + noise * rng.standard_normal(page.phase.shape) / np.sqrt(
            np.maximum(page.concentration, 1.0)
        )
        label = _label_bits(page.symbols, coded)
        llrs = bit_llrs(worse, page.concentration / (1 + noise**2), page.levels, coded)
        right = np.where(label == 0, llrs, -llrs).ravel()
        whole = len(right) // code.sent_bits * code.sent_bits
        ratios.append(rng.permutation(right)[:whole].reshape(-1, code.sent_bits))
    blocks = np.concatenate(ratios).astype(np.float32)
    return blocks, bit_information(blocks, np.zeros(blocks.shape, np.uint8))


def needed_information(code: LdpcCode, pages: Sequence[DrawnPage], coded: int, rng: np.random.Generator) -> float:
    """Information per bit from which nearly all blocks decode: the pages' light is made noisier until 2% of them fail.

    Args:
        code: code of the blocks.
        pages: pages with their light.
        coded: b.
        rng: generator of noise.
    """
    low, high = 0.0, 3.0
    needed = 1.0
    for _ in range(_BISECTIONS):
        noise = (low + high) / 2
        blocks, information = _blocks(pages, code, coded, noise, rng)
        if np.mean(~decode(code, blocks).converged) <= 0.02:
            low, needed = noise, information
        else:
            high = noise
    return needed


def _all_decode(draw: Draw, code: Code, pilots: NDArray[np.bool_], rng: np.random.Generator) -> bool:
    """Return whether every page decodes, in each of several draws."""
    ldpc = PageCodec(code, pilots).ldpc
    return all(
        decode(ldpc, _blocks(draw(code.levels, rng), ldpc, code.coded_bits, 0.0, rng)[0]).converged.all()
        for _ in range(_DRAWS)
    )
