"""`lightpage models`: the models of a running service."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.cli.groups import Group
from lightpage.runtime.client.answers import ModelInfo
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import TARGET, with_tls

_EXPECT = click.option("--expect", metavar="VERSION", default="", help="Only if this version is in service.")
_VERSION = click.argument("version")


@click.group(cls=Group, invoke_without_command=True)
@TARGET
@with_tls
@click.pass_context
def models(ctx: click.Context, target: str, tls: TlsFiles | None) -> None:
    """List, add and change the models of a running service; without a command, list those that are loaded."""
    ctx.obj = ctx.with_resource(LightpageClient(target, tls=tls))
    if ctx.invoked_subcommand is None:
        ctx.invoke(list_models)


@models.command("list")
@click.option("--stored", is_flag=True, help="Those of the store too.")
@click.pass_obj
def list_models(client: LightpageClient, stored: bool) -> None:
    """List the models; * is in service."""
    for model in client.models.list(stored):
        click.echo(_line(model))


@models.command()
@click.argument("bundle", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.pass_obj
def upload(client: LightpageClient, bundle: Path) -> None:
    """Give the service a bundle, a .zip; `activate` puts it in service."""
    click.echo(f"{client.models.upload(bundle).version} is in the store")


@models.command()
@_VERSION
@_EXPECT
@click.pass_obj
def activate(client: LightpageClient, version: str, expect: str) -> None:
    """Put a model in service."""
    current, before = client.models.activate(version, expect)
    click.echo(f"{current} is in service, {before} was")


@models.command()
@_EXPECT
@click.pass_obj
def forward(client: LightpageClient, expect: str) -> None:
    """Undo a roll-back."""
    current, before = client.models.roll_forward(expect)
    click.echo(f"{current} is in service, {before} was")


@models.command()
@_VERSION
@click.pass_obj
def pin(client: LightpageClient, version: str) -> None:
    """See that a model is never deleted, and not replaced by the service itself."""
    click.echo(_line(client.models.pin(version)))


@models.command()
@_VERSION
@click.pass_obj
def unpin(client: LightpageClient, version: str) -> None:
    """Let go of a pinned model."""
    click.echo(_line(client.models.pin(version, False)))


def _line(model: ModelInfo) -> str:
    marks = [model.origin or "unknown", *(["pinned"] if model.pinned else []), *([] if model.loaded else ["stored"])]
    return f"{'*' if model.current else ' '} {model.version:<24} {model.created:<20} {', '.join(marks)}"
