"""The service's settings: one TOML file, above it the environment, above both the options of the command line."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args, get_origin

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from lightpage.device.problems import WANTED, expected_of, problem_of
from lightpage.device.profile import TomlTable, toml_value
from lightpage.errors import InvalidInputError
from lightpage.files import read_text
from lightpage.runtime.client.wire.address import check_address, is_local
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.execution.providers import CPU, Provider
from lightpage.runtime.recalibration.known_pages import MIN_PAGES
from lightpage.runtime.service.caller import named_session
from lightpage.runtime.service.jobs.self_calibration import SelfCalibrationSettings
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.audit import AUDIT_BYTES, AUDIT_KEPT
from lightpage.runtime.service.monitoring.flight_recorder import PAGES, RING_BYTES, FlightSettings
from lightpage.runtime.service.monitoring.traces import check_endpoint

PREFIX = "LIGHTPAGE_"
"""Of variables of the environment: LIGHTPAGE_TABLE__KEY."""
STORE_VARIABLE = "LIGHTPAGE_STORE"
"""Short name of LIGHTPAGE_SERVICE__STORE."""
EXPLAINED = "settings as docs/service-settings.md explains them"

ADDRESS = "127.0.0.1:50051"
"""Where the service listens: on this machine alone, since whoever reaches it may change its model."""
AUDIT_FILE = "audit.jsonl"
"""Name of the record of model changes in the store, where no other file is named."""
LINES_PER_SECOND = 5
"""Lines of one kind in a log: enough to see that it goes on, and too few to fill a disk in a night."""

_HEADER_BYTES = 1 << 10
"""Of a message beside the chunk in it, at most."""


def _not_empty(value: Any) -> Any:
    if value == "":
        raise ValueError("a path that is not empty")
    return value


_Text = Annotated[str, Field(min_length=1)]
_Path = Annotated[Path, Field(strict=False), BeforeValidator(_not_empty)]
_Port = Annotated[int, Field(ge=0, le=65535)]
_PageNumber = Annotated[int, Field(ge=0, lt=2**32)]
_Seconds = Annotated[float, Field(gt=0, le=31e6, allow_inf_nan=False)]


class SettingsTable(TomlTable):
    """One table of the file. Values are of the right type to begin with: no text that stands for a number."""

    model_config = ConfigDict(strict=True)


OFF = "off"
"""In place of an address: nowhere."""


class ServiceTable(SettingsTable):
    """What is served, and where.

    Attributes:
        bundle: path of a bundle, or the name of a shipped one.
        bundle_key: public key that bundles from elsewhere must be signed with.
        source: where pages are read from; without one only sent frames decode.
        pages: file of pages that the source is to show.
        address: HOST:PORT to listen on; port 0 takes a free one.
        insecure: whether addresses that others reach may do without TLS, as in a container whose ports are published
            on its own machine alone.
        health_address: HOST:PORT of health checks; without, the next port of this machine; `off` for none.
        shared_memory: whether clients at its Unix socket may share memory with it.
        store: folder of recalibrated and uploaded bundles.
        incoming: folder whose bundles are taken into the store.
        recordings: folder whose recordings a caller may name to recalibrate with.
        threads: of one inference; without, all cores.
        provider: what computes pages: `cpu`, `cuda` or `tensorrt`, with `:N` for another GPU than the first.
        engine_cache: folder where TensorRT keeps its engines; without, it builds them at each start.
        tracking: whether the image is followed and searched for.
    """

    bundle: _Text = DEFAULT
    bundle_key: _Path | None = None
    source: _Text | None = None
    pages: _Path | None = None
    address: str = ADDRESS
    insecure: bool = False
    health_address: str | None = None
    shared_memory: bool = False
    store: _Path | None = None
    incoming: _Path | None = None
    recordings: _Path | None = None
    threads: Annotated[int, Field(ge=1, le=4096)] | None = None
    provider: str = CPU
    engine_cache: _Path | None = None
    tracking: bool = True

    @field_validator("address", "health_address")
    @classmethod
    def _is_address(cls, address: str | None) -> str | None:
        if address is None or address == OFF:
            return address
        try:
            check_address("address", address, least_port=0)
        except InvalidInputError as error:
            raise ValueError(error.expected) from None
        return address

    @field_validator("provider")
    @classmethod
    def _is_provider(cls, provider: str) -> str:
        try:
            Provider.parse(provider)
        except InvalidInputError as error:
            raise ValueError(error.expected) from None
        return provider


class TlsTable(SettingsTable):
    """Certificates, PEM; all three or none. With them, callers of the service and of its console need some too.

    Attributes:
        ca: authorities that callers' certificates may come from.
        certificate: of the service.
        key: its private key.
        plain_health: whether health checks are answered without TLS, for those who ask that know none.
    """

    ca: _Path | None = None
    certificate: _Path | None = None
    key: _Path | None = None
    plain_health: bool = False

    def files(self) -> TlsFiles | None:
        """The three files, None for none."""
        if self.ca is None or self.certificate is None or self.key is None:
            return None
        return TlsFiles(self.ca, self.certificate, self.key)


class MetricsTable(SettingsTable):
    """Where metrics and the console are shown; without a port, nowhere.

    Attributes:
        host: to listen on.
        port: 0 takes a free one.
        names: by which they may be asked for, beside IP addresses, `localhost`, `host` and this machine's own name.
    """

    host: _Text = "127.0.0.1"
    port: _Port | None = None
    names: Annotated[tuple[_Text, ...], Field(strict=False)] = ()


class TracesTable(SettingsTable):
    """Where spans of calls are sent; without an endpoint, nowhere.

    Attributes:
        endpoint: of a collector that takes OTLP over gRPC, http://HOST:PORT or https://HOST:PORT.
        share: of the calls that are traced, where their callers have not decided.
    """

    endpoint: str | None = None
    share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 1.0

    @field_validator("endpoint")
    @classmethod
    def _is_endpoint(cls, endpoint: str | None) -> str | None:
        try:
            return endpoint if endpoint is None else check_endpoint(endpoint)
        except InvalidInputError as error:
            raise ValueError(error.expected) from None


class InferenceTable(SettingsTable):
    """The Open Inference Protocol.

    Attributes:
        enabled: whether it is served beside the service's own contract; it takes a whole frame pair in one message.
    """

    enabled: bool = True


class SelfCalibrationTable(SettingsTable):
    """See `SelfCalibrationSettings`; `enabled` left out means: where pages are named.

    `device_sessions` are sessions whose frames, which callers send, are of the device: the monitor counts them as it
    does the pages of the source. With TLS each is CALLER/SESSION, CALLER being the name in the caller's certificate.
    """

    enabled: bool | None = None
    device_sessions: Annotated[tuple[_Text, ...], Field(strict=False)] = ()
    pages: Annotated[tuple[_PageNumber, ...], Field(strict=False)] = SelfCalibrationSettings.pages
    least_s: _Seconds = SelfCalibrationSettings.least_s
    longest_s: _Seconds = SelfCalibrationSettings.longest_s
    busy_s: _Seconds = SelfCalibrationSettings.busy_s

    def settings(self) -> SelfCalibrationSettings:
        """The same as self-calibration takes them."""
        return SelfCalibrationSettings(self.pages, self.least_s, self.longest_s, self.busy_s)


class FlightRecorderTable(SettingsTable):
    """See `FlightSettings`; without a folder nothing is kept."""

    folder: _Path | None = None
    pages: Annotated[int, Field(ge=1, le=1_000_000)] = PAGES
    ring_bytes: Annotated[int, Field(ge=1)] = RING_BYTES
    low_margin_bits: Annotated[float, Field(ge=0, le=8, allow_inf_nan=False)] = FlightSettings.low_margin_bits
    read_every_s: Annotated[float, Field(ge=0, le=31e6, allow_inf_nan=False)] = FlightSettings.read_every_s

    def settings(self) -> FlightSettings:
        """The same as the flight recorder takes them."""
        return FlightSettings(self.pages, self.ring_bytes, self.low_margin_bits, self.read_every_s)


class LogsTable(SettingsTable):
    """What goes to stderr.

    Attributes:
        format: of a line.
        level: lesser lines are left out.
        lines_per_second: of one kind, e.g. of one method and reason; the others are counted.
    """

    format: Literal["text", "json"] = "text"
    level: Literal["debug", "info", "warning", "error"] = "info"
    lines_per_second: Annotated[int, Field(ge=1, le=100_000)] = LINES_PER_SECOND


class AuditTable(SettingsTable):
    """The record of model changes.

    Attributes:
        file: where it is; without, `audit.jsonl` in the store.
        file_bytes: a larger file is put aside, and a new one begun.
        kept: files put aside that stay.
    """

    file: _Path | None = None
    file_bytes: Annotated[int, Field(ge=1024)] = AUDIT_BYTES
    kept: Annotated[int, Field(ge=1, le=1000)] = AUDIT_KEPT


class ServiceSettings(TomlTable):
    """The whole file."""

    service: ServiceTable = ServiceTable()
    tls: TlsTable = TlsTable()
    inference: InferenceTable = InferenceTable()
    metrics: MetricsTable = MetricsTable()
    traces: TracesTable = TracesTable()
    self_calibration: SelfCalibrationTable = SelfCalibrationTable()
    flight_recorder: FlightRecorderTable = FlightRecorderTable()
    limits: Limits = Limits()
    logs: LogsTable = LogsTable()
    audit: AuditTable = AuditTable()

    @property
    def self_calibrates(self) -> bool:
        """Whether the service recalibrates itself."""
        enabled = self.self_calibration.enabled
        return bool(self.self_calibration.pages) if enabled is None else enabled

    @property
    def device_sessions(self) -> list[str]:
        """Sessions whose frames are of the device, as `Caller.session` has them."""
        named = self.self_calibration.device_sessions
        if self.tls.files() is None:
            return [named_session(name, "") for name in named]
        return [named_session(name, caller) for caller, _, name in (one.partition("/") for one in named)]

    @property
    def audit_file(self) -> Path | None:
        """The record of model changes, None for none."""
        if self.audit.file is not None or self.service.store is None:
            return self.audit.file
        return self.service.store / AUDIT_FILE

    @model_validator(mode="after")
    def _reached_by_few(self) -> Self:
        files = {name: getattr(self.tls, name) for name in ("ca", "certificate", "key")}
        lacking = [f"tls.{name}" for name, path in files.items() if path is None]
        for name, path in files.items():
            _want(path is None or not lacking, f"tls.{name}", str(path), f"{' and '.join(lacking)} too")
        listening = {
            "service.address": self.service.address,
            "service.health_address": self.service.health_address or OFF,
            "metrics.host": OFF if self.metrics.port is None else self.metrics.host,
        }
        for key, address in listening.items():
            _want(
                address == OFF or is_local(address) or not lacking or self.service.insecure,
                key,
                address,
                "[tls], since others reach it; or an address of this machine alone; or service.insecure = true",
            )
        return self

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        limits, own = self.limits, self.self_calibration
        _want(
            limits.chunk_bytes + _HEADER_BYTES <= limits.message_bytes,
            "limits.chunk_bytes",
            limits.chunk_bytes,
            f"at least {_HEADER_BYTES} less than limits.message_bytes, which is {limits.message_bytes}",
        )
        _want(
            limits.receive_bytes >= limits.pair_bytes,
            "limits.receive_bytes",
            limits.receive_bytes,
            f"at least limits.pair_bytes, which is {limits.pair_bytes}: a larger pair would never be taken",
        )
        _want(
            limits.stall_s <= limits.receive_s,
            "limits.stall_s",
            limits.stall_s,
            f"at most limits.receive_s, which is {limits.receive_s:g}",
        )
        _want(
            limits.connection_grace_s is None or limits.connection_age_s is not None,
            "limits.connection_grace_s",
            limits.connection_grace_s,
            "limits.connection_age_s too: the age after which it begins",
        )
        _want(
            own.longest_s >= own.least_s,
            "self_calibration.longest_s",
            own.longest_s,
            f"at least self_calibration.least_s, which is {own.least_s:g}",
        )
        _want(
            not own.pages or (len(own.pages) >= MIN_PAGES and len(set(own.pages)) == len(own.pages)),
            "self_calibration.pages",
            own.pages,
            f"at least {MIN_PAGES} that differ: one to fit, one to judge by",
        )
        _want(
            len(own.pages) <= limits.recalibration_pages,
            "self_calibration.pages",
            own.pages,
            f"at most limits.recalibration_pages, which is {limits.recalibration_pages}",
        )
        _want(
            self.tls.files() is None or all(all(one.partition("/")) for one in own.device_sessions),
            "self_calibration.device_sessions",
            own.device_sessions,
            "CALLER/SESSION with [tls], since sessions belong to the name in a certificate",
        )
        _want(self.service.address != OFF, "service.address", OFF, "an address: only health_address may be off")
        _want(
            not self.service.shared_memory or self.service.address.startswith("unix:"),
            "service.shared_memory",
            True,
            f"service.address = unix:PATH, since memory is shared on one machine; it is {self.service.address}",
        )
        _want(
            self.service.incoming is None or self.service.store is not None,
            "service.incoming",
            str(self.service.incoming),
            "service.store too: a folder where its bundles are kept",
        )
        _want(
            self.service.source is not None or not self.self_calibrates,
            "self_calibration.pages" if own.enabled is None else "self_calibration.enabled",
            own.pages if own.enabled is None else own.enabled,
            "service.source: a source that shows known pages",
        )
        _want(
            self.service.source is not None or self.service.pages is None,
            "service.pages",
            self.service.pages,
            "service.source: a source that shows them",
        )
        return self

    def check_paths(self) -> None:
        """Check what is to be read and need not be opened for it.

        Raises:
            InvalidInputError: a folder or a file is not there.
        """
        pages = self.service.pages
        for key in ("recordings", "incoming"):
            folder = getattr(self.service, key)
            if folder is not None and not folder.is_dir():
                raise InvalidInputError(f"service.{key}", str(folder), "a folder that is there")
        if pages is not None and not pages.is_file():
            raise InvalidInputError("service.pages", str(pages), "a file that is there")


def _want(right: bool, key: str, got: Any, wanted: str) -> None:
    """Have it told that a key does not go with another one."""
    if not right:
        raise ValueError(f"{key} = {_shown(got)}{WANTED}{wanted}")


Key = tuple[str, str]
"""Table and key."""


@dataclass(frozen=True)
class Option:
    """An option of the command line that somebody gave: its name, the key that it sets, and the value."""

    name: str
    key: Key
    value: Any


@dataclass(frozen=True)
class Effective:
    """Settings, and where each that is no default comes from."""

    settings: ServiceSettings
    origins: Mapping[Key, str]

    def to_toml(self) -> str:
        """All settings as TOML text, each with its origin as a comment."""
        lines = ["# The settings in effect, and where each of them comes from."]
        for name in ServiceSettings.model_fields:
            table = getattr(self.settings, name)
            lines += ["", f"[{name}]"]
            for key in type(table).model_fields:
                value, origin = getattr(table, key), self.origins.get((name, key), "default")
                told = f"# {key} is not set" if value is None else f"{key} = {_toml(value)}"
                lines.append(f"{told}  # {_printable(origin)}")
        return "\n".join(lines) + "\n"


def service_settings(
    file: Path | None = None, environment: Mapping[str, str] | None = None, options: Iterable[Option] = ()
) -> Effective:
    """Settings of a file, of the environment and of options, checked together; the later of these count.

    An empty variable of the environment counts as one that is not set.

    Args:
        file: TOML, None for none.
        environment: variables, by default those of this process; those named `PREFIX` + TABLE__KEY count, and before
            them, where it is not named so, `STORE_VARIABLE`.
        options: of the command line.

    Raises:
        InvalidInputError: the file cannot be read, or a setting is wrong.
    """
    data: dict[str, Any] = {} if file is None else _parsed(file)
    origins: dict[Key, str] = {}
    for name, table in data.items():
        if isinstance(table, dict):
            origins |= {(name, key): f"file {file}" for key in table}
    environment = os.environ if environment is None else environment
    named = {STORE_VARIABLE: ("service", "store")} if environment.get(STORE_VARIABLE) else {}
    named |= {name: key for name in sorted(environment) if (key := _key_of(name)) is not None and environment[name]}
    given = [Option(name, key, _from_text(name, key, environment[name])) for name, key in named.items()]
    for origin, option in [*(("environment", each) for each in given), *(("option", each) for each in options)]:
        table_name, key_name = option.key
        if isinstance(data.setdefault(table_name, {}), dict):
            data[table_name][key_name] = option.value
        origins[option.key] = f"{origin} {option.name}"
    subject = "settings" if file is None else f"settings {file}"
    try:
        return Effective(ServiceSettings.model_validate(data), origins)
    except ValidationError as error:
        problems = [_told(each, origins) for each in error.errors(include_url=False)]
    if len(problems) == 1:
        origin, got, wanted = problems[0]
        raise InvalidInputError(origin or subject, got, wanted)
    told = "; ".join(f"{got}{f' ({origin})' * bool(origin)}, wanted {wanted}" for origin, got, wanted in problems)
    raise InvalidInputError(subject, told, EXPLAINED)


def _parsed(file: Path) -> dict[str, Any]:
    subject, expected = f"settings {file}", "a TOML file that can be read"
    try:
        return tomllib.loads(read_text(file, subject, expected))
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(subject, error, expected) from None


def _key_of(variable: str) -> Key | None:
    """The key that a variable of the environment sets; None for a variable of another kind."""
    table, apart, key = variable.removeprefix(PREFIX).lower().partition("__")
    return (table, key) if variable.startswith(PREFIX) and apart else None


def _from_text(variable: str, key: Key, text: str) -> Any:
    """A value of the environment in the type of its key, not yet checked for its bounds."""
    if (field := _fields(key[0]).get(key[1])) is None:
        raise InvalidInputError(variable, f"no setting {'.'.join(key)}", _meant(key))
    kind: Any = field.annotation
    try:
        if get_origin(kind) is not tuple:
            return TypeAdapter(kind).validate_strings(text)
        one: TypeAdapter[Any] = TypeAdapter(get_args(kind)[0])
        parts = text.strip("[] ").split(",")
        return tuple(one.validate_strings(part.strip()) for part in parts if part.strip())
    except ValidationError as error:
        raise InvalidInputError(variable, repr(text), expected_of(error.errors(include_url=False)[0])) from None


def _meant(key: Key) -> str:
    """What may have been meant by a key that is not there."""
    tables = {name: set(_fields(name)) for name in ServiceSettings.model_fields}
    table, name = key
    if table not in tables:
        found = difflib.get_close_matches(table, tables, 1)
        return f"table [{found[0]}]" if found else f"one of the tables {', '.join(tables)}"
    if found := difflib.get_close_matches(name, tables[table], 1):
        return f"{table}.{found[0]}"
    elsewhere = [other for other, keys in tables.items() if name in keys]
    return f"{elsewhere[0]}.{name}" if elsewhere else f"one of {', '.join(sorted(tables[table]))}"


def _fields(table: str) -> Mapping[str, FieldInfo]:
    """The fields of a table by their keys, none of one that is not there."""
    field = ServiceSettings.model_fields.get(table)
    kind: Any = None if field is None else field.annotation
    return {} if kind is None else kind.model_fields


def _told(error: ErrorDetails, origins: Mapping[Key, str]) -> tuple[str, str, str]:
    """Return where one wrong setting comes from, what came, and what was wanted."""
    problem = problem_of(ServiceSettings, error)
    place = problem.place or problem.got.partition(" = ")[0]  # of settings that do not go together
    table, _, name = place.partition(".")
    origin = origins.get((table, name.partition(".")[0]), "")
    if problem.kind == "unknown":
        return origin, f"unknown {place}", _meant((table, name))
    if problem.kind == "missing" or not problem.place:
        return origin, problem.got, problem.expected
    return origin, f"{place} = {problem.got}", problem.expected


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return str(list(value))
    return repr(str(value) if isinstance(value, Path) else value)


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return toml_value(str(value) if isinstance(value, Path) else value)


def _printable(text: str) -> str:
    """Text for a comment: of one line, whatever a file is called."""
    return text if text.isprintable() else ascii(text)
