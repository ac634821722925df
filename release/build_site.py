"""Builds the site of the pages in docs/, with a reference that is made of the code, into build/site.

    python release/build_site.py

What the code lists is written here and kept nowhere else: commands with their options, settings, metrics, alerts, keys
of profiles and of camera files, calls of the service, and names of the Python package. A broken link ends the build.
"""

from __future__ import annotations

import ast
import base64
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any, get_origin

import click
import griffe
import yaml
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from grpc_tools import protoc
from pydantic import BaseModel

from lightpage import _HOMES, errors
from lightpage.cli.main import lightpage as program
from lightpage.device.problems import tables_in, tag_of
from lightpage.device.profile_keys import default_of, key_table, wanted
from lightpage.errors import LightpageError
from lightpage.runtime.device.acquisition.camera_config import DeviceTable
from lightpage.runtime.service.settings import TABLES

ROOT = Path(__file__).resolve().parents[1]
DOCS, PAGES, SITE = ROOT / "docs", ROOT / "build" / "pages", ROOT / "build" / "site"
MADE = "<!-- Made of the code by release/build_site.py. -->\n\n"
CITATION = "CITATION.cff"
TOP = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md"}
"""Pages at the top of the repository, and what they are called in the site."""
_RUNTIME = "lightpage.runtime."
PARTS = {
    "Parts of the client": {
        "client.frames": "FramesClient",
        "client.pages": "PagesClient",
        "client.display": "DisplayClient",
        "client.jobs": "JobsClient",
        "client.models": "ModelsClient",
        "client.shared_memory": "SharedMemory",
    },
    "What they take and return": {
        "client.outgoing": "PageOptions FrameOptions KnownPilots",
        "client.jobs": "RecalibrationOptions",
        "client.answers": "RemotePage RemoteFrame RemoteTimings RemoteData Description ServiceLimits ModelInfo "
        "ModelOrigin JobInfo JobState Recalibrated DisplayOrder",
    },
    "Interfaces of drivers": {
        "device.cameras.camera": "Camera Frame BrokenFrame",
        "device.trigger.trigger": "Trigger",
        "device.modulator.modulator": "Modulator",
        "device.acquisition.source": "FrameSource Shot",
        "device.acquisition.page_store": "PageStore",
        "lightpage.recording.layout": "FrameInfo",
        "lightpage.recording.pixels.black_level": "DarkFrame",
    },
}
"""Chapters behind the public names on the page of Python: names by module, of `lightpage.runtime` if not said."""
ARGUMENTS = {
    "out": "Folder of the run; the same command continues it.",
    "encode file": "File to put on pages; - is stdin.",
    "inspect file": "File to look at: frames, a recording, pages, a profile, a calibration or a bundle.",
    "run": "Folder that `lightpage train --out` wrote.",
    "version": "Version of the model, as `lightpage models list` has it.",
    "bundle": "Bundle to give to the service, a .zip.",
    "name": "Shipped name or TOML file of the profile.",
    "source": "Folder of a training or bulk run, or what a command wrote by --json.",
    "study name": "Study to run.",
    "recording": "Recording to write as other files.",
    "command": "Command to run beside the device, behind --, with its arguments.",
}
"""Meaning of each argument without a name, of which click keeps none, by its parameter, or by command and parameter."""
METRICS = {"counter", "gauge", "histogram"}
"""Kinds of metrics, as functions and classes that make them are called, `MetricFamily` at the end left out."""


def commands() -> str:
    """Return every command with its arguments and options."""
    return "# Commands\n\n" + "\n".join(_command(program, "lightpage"))


def _command(command: click.Command, path: str) -> Iterator[str]:
    context = click.Context(command, info_name=path)
    usage = " ".join([path, *command.collect_usage_pieces(context)])
    yield f"## {path}\n\n```\n{usage}\n```\n\n{_paragraphs(command.help or '')}\n"
    left_out = [one for one in command.params if getattr(one, "hidden", False)]
    yield _options([one for one in command.params if one not in left_out], context)
    if left_out:
        yield "`--help` leaves out these options, which another one sets:\n"
        yield _options([_shown(one) for one in left_out], context)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            if (inner := command.get_command(context, name)) is not None and not inner.hidden:
                yield from _command(inner, f"{path} {name}")


def _options(params: Sequence[click.Parameter], context: click.Context) -> str:
    records = [record for one in params if (record := _argument(one, context) or one.get_help_record(context))]
    return _table(("option", "meaning"), [(f"`{name}`", text) for name, text in records]) if records else ""


