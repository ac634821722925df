"""`lightpage models`: the models of a running service."""

from dataclasses import asdict
from pathlib import Path

import click

from lightpage.cli.groups import Group
from lightpage.cli.options import JSON
from lightpage.files import write_json
from lightpage.runtime.client.answers import ModelInfo
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import TARGET, with_tls

_EXPECT = click.option("--expect", metavar="VERSION", default="", help="Refuse unless this version is in service.")
_VERSION = click.argument("version")


@click.group(cls=Group, invoke_without_command=True)
@TARGET
@with_tls
@JSON
@click.pass_context
def models(ctx: click.Context, target: str, tls: TlsFiles | None, json_path: Path | None) -> None:
    """List, add and change the models of a running service; without a command, list those that are loaded."""
    ctx.obj = ctx.with_resource(LightpageClient(target, tls=tls))
    if ctx.invoked_subcommand is None:
        ctx.invoke(list_models, json_path=json_path)


@models.command("list")
@click.option("--stored", is_flag=True, help="List the models of the store too.")
@JSON
@click.pass_obj
def list_models(client: LightpageClient, json_path: Path | None, stored: bool = False) -> None:
    """List the models; * is in service."""
    found = client.models.list(stored)
    write_json(json_path, {"models": list(map(asdict, found))})
    for model in found:
        click.echo(_line(model))


@models.command()
@click.argument("bundle", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@JSON
@click.pass_obj
def upload(client: LightpageClient, bundle: Path, json_path: Path | None) -> None:
    """Give the service a bundle, a .zip. `activate` puts it in service."""
    model = client.models.upload(bundle)
    write_json(json_path, asdict(model))
    click.echo(f"{model.version} is in the store")


@models.command()
@_VERSION
@_EXPECT
@JSON
@click.pass_obj
def activate(client: LightpageClient, version: str, expect: str, json_path: Path | None) -> None:
    """Put a model in service."""
    _changed(client.models.activate(version, expect), json_path)


@models.command()
@_EXPECT
@JSON
@click.pass_obj
def forward(client: LightpageClient, expect: str, json_path: Path | None) -> None:
    """Undo a roll-back."""
    _changed(client.models.roll_forward(expect), json_path)


@models.command()
@_VERSION
@JSON
@click.pass_obj
def pin(client: LightpageClient, version: str, json_path: Path | None) -> None:
    """Keep a model from being deleted. The service does not replace it by itself either."""
    model = client.models.pin(version)
    write_json(json_path, asdict(model))
    click.echo(_line(model))


@models.command()
@_VERSION
@JSON
@click.pass_obj
def unpin(client: LightpageClient, version: str, json_path: Path | None) -> None:
    """Let go of a pinned model."""
    model = client.models.pin(version, False)
    write_json(json_path, asdict(model))
    click.echo(_line(model))


def _changed(versions: tuple[str, str], json_path: Path | None) -> None:
    """Say which model is in service now, and which was."""
    current, before = versions
    write_json(json_path, {"version": current, "previous_version": before})
    click.echo(f"{current} is in service, {before} was")


def _line(model: ModelInfo) -> str:
    marks = [model.origin or "unknown", *(["pinned"] if model.pinned else []), *([] if model.loaded else ["stored"])]
    return f"{'*' if model.current else ' '} {model.version:<24} {model.created:<20} {', '.join(marks)}"
