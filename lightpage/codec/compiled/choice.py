"""Choice between the page code's compiled arithmetic and numpy's, and the spread of its work over threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from types import ModuleType

from lightpage.errors import InvalidInputError

VARIABLE = "LIGHTPAGE_PAGE_CODE"
"""Environment variable: `numpy` or `compiled`; by default what there is, the compiled one first."""
NUMPY, COMPILED = "numpy", "compiled"


@lru_cache(1)
def _found() -> tuple[ModuleType | None, str]:
    """The compiled module, or why there is none."""
    try:
        from lightpage.codec.compiled import page_code
    except ImportError as error:
        return None, str(error)
    return page_code, ""


def compiled() -> ModuleType | None:
    """The compiled arithmetic where it is to be used, None where numpy's is.

    Raises:
        InvalidInputError: the variable says neither, or asks for the compiled one where there is none.
    """
    wanted, (module, why) = os.environ.get(VARIABLE, ""), _found()
    if wanted == NUMPY:
        return None
    if wanted not in ("", COMPILED):
        raise InvalidInputError(VARIABLE, repr(wanted), f"{NUMPY} or {COMPILED}")
    if module is None and wanted == COMPILED:
        raise InvalidInputError(VARIABLE, f"{COMPILED}, which is not installed ({why})", f"{NUMPY}, or no value")
    return module


def in_use() -> str:
    """The arithmetic in use, for people, e.g. `compiled (avx2)`.

    Raises:
        InvalidInputError: see `compiled`.
    """
    module = compiled()
    return NUMPY if module is None else f"{COMPILED} ({module.variants()[-1]})"


@lru_cache(4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="page-code")


def spread(work: Callable[[slice], None], count: int, threads: int) -> None:
    """Do work on `count` things, a share of them in each of some threads."""
    shares = min(threads, count)
    if shares <= 1:
        work(slice(0, count))
        return
    parts = [slice(count * i // shares, count * (i + 1) // shares) for i in range(shares)]
    others = [_pool(threads).submit(work, part) for part in parts[1:]]
    work(parts[0])
    for other in others:
        other.result()