def _argument(one: click.Parameter, context: click.Context) -> tuple[str, str] | None:
    """Return an argument and its meaning, None of an option; raises KeyError where `ARGUMENTS` lacks it."""
    if not isinstance(one, click.Argument):
        return None
    key = f"{context.command.name} {one.name}"
    return one.make_metavar(context), ARGUMENTS[key if key in ARGUMENTS else str(one.name)]


def _shown(one: click.Parameter) -> click.Parameter:
    shown = copy(one)
    shown.hidden = False  # type: ignore[attr-defined]  # an option has it
    return shown


def settings() -> str:
    """Return every key of the service's settings."""
    parts = [
        "# Settings of the service\n\nEach key `table.key` of the TOML file is also the variable "
        "`LIGHTPAGE_<TABLE>__<KEY>`. [Serving](../guides/serving.md) says which one counts.\n"
    ]
    parts += [f"## [{name}]\n\n{_first_paragraph(model)}\n\n{_keys(model)}" for name, model in TABLES.items()]
    return "\n".join(parts)


def camera_keys() -> str:
    """Return every key of the file behind `camera:CONFIG.toml`."""
    tables = dict[type[BaseModel], list[str]]()
    waiting: list[tuple[str, type[BaseModel]]] = [("", DeviceTable)]
    while waiting:
        name, model = waiting.pop(0)
        tables.setdefault(model, []).append(name)
        for key, field in model.model_fields.items() if len(tables[model]) == 1 else ():
            waiting += [(f"{name}.{key}" if name else key, inner) for inner in tables_in(field.annotation)]
    return "# Keys of a camera file\n\n" + "\n".join(_camera_table(*each) for each in tables.items())


def _camera_table(model: type[BaseModel], names: list[str]) -> str:
    of_kind = f", kind = {kind}" if (kind := tag_of(model)) else ""
    heading = f"{' and '.join(f'[{name}]' for name in names)}{of_kind}" if names[0] else "The file"
    return f"## {heading}\n\n{_first_paragraph(model)}\n\n{_keys(model)}"


def profile_keys() -> str:
    """Return every key of a profile."""
    return f"# Keys of a profile\n\n`lightpage profile keys` prints this table.\n\n{key_table()}"


def metrics() -> str:
    """Return every metric that the code names, with its labels."""
    rows = [
        (f"<code>{name.replace('_', '_<wbr>')}</code>", kind, ", ".join(f"`{label}`" for label in labels), text)
        for path in sorted((ROOT / "lightpage" / "runtime").rglob("*metrics.py"))
        for name, kind, labels, text in _metrics_of(path)
    ]
    table = _table(("name", "type", "labels", "meaning"), sorted(rows))
    told = (
        "Gauges of the last page show the device: where the service has a source, frames of callers' own sessions "
        "do not set them, nor do lost pages that came with a caller's own pilots. Without a source there is no "
        "`lightpage_source_ok`, without TLS no `lightpage_certificate_ends_seconds`. Counters of reasons begin at "
        "0. The process of a recalibration is not counted. Metrics of `lightpage bulk` also have the labels `run` and "
        "`part`."
    )
    return f"# Metrics\n\n{told}\n\n{table}"


def alerts() -> str:
    """Return every alert that the service comes with, with its severity, what it means and what to do."""
    (group,) = yaml.safe_load((ROOT / "deploy" / "prometheus" / "rules.yml").read_text("utf-8"))["groups"]
    rows = [
        (f"`{rule['alert']}`", rule["labels"]["severity"], rule.get("for", ""), rule["annotations"]["description"])
        for rule in group["rules"]
    ]
    told = "`deploy/prometheus/rules.yml` has the expressions, with reasons for their thresholds."
    return f"# Alerts\n\n{told}\n\n{_table(('alert', 'severity', 'after', 'meaning, and what to do'), rows)}"


def _metrics_of(path: Path) -> Iterator[tuple[str, str, list[str], str]]:
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        match node:
            case ast.Call(
                func=ast.Name(id=kind), args=[ast.Constant(value=str(name)), ast.Constant(value=str(text)), *rest]
            ) if (kind := kind.removesuffix("MetricFamily").lower()) in METRICS:
                lists = [
                    one
                    for one in (*rest, *(k.value for k in node.keywords if k.arg == "labels"))
                    if isinstance(one, ast.List)
                ]
                labels = [label.value for one in lists for label in one.elts if isinstance(label, ast.Constant)]
                yield f"{name}_total" if kind == "counter" else name, kind, [str(label) for label in labels], text


