"""Tables that `analysis.tracking.image_search` prints."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

Rows = Sequence[dict[str, Any]]


def tell_offsets(name: str, rows: Rows, offsets_px: Sequence[float], expected: float) -> str:
    """First pages whose image is off, by offset and reference; `expected` is a share of tracked AIR."""
    head = f"{'px':>5} {'reference':>10} {'found':>8} {f'>= {expected:.0%}':>8} {'worst':>7} {'then':>7} {'more s':>7}"
    lines = [f"{name}: image off at the first page; then the same page again by the same decoder", head]
    for offset in offsets_px:
        for stays in (False, True):
            here = [row for row in rows if row["offset_px"] == offset and row["reference_stays"] == stays]
            shares = [row["share_of_tracked"] for row in here]
            found, good = sum(row.get("found", False) for row in here), sum(share >= expected for share in shares)
            lines.append(
                f"{offset:>5g} {'stays' if stays else 'moves':>10} {found:>5}/{len(here):<2} {good:>5}/{len(here):<2} "
                f"{min(shares):>7.3f} {min(row['next_share'] for row in here):>7.3f} "
                f"{median(row['extra_seconds'] for row in here):>7.2f}"
            )
    return "\n".join([*lines, ""])


def tell_apart(name: str, rows: Rows, offsets_px: Sequence[float]) -> str:
    """First pages where one camera alone has moved."""
    head = f"{'px':>5} {'given out':>10} {'median AIR share':>17} {'worst':>7}"
    lines = [f"{name}: the quadrature camera alone off", head]
    for offset in offsets_px:
        here = [row for row in rows if row["offset_px"] == offset]
        shares = [row["share_of_tracked"] for row in here]
        given = sum("lost" not in row for row in here)
        lines.append(f"{offset:>5g} {given:>7}/{len(here):<2} {median(shares):>17.3f} {min(shares):>7.3f}")
    return "\n".join([*lines, ""])


def tell_walk(name: str, figures: dict[str, Any]) -> str:
    """A walk, first page to last."""
    far = max(max(map(abs, row["place_px"])) for row in figures["rows"])
    return (
        f"{name}, {len(figures['rows'])} pages, up to {far:.1f} px: first page {figures['first']:.3f} bits, "
        f"last ten {figures['last_share']:.3f} of it, worst page {figures['worst_share']:.3f}"
    )


def tell_wrong(name: str, kinds: dict[str, dict[str, int]]) -> str:
    """Pages that must not be given out."""
    head = f"{'kind':<28} {'pages':>6} {'found':>6} {'given out':>10} {'frames refused':>15} {'unconfirmed':>12}"
    lines = [f"\n{name}: pages that are not this device's", head]
    lines += [
        f"{kind:<28} {row['pages']:>6} {row['found']:>6} {row['given_out']:>10} {row['frames_refused']:>15} "
        f"{row['unconfirmed']:>12}"
        for kind, row in kinds.items()
    ]
    return "\n".join([*lines, ""])


def tell_sound(name: str, figures: dict[str, Any]) -> str:
    """False alarms on a device as it is."""
    shares = figures["shares"]
    return (
        f"{name}: of {figures['pages']} sound pages {figures['unconfirmed']} unconfirmed, "
        f"{figures['recalibration_due']} with a recalibration due; they confirm {min(shares):.3f} to "
        f"{max(shares):.3f} of what is claimed"
    )


def tell_speed(name: str, seconds: dict[str, float]) -> str:
    """Medians of one run, and over the decoder alone."""
    alone = seconds["decoder alone"]
    return f"{name}: " + ", ".join(f"{way} {1e3 * s:.0f} ms ({s / alone:.2f})" for way, s in seconds.items()) + "\n"


def tell_full_size(rows: Rows) -> str:
    """The search at full size."""
    return (
        f"full size: {sum(row['found'] for row in rows)} of {len(rows)} found within "
        f"{max(row['error_px'] for row in rows):.3f} px; field {median(row['field_seconds'] for row in rows):.1f} s, "
        f"search {median(row['search_seconds'] for row in rows):.1f} s"
    )


def tell_gaps(name: str, figures: dict[str, Any]) -> str:
    """Format the results of another device's pages, read in order and each after a gap."""
    order, alone = figures["in_order"], [row["air"] for row in figures["after_a_gap"]]
    return (
        f"{name}: in order {min(order):.3f} to {max(order):.3f} bits, each page by a decoder just started "
        f"{min(alone):.3f} to {max(alone):.3f}"
    )
