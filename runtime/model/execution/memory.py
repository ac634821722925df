"""The memory of a process that answers many threads for weeks."""

from collections.abc import Mapping

from lightpage.allocator import set_options

_ARENA_MAX = -8
"""Number of glibc's option, from its malloc.h."""
_ARENAS = 2

SHARED: Mapping[str, str] = {"MALLOC_ARENA_MAX": str(_ARENAS)}
"""Environment of a process that others start, by which glibc does from the first thread on what `share_freed_memory`
asks for."""


def share_freed_memory() -> bool:
    """Have all threads take memory from two places, so that one uses what another has freed.

    By default the C library keeps up to eight places a core. Each holds on to what was freed in it, so a service with
    many threads grows by that for hours. To be called before threads are started. The value is that of mallopt(3).

    Returns:
        Whether the C library could be told: only glibc can.
    """
    return set_options((_ARENA_MAX, _ARENAS))
