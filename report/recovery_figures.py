"""The figures of the report of a recovery: margin and failed codewords, page by page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lightpage.codec.page_bytes import Loss
from lightpage.report.contents.from_recovery import UNDECODED, PageResult, RecoveryData
from lightpage.report.drawing import BLUE, GREY, ORANGE, Picture, as_picture, one_axis
from lightpage.report.words import number

TEMPLATE = "recovery.html.j2"

_MARKERS = {Loss.OPTICS: "x", Loss.HEADER: "^", Loss.CODE: "s", Loss.BODY: "v", Loss.CHECKSUM: "D"}
_LOST_STYLE: dict[str, Any] = {"linestyle": "none", "color": ORANGE, "fillstyle": "none", "markersize": 6}
_MOST_LINES = 2000
"""Pages that are drawn as lines; more are drawn as an image, which does not grow with them."""
_EDGE = 0.03
"""Share of the height at which pages without a margin are marked."""


def shown(data: RecoveryData) -> dict[str, Any]:
    """The pictures, as the template takes them."""
    if not data.pages:
        return {"pictures": []}
    pictures = [margins(data.pages)]
    if any(page.failed_blocks or page.loss in UNDECODED for page in data.pages):
        pictures.append(failed_codewords(data.pages, data.blocks_per_page))
    return {"pictures": pictures}


def margins(pages: Sequence[PageResult]) -> Picture:
    """Margin over the recorded pages; those that gave no bytes are marked with their cause."""
    figure, axis = one_axis()
    axis.axhline(0, color=GREY, linestyle="dashed", linewidth=1, label="what the code needs")
    known = [page for page in pages if page.loss is None and page.margin_bits is not None]
    axis.plot(*_margins(known), "o", color=BLUE, markersize=3, label=f"read ({len(known):,})")
    for loss, marker in _MARKERS.items():
        if not (lost := [page for page in pages if page.loss is loss]):
            continue
        axis.plot(*_margins(lost), marker=marker, label=f"{loss} ({len(lost):,})", **_LOST_STYLE)
        dark = [page.page for page in lost if page.margin_bits is None]
        axis.plot(dark, [_EDGE] * len(dark), marker=marker, transform=axis.get_xaxis_transform(), **_LOST_STYLE)
    if any(page.margin_bits is None for page in pages):
        edge = axis.get_xaxis_transform()
        axis.fill_between(_span(pages), 0, 2 * _EDGE, transform=edge, color=GREY, alpha=0.15, label="margin unknown")
    if all(page.margin_bits is None for page in pages):
        axis.set_ylim(-1, 1)
    axis.margins(y=4 * _EDGE)
    axis.set(ylabel="margin, bit/symbol")
    least = min((page.margin_bits for page in known if page.margin_bits is not None), default=None)
    told = "no page was read" if least is None else f"at least {number(least, 3)} bit/symbol where a page was read"
    caption = (
        "Margin: what a page carries beyond what its code needs. Below the dashed line the code is expected to fail. "
        "Orange: pages that gave no bytes, by cause, with the margin that they claim themselves."
    )
    return _over_pages(figure, axis, f"Margin over the recorded pages, {told}.", caption, pages)


def _margins(pages: Sequence[PageResult]) -> tuple[list[int], list[float]]:
    return [p.page for p in pages], [math.nan if p.margin_bits is None else p.margin_bits for p in pages]


def failed_codewords(pages: Sequence[PageResult], blocks: int) -> Picture:
    """LDPC blocks that did not converge over the recorded pages, each of which holds `blocks`."""
    figure, axis = one_axis()
    decoded = [page for page in pages if page.loss not in UNDECODED]
    read = [page for page in decoded if page.loss is None]
    for name, colour, some in (
        ("page read all the same", BLUE, read),
        ("page lost", ORANGE, [page for page in decoded if page.loss is not None]),
    ):
        if not (failed := [page for page in some if page.failed_blocks]):
            continue
        numbers, counts = [page.page for page in failed], [page.failed_blocks for page in failed]
        axis.vlines(numbers, 0, counts, color=colour, linewidth=1.5)
        axis.plot(numbers, counts, "o", color=colour, markersize=3, label=f"{name} ({len(failed):,})")
    if skipped := [page.page for page in pages if page.loss in UNDECODED]:
        axis.plot(skipped, [0] * len(skipped), "x", color=GREY, clip_on=False, label=f"not decoded ({len(skipped):,})")
    axis.set(ylabel="failed codewords", ylim=(0, 1.05 * blocks))
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    failures, whole = sum(page.failed_blocks for page in decoded), blocks * len(decoded)
    caption = (
        f"Codewords (LDPC blocks) that did not converge: {failures:,} of {whole:,}, {blocks:,} a page. Reed-Solomon "
        "may mend such a page. Grey: pages whose codewords were not decoded, for cause optics or code."
    )
    alt = f"Failed codewords over the recorded pages, {failures:,} of {whole:,}."
    return _over_pages(figure, axis, alt, caption, pages)


def _span(pages: Sequence[PageResult]) -> tuple[float, float]:
    numbers = [page.page for page in pages]
    return min(numbers) - 0.5, max(numbers) + 0.5


def _over_pages(figure: Figure, axis: Axes, alt: str, caption: str, pages: Sequence[PageResult]) -> Picture:
    axis.set(xlabel="recorded page", xlim=_span(pages))
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(frameon=False, loc="outside upper center", ncols=3, fontsize=8)
    return as_picture(figure, alt, caption, image=len(pages) > _MOST_LINES)
