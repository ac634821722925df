"""The memory of a process that answers many threads for weeks."""

from __future__ import annotations

from lightpage.allocator import set_options

_ARENA_MAX = -8
"""Number of glibc's option, from its malloc.h."""
_ARENAS = 2


def share_freed_memory() -> bool:
    """Have all threads take memory from two places, so that one uses what another has freed.

    By default the C library keeps up to eight places a core. Each holds on to what was freed in it, so a service with
    many threads grows by that for hours. To be called before threads are started. The value is that of mallopt(3).

    Returns:
        Whether the C library could be told: only glibc can.
    """
    return set_options((_ARENA_MAX, _ARENAS))
