"""The memory of work that takes and gives back large arrays all the time."""

from __future__ import annotations

from lightpage.allocator import set_options

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4
"""Numbers of glibc's options, from its malloc.h."""
_TAKEN_AT_ONCE = 1 << 28


def keep_freed_memory() -> bool:
    """Have this process keep the memory that it frees for its next arrays, and take it 256 MiB at a time.

    Otherwise the C library gives every large array back to the system, which hands it out again page by page, each
    filled with zeros. The peak of what a process holds grows by what lies free between arrays. For commands, which
    end: a service would never give back what its largest request took. Values are those of mallopt(3).

    Returns:
        Whether the C library could be told: only glibc can.
    """
    return set_options((_TRIM_THRESHOLD, -1), (_TOP_PAD, _TAKEN_AT_ONCE), (_MMAP_MAX, 0))
