"""A report as one HTML page that asks nobody for anything."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from importlib.resources import files
from typing import Any, TypeVar

from jinja2 import Environment, FunctionLoader, StrictUndefined
from matplotlib import rc_context

from lightpage.report.drawing import STYLE
from lightpage.report.words import number

Data = TypeVar("Data")


def render(template: str, data: Data, shown: Callable[[Data], dict[str, Any]]) -> str:
    """The page, HTML; all text in it that came from files is escaped.

    Args:
        template: name of a file beside this one.
        data: data of the report; the template knows it by this name.
        shown: makes what the template takes besides, pictures among it.
    """
    environment = Environment(
        loader=FunctionLoader(lambda name: files("lightpage.report").joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    with rc_context(STYLE):
        found = shown(data)
    return environment.get_template(template).render(data=data, version=version("lightpage"), **found)
