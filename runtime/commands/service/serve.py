"""`lightpage serve`: the service until it is told to stop."""

import logging
import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from lightpage.codec.compiled.choice import in_use as page_code_in_use
from lightpage.progress import reporting
from lightpage.runtime.client.wire.address import host_and_port
from lightpage.runtime.commands.execution import ENGINE_CACHE, THREADS
from lightpage.runtime.commands.provider_option import PROVIDER
from lightpage.runtime.commands.service.ending import leave_the_rest, stop_signals
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.last_pages import LastPages
from lightpage.runtime.console.state import ConsoleState
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.session import VERSION as RUNTIME_VERSION
from lightpage.runtime.service.assembly import assembled
from lightpage.runtime.service.endpoints import listening
from lightpage.runtime.service.monitoring.logs import logging_to_stderr
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.settings import (
    TABLES,
    Effective,
    Given,
    Key,
    MetricsTable,
    ServiceTable,
    service_settings,
)
from lightpage.systems import check_linux

_log = logging.getLogger(__name__)
_Command = TypeVar("_Command", bound=Callable[..., Any])

_OPTIONS: dict[str, Key] = {
    **{f"--{key.replace('_', '-')}": ("service", key) for key in ServiceTable.model_fields if key != "insecure"},
    "--batches": ("batches", "largest"),
    **{f"--{key}": ("tls", key) for key in ("ca", "certificate", "key")},
    "--metrics-port": ("metrics", "port"),
    "--metrics-host": ("metrics", "host"),
    "--self-calibrate": ("self_calibration", "enabled"),
    "--calibration-page": ("self_calibration", "pages"),
    "--flight-recorder": ("flight_recorder", "folder"),
    "--flight-recorder-pages": ("flight_recorder", "pages"),
}
"""The setting that each option stands above."""
_SHARED = {"--threads": THREADS, "--provider": PROVIDER, "--engine-cache": ENGINE_CACHE}


def _option(name: str, key: str, setting: dict[str, Any]) -> Callable[[_Command], _Command]:
    """Return an option of the type, the help and the default of its setting, as JSON Schema has it."""
    value, default = setting.get("anyOf", [setting])[0], setting["default"]
    multiple, value = "items" in value, value.get("items", value)
    kind: click.ParamType[Any] | None = None
    if value["type"] == "boolean":
        name, default = f"{name}/--no-{name[2:]}", default and key
    elif value["type"] == "integer":
        kind = click.IntRange(value["minimum"], value.get("maximum"))
    elif "format" in value:
        kind = click.Path(file_okay=value["format"] == "path", path_type=Path)
    shown, unset = str(default) if default else None, () if multiple else None
    told = setting["description"] + " May be given repeatedly." * multiple
    return click.option(name, type=kind, multiple=multiple, default=unset, show_default=shown, help=told)


def _settings_options(command: _Command) -> _Command:
    settings = {
        table: TABLES[table].model_json_schema()["properties"] for table in {key[0] for key in _OPTIONS.values()}
    }
    for name, (table, key) in reversed(_OPTIONS.items()):
        command = (_SHARED.get(name) or _option(name, key, settings[table][key]))(command)
    return command


@click.command()
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    envvar="LIGHTPAGE_CONFIG",
    show_envvar=True,
    help="Settings, SERVICE.toml; variables of the environment and options count before them.",
)
@click.option("--print-config", is_flag=True, help="Print the settings in effect and where they come from, and end.")
@_settings_options
@click.pass_context
def serve(context: click.Context, /, config: Path | None, print_config: bool, **_: Any) -> None:
    """Run the service until SIGTERM, Ctrl-C or SIGHUP; calls in flight are finished first."""
    effective = service_settings(config, options=_given(context))
    if print_config:
        click.echo(effective.to_toml(), nl=False)
        return
    check_linux("lightpage serve")
    settings = effective.settings
    settings.check_paths()
    share_freed_memory()
    logged = reporting(None)  # what work tells of itself goes into the log too
    with stop_signals() as wait_for_stop, logging_to_stderr(settings.logs), logged:
        _serve(effective, wait_for_stop)
        leave_the_rest()


def _given(context: click.Context) -> list[Given]:
    """Return the settings that somebody gave as options."""
    names = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    return [
        Given(f"option {option}", _OPTIONS[option], context.params[name])
        for name, option in names.items()
        if option in _OPTIONS and context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]


def _serve(effective: Effective, wait_for_stop: Callable[[], None]) -> None:
    settings = effective.settings
    files = settings.tls.files()
    certificates = None if files is None else Certificates(files)
    last_pages = LastPages()
    with ExitStack() as stack:
        own = stack.enter_context(assembled(settings, last_pages))
        plane, models = own.plane, own.plane.models
        actions = Actions(plane, own.recalibrator, settings.self_calibration.pages)
        state = ConsoleState(last_pages, models, own.monitor, own.source_name, actions)
        stack.enter_context(_shown(state, plane.metrics, settings.metrics, certificates))
        endpoints = stack.enter_context(listening(settings, own, certificates))
        if endpoints.health is not None:
            click.echo(f"health checks at {endpoints.health}")
        told = f"serving {models.current.version} from {own.source_name} at {endpoints.target}"
        click.echo(told)
        provider = models.current.decoder.graph.provider
        _log.info("%s on %s, %d settings given", told, provider, len(effective.origins), extra={"told": _versions()})
        wait_for_stop()
        with suppress(OSError):  # the terminal may have gone, and sent the signal
            click.echo("stopping")
        _log.info("stopping with model %s", models.current.version)
    _log.info("stopped")


def _versions() -> dict[str, str]:
    versions = {name: installed_version(name) for name in ("lightpage", "grpcio", "numpy")}
    return versions | {
        "onnxruntime": RUNTIME_VERSION,
        "python": platform.python_version(),
        "page_code": page_code_in_use(),
    }


@contextmanager
def _shown(
    state: ConsoleState, metrics: ServiceMetrics, settings: MetricsTable, certificates: Certificates | None
) -> Iterator[None]:
    if settings.port is None:
        yield
        return
    from lightpage.runtime.console.application import console_routes  # Tornado is for who asks for it
    from lightpage.runtime.console.server import serving

    routes = console_routes(state, metrics.registry)
    with serving(routes, settings.port, settings.host, certificates, settings.names) as port:
        root = f"{'http' if certificates is None else 'https'}://{host_and_port(settings.host, port)}"
        click.echo(f"metrics at {root}/metrics, console at {root}/")
        yield