def calls() -> str:
    """Return every call of the service with its messages and their fields, as the .proto has them."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set.pb"
        source = "lightpage/v1/lightpage.proto"
        words = ["protoc", f"-I{ROOT / 'proto'}", "--include_source_info", f"--descriptor_set_out={out}", source]
        if protoc.main(words) != 0:
            raise SystemExit(f"{source}: protoc failed")
        file = FileDescriptorSet.FromString(out.read_bytes()).file[0]
    said = {tuple(one.path): _unindented(one.leading_comments) for one in file.source_code_info.location}
    parts = ["# Calls of the service\n"]
    for number, service in enumerate(file.service):
        parts.append(f"{said.get((6, number), '')}\n")
        for index, rpc in enumerate(service.method):
            asks, answers = (
                f"{'stream ' * streams}[{name.rpartition('.')[2]}](#{name.rpartition('.')[2].lower()})"
                for name, streams in ((rpc.input_type, rpc.client_streaming), (rpc.output_type, rpc.server_streaming))
            )
            parts.append(f"## {rpc.name}\n\n{asks} to {answers}\n\n{said.get((6, number, 2, index), '')}\n")
    for number, message in enumerate(file.message_type):
        parts += _message(message, (4, number), said)
    parts += _enums(file, said)
    return "\n".join(parts)


def _message(message: DescriptorProto, path: tuple[int, ...], said: dict[tuple[int, ...], str]) -> Iterator[str]:
    yield f"## {message.name}\n\n{said.get(path, '')}\n"
    unsaid = "{} of the map." if message.options.map_entry else ""
    rows = [
        (
            f"`{field.name}`",
            str(field.number),
            _type(field),
            said.get((*path, 2, index), unsaid.format(field.name.capitalize())).replace("\n", " "),
        )
        for index, field in enumerate(message.field)
    ]
    if rows:
        yield _table(("field", "number", "type", "meaning"), rows)
    for index, inner in enumerate(message.nested_type):
        yield from _message(inner, (*path, 3, index), said)


def _enums(file: FileDescriptorProto, said: dict[tuple[int, ...], str]) -> Iterator[str]:
    for number, enum in enumerate(file.enum_type):
        rows = [
            (f"`{value.name}`", str(value.number), said.get((5, number, 2, index), "").replace("\n", " "))
            for index, value in enumerate(enum.value)
        ]
        yield f"## {enum.name}\n\n{said.get((5, number), '')}\n"
        yield _table(("value", "number", "meaning"), rows)


def _unindented(comment: str) -> str:
    return "\n".join(line.strip() for line in comment.strip().splitlines())


def _type(field: FieldDescriptorProto) -> str:
    name = field.type_name.rpartition(".")[2]
    kind = f"`{name}`" if name else FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    return f"repeated {kind}" if field.label == FieldDescriptorProto.LABEL_REPEATED else kind


def python() -> str:
    """Return the page of the package's public names, errors, parts and interfaces, which mkdocstrings fills in."""
    chapters = {"# Python": [f"{home}.{name}" for name, home in sorted(_HOMES.items())]}
    kinds = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, LightpageError)]
    chapters["## Errors"] = [f"{errors.__name__}.{each.__name__}" for each in kinds if each is not LightpageError]
    for told, modules in PARTS.items():
        chapters[f"## {told}"] = [
            f"{module if module.startswith('lightpage.') else _RUNTIME + module}.{name}"
            for module, names in modules.items()
            for name in names.split()
        ]
    return "\n".join("\n\n".join((told, *(f"::: {name}" for name in names))) + "\n" for told, names in chapters.items())


def notebook(path: Path, images: Path) -> str:
    """Return a notebook as a page; its pictures are written into `images`.

    Args:
        path: path of the notebook, kept with its outputs.
        images: folder of pictures.
    """
    parts = list[str]()
    cells = json.loads(path.read_text("utf-8"))["cells"]
    for number, cell in enumerate(cells):
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for index, output in enumerate(cell.get("outputs", [])):
            data: dict[str, Any] = output.get("data", {})
            if drawn := [kind for kind in ("png", "jpeg") if f"image/{kind}" in data]:
                picture = images / f"{path.stem}-{number}-{index}.{drawn[0]}"
                picture.parent.mkdir(parents=True, exist_ok=True)
                picture.write_bytes(base64.b64decode(data[f"image/{drawn[0]}"]))
                parts.append(f"![output of cell {number}](../{images.name}/{picture.name})")
            elif told := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                parts.append(f"```text\n{told}\n```")
    return "\n\n".join(parts) + "\n"


