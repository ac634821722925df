"""Drivers that other packages bring, as entry points: sources, cameras, triggers and modulators."""

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, TypeVar, cast

from lightpage.errors import InvalidInputError, LightpageError

SOURCES, CAMERAS, TRIGGERS, MODULATORS = (
    f"lightpage.{kind}" for kind in ("sources", "cameras", "triggers", "modulators")
)
"""Groups of entry points."""

T = TypeVar("T")


def names_of(group: str) -> list[str]:
    """Return the names of the drivers of a group that are installed."""
    return sorted({point.name for point in entry_points(group=group)})


def driver_of(group: str, name: str, subject: str) -> Callable[..., Any]:
    """Return what opens a thing by a driver.

    Args:
        group: group of entry points.
        name: name of the driver.
        subject: what names it, for an error.

    Raises:
        InvalidInputError: there is none of that name, or it cannot be loaded.
    """
    point = next((point for point in entry_points(group=group) if point.name == name), None)
    if point is None:
        there = ", ".join(names_of(group)) or "none is installed"
        raise InvalidInputError(subject, repr(name), f"an entry point of {group}: {there}")
    try:
        opener: Callable[..., Any] = point.load()
    except Exception as error:  # it is somebody else's code
        raise _failed(subject, name, point.value, error, "a driver that can be loaded") from error
    return opener


def opened_by_driver(group: str, name: str, subject: str, kind: Callable[..., T], *arguments: object) -> T:
    """Return a thing that a driver opens, once it has all that the protocol `kind` names.

    Raises:
        InvalidInputError: see `driver_of`; or the driver fails, or lacks something.
    """
    opener = driver_of(group, name, subject)
    told = f"{getattr(opener, '__module__', '')}:{getattr(opener, '__qualname__', opener)}"
    try:
        made = opener(*arguments)
    except LightpageError:
        raise
    except Exception as error:  # it is somebody else's code
        raise _failed(subject, name, told, error, "a driver that takes these options") from error
    wanted = sorted(each for each in {*vars(kind), *kind.__annotations__} if not each.startswith("_"))
    if lacking := [each for each in wanted if not hasattr(made, each)]:
        got = f"driver {name} ({told}) without {', '.join(lacking)}"
        raise InvalidInputError(subject, got, f"all of {kind.__module__}.{kind.__name__}")
    return cast(T, made)


def _failed(subject: str, name: str, told: str, error: Exception, wanted: str) -> InvalidInputError:
    return InvalidInputError(subject, f"driver {name} ({told}) with {type(error).__name__}: {error}", wanted)