def _keys(model: type[BaseModel]) -> str:
    told = _attributes(model)
    rows = [
        (
            f"`{name}`",
            _value(field.annotation, list(field.metadata)),
            "refused" if field.is_required() else default_of(field) or "none",
            _sentence(field.description or told.get(name, "")),
        )
        for name, field in model.model_fields.items()
    ]
    return _table(("key", "value", "if left out", "meaning"), rows) if rows else ""


def _value(annotation: Any, metadata: list[Any]) -> str:
    is_table = bool(tables_in(annotation)) or get_origin(annotation) is dict
    return "a table" if is_table else wanted(annotation, metadata)


def _attributes(model: type[BaseModel]) -> dict[str, str]:
    """Return what docstrings say of a class's attributes, its parents' included."""
    told = dict[str, str]()
    for parent in reversed(model.__mro__):
        if not parent.__module__.startswith("lightpage."):
            continue
        read = _module(Path(inspect.getfile(parent)))[parent.__qualname__]
        for section in read.docstring.parse("google") if read.docstring else []:
            if isinstance(section, griffe.DocstringSectionAttributes):
                told |= {name.strip(): one.description for one in section.value for name in one.name.split(",")}
        told |= {name: one.docstring.value for name, one in read.members.items() if one.docstring and one.is_attribute}
    return told


@cache
def _module(path: Path) -> griffe.Module:
    return griffe.visit(path.stem, filepath=path, code=path.read_text("utf-8"))


def _first_paragraph(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").partition("\n\n")[0].replace("\n", " ")


def _sentence(text: str) -> str:
    flat = " ".join(text.split())
    return flat[:1].upper() + flat[1:]


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.replace("\b", "").split()) for part in text.split("\n\n"))


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines: list[tuple[str, ...]] = [heads, ("---",) * len(heads), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


GENERATED = {
    "commands": commands,
    "settings": settings,
    "camera-keys": camera_keys,
    "profile-keys": profile_keys,
    "metrics": metrics,
    "alerts": alerts,
    "calls": calls,
    "python": python,
}
"""Pages of the reference by name, and what makes each."""


def front(text: str) -> str:
    """Return a page of the repository's top as one of the site: links lead into it, those to other files are words."""

    def link(match: re.Match[str]) -> str:
        words, target = match.groups()
        if target.startswith("docs/"):
            return f"[{words}]({target.removeprefix('docs/').replace('.ipynb', '.md')})"
        name, mark, anchor = target.partition("#")
        if name in TOP:
            return f"[{words}]({TOP[name]}{mark}{anchor})"
        return match[0] if "://" in target or name in ("", CITATION) else words

    return re.sub(r"\[([^\]]*)\]\(([^)]+)\)", link, text)


def write_pages() -> None:
    """Write all pages of the site, made ones and others, into build/pages."""
    shutil.rmtree(PAGES, ignore_errors=True)
    shutil.copytree(DOCS, PAGES, ignore=shutil.ignore_patterns("*.ipynb"))
    (PAGES / "reference").mkdir(exist_ok=True)
    for name, made in GENERATED.items():
        (PAGES / "reference" / f"{name}.md").write_text(MADE + made(), "utf-8")
    for name, page in TOP.items():
        (PAGES / page).write_text(front((ROOT / name).read_text("utf-8")), "utf-8")
    shutil.copy(ROOT / CITATION, PAGES)
    for path in sorted(DOCS.glob("notebooks/*.ipynb")):
        out = PAGES / "notebooks" / f"{path.stem}.md"
        out.parent.mkdir(exist_ok=True)
        out.write_text(notebook(path, PAGES / "images"), "utf-8")


def main() -> int:
    """Build the site; returns the exit status, which is not 0 where a link is broken."""
    write_pages()
    tool = Path(sys.executable).with_name("zensical")
    words = [str(tool), "build", "--strict", "--clean", "--config-file", str(ROOT / "zensical.toml")]
    return subprocess.run(words, env={**os.environ, "NO_COLOR": "1"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
