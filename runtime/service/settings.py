"""The service's settings: one TOML file, above it the environment, above both the options of the command line."""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_origin

from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from lightpage.device.problems import other_kind, problem_of
from lightpage.device.profile import toml_value
from lightpage.errors import InvalidInputError
from lightpage.files import read_toml
from lightpage.progress import warn
from lightpage.runtime.client.wire.address import check_address, is_local
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.execution.providers import CPU, Provider
from lightpage.runtime.service.caller import named_session
from lightpage.runtime.service.jobs.self_calibration import SelfCalibrationSettings
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.audit import AUDIT_BYTES, AUDIT_KEPT
from lightpage.runtime.service.monitoring.flight_recorder import FlightSettings
from lightpage.runtime.service.monitoring.logs import LogSettings
from lightpage.runtime.service.monitoring.traces import check_endpoint
from lightpage.runtime.service.table import File, Folder, Rule, SettingsTable, Text, checked

_PREFIX = "LIGHTPAGE_"
"""Of variables of the environment: LIGHTPAGE_TABLE__KEY."""
_STORE = "LIGHTPAGE_STORE"
"""Short name of LIGHTPAGE_SERVICE__STORE."""

ADDRESS = "127.0.0.1:50051"
"""Where the service listens: on this machine alone, since whoever reaches it may change its model."""
OFF = "off"
"""In place of an address: nowhere."""


def _check_health_address(address: str) -> None:
    if address != OFF:
        check_address("address", address, least_port=0)


_Address = Annotated[str, checked(partial(check_address, "address", least_port=0))]
_HealthAddress = Annotated[str, checked(_check_health_address)]


class ServiceTable(SettingsTable):
    """The served bundle and source, and their addresses."""

    bundle: Text = Field(DEFAULT, description="A bundle's path, or the name of a shipped one.")
    bundle_key: File | None = Field(None, description="Public key, PEM, that bundles must be signed with.")
    source: Text | None = Field(
        None,
        description="Pages to read: simulator:PROFILE, recording:FILE, camera:CONFIG.toml; without, only sent frames.",
    )
    pages: File | None = Field(None, description="Pages for the source to show, PAGES.h5; ReadPage.page is the row.")
    address: _Address = Field(ADDRESS, description="HOST:PORT or unix:PATH to listen on; port 0 takes a free one.")
    insecure: bool = False
    """Whether addresses that others reach may do without TLS, as in a container whose ports are published on its own
    machine alone."""
    health_address: _HealthAddress | None = Field(
        None,
        description="HOST:PORT of health checks, answered by a process of their own; by default the next port of this "
        "machine, or unix:PATH.health. off: none.",
    )
    shared_memory: bool = Field(False, description="Share memory with clients at the service's Unix socket.")
    store: Folder | None = Field(
        None, description=f"Folder of recalibrated and uploaded bundles; it remembers which one serves. {_STORE} too."
    )
    incoming: Folder | None = Field(None, description="Folder whose bundles are taken into the store, as uploads are.")
    recordings: Folder | None = Field(
        None, description="Folder whose recordings a caller may name to recalibrate with."
    )
    threads: int | None = Field(None, ge=1, le=4096)
    """Threads of one inference; by default all cores."""
    code_threads: int = Field(
        1, ge=1, le=64, description="Threads that share the code of a page, where it is compiled."
    )
    steps: int | None = Field(
        None,
        ge=1,
        description="Gauss-Newton steps of a page at most, of every model that is served; by default all of "
        "its bundle. Bundles of a network have none.",
    )
    provider: Annotated[str, checked(Provider.parse)] = CPU
    """Processor that computes pages: cpu, cuda or tensorrt, with :N behind it for another GPU than the first."""
    engine_cache: Folder | None = None
    """Folder where TensorRT keeps its engines; without, it builds them at each start, for minutes."""
    tracking: bool = Field(True, description="Follow the image, and find it again.")

    def rules(self) -> Iterator[Rule]:
        """Yield the rules among what is served."""
        socket = f"service.address = unix:PATH, since memory is shared on one machine; it is {self.address}"
        yield not self.shared_memory or self.address.startswith("unix:"), "shared_memory", socket
        store = "service.store too: a folder where its bundles are kept"
        yield self.incoming is None or self.store is not None, "incoming", store
        yield self.source is not None or self.pages is None, "pages", "service.source: a source that shows them"


class BatchesTable(SettingsTable):
    """Batches of pages that are computed together, by bundles that have a graph for it."""

    largest: int = Field(1, ge=1, le=64, description="Pages computed together at most, on a GPU; 1: each by itself.")
    longest_wait_ms: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 5.0
    """Longest wait of a batch for pages whose frames are there and are being checked: it bounds what one slow caller
    costs the others."""

    def batching(self) -> Batching:
        """Return how pages are gathered."""
        return Batching(self.largest, self.longest_wait_ms / 1e3)


class TlsTable(SettingsTable):
    """Certificates, PEM; all three or none. With them, callers of the service and of its console need some too."""

    ca: File | None = Field(None, description="TLS: authorities of the callers' certificates, PEM.")
    certificate: File | None = Field(None, description="TLS: certificate of the service, PEM.")
    key: File | None = Field(None, description="TLS: its private key, PEM.")
    plain_health: bool = False
    """Whether health checks are answered without TLS, for programs that know none."""

    def files(self) -> TlsFiles | None:
        """Return the three files, None for none."""
        if self.ca is None or self.certificate is None or self.key is None:
            return None
        return TlsFiles(self.ca, self.certificate, self.key)

    def rules(self) -> Iterator[Rule]:
        """Yield that the three go together."""
        files = {"ca": self.ca, "certificate": self.certificate, "key": self.key}
        lacking = [f"tls.{name}" for name, path in files.items() if path is None]
        named = next((name for name, path in files.items() if path is not None), "")
        yield not lacking or not named, named, f"{' and '.join(lacking)} too"


class MetricsTable(SettingsTable):
    """The address of metrics and console; without a port they are not shown."""

    host: Text = Field("127.0.0.1", description="Host of metrics and console.")
    port: int | None = Field(None, ge=0, le=65535, description="Show metrics and console on this port.")
    names: Annotated[tuple[Text, ...], Field(strict=False)] = ()
    """Further host names by which metrics and console may be asked for, beside IP addresses, `localhost`, `host` and
    this machine's own name."""


class TracesTable(SettingsTable):
    """The collector of spans of calls; without an endpoint none are sent."""

    endpoint: Annotated[str, checked(check_endpoint)] | None = None
    """Collector that takes OTLP over gRPC, http://HOST:PORT or https://HOST:PORT."""
    share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 1.0
    """Share of the calls that are traced, if their callers have not decided."""


class InferenceTable(SettingsTable):
    """The Open Inference Protocol, beside the service's own contract; it takes a whole frame pair in one message."""

    enabled: bool = True
    """Whether it is served; without it, messages are at most `limits.message_bytes`."""


class AuditTable(SettingsTable):
    """The record of model changes."""

    file: File | None = None
    """File of the record; by default `audit.jsonl` in the store."""
    file_bytes: Annotated[int, Field(ge=1024)] = AUDIT_BYTES
    """Size beyond which the file is put aside, and a new one begun."""
    kept: Annotated[int, Field(ge=1, le=1000)] = AUDIT_KEPT
    """Files put aside that stay."""


class ServiceSettings(SettingsTable):
    """The whole file."""

    service: ServiceTable = ServiceTable()
    batches: BatchesTable = BatchesTable()
    tls: TlsTable = TlsTable()
    inference: InferenceTable = InferenceTable()
    metrics: MetricsTable = MetricsTable()
    traces: TracesTable = TracesTable()
    self_calibration: SelfCalibrationSettings = SelfCalibrationSettings()
    flight_recorder: FlightSettings = FlightSettings()
    limits: Limits = Limits()
    logs: LogSettings = LogSettings()
    audit: AuditTable = AuditTable()

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
        folder, file = self.service.store, self.audit.file
        return folder / "audit.jsonl" if file is None and folder is not None else file

    def rules(self) -> Iterator[Rule]:
        """Yield the rules among keys of different tables."""
        service, own, guarded = self.service, self.self_calibration, self.tls.files() is not None
        reached = {
            "service.address": service.address,
            "service.health_address": service.health_address or OFF,
            "metrics.host": OFF if self.metrics.port is None else self.metrics.host,
        }
        wanted = "[tls], since others reach it; or an address of this machine alone; or service.insecure = true"
        for key, address in reached.items():
            yield address == OFF or is_local(address) or guarded or service.insecure, key, wanted
        most = self.limits.recalibration_pages
        few = f"at most limits.recalibration_pages, which is {most}"
        yield len(own.pages) <= most, "self_calibration.pages", few
        full = all(all(one.partition("/")) for one in own.device_sessions)
        named = "CALLER/SESSION with [tls], since sessions belong to the name in a certificate"
        yield full or not guarded, "self_calibration.device_sessions", named
        key = f"self_calibration.{'pages' if own.enabled is None else 'enabled'}"
        yield service.source is not None or not own.is_on, key, "service.source: a source that shows known pages"

    def check_paths(self) -> None:
        """Check what is to be read and need not be opened for it.

        Raises:
            InvalidInputError: a folder or a file is not there.
        """
        folder, file = ("folder", Path.is_dir), ("file", Path.is_file)
        for key, (kind, is_there) in {"recordings": folder, "incoming": folder, "pages": file}.items():
            path = getattr(self.service, key)
            if path is not None and not is_there(path):
                raise InvalidInputError(f"service.{key}", str(path), f"a {kind} that is there")


TABLES: Mapping[str, type[SettingsTable]] = {
    name: type(field.default) for name, field in ServiceSettings.model_fields.items()
}
"""What each table may hold."""

Key = tuple[str, str]
"""Table and key."""


@dataclass(frozen=True)
class Given:
    """A setting that somebody gave: where it comes from, the key that it sets, and the value."""

    origin: str
    key: Key
    value: Any


@dataclass(frozen=True)
class Effective:
    """Settings, and where each that is no default comes from."""

    settings: ServiceSettings
    origins: Mapping[Key, str]

    def to_toml(self) -> str:
        """Return all settings as TOML text, each with its origin as a comment."""
        lines = ["# The settings in effect, and where each of them comes from."]
        for name, table in self.settings.model_dump(mode="json").items():
            lines += ["", f"[{name}]"]
            for key, value in table.items():
                told = f"# {key} is not set" if value is None else f"{key} = {toml_value(value)}"
                origin = self.origins.get((name, key), "default")
                lines.append(f"{told}  # {origin if origin.isprintable() else ascii(origin)}")  # one line, always
        return "\n".join(lines) + "\n"


def service_settings(
    file: Path | None = None, environment: Mapping[str, str] | None = None, options: Iterable[Given] = ()
) -> Effective:
    """Return the settings of a file, of the environment and of options, checked together; the later of these count.

    An empty variable of the environment counts as one that is not set.

    Args:
        file: TOML, None for none.
        environment: variables, by default those of this process; those named `_PREFIX` + TABLE__KEY count, and before
            them, where it is not named so, `_STORE`.
        options: options of the command line.

    Raises:
        InvalidInputError: the file cannot be read, or a setting is wrong.
    """
    subject, data = "settings", dict[str, Any]()
    if file is not None:
        subject = f"settings {file}"
        data = read_toml(file, subject, "a TOML file that can be read")
    told = {name: table if isinstance(table, dict) and table else [""] for name, table in data.items()}
    origins = {(name, key): f"file {file}" for name, keys in told.items() for key in keys}
    for given in [*_of_environment(os.environ if environment is None else environment), *options]:
        if isinstance(table := data.setdefault(given.key[0], {}), dict):
            table[given.key[1]] = given.value
            origins[given.key] = given.origin
    try:
        return Effective(ServiceSettings.model_validate(data), origins)
    except ValidationError as error:
        if kind := other_kind(error):
            raise InvalidInputError(subject, kind, "settings of a service") from None
        problems = [_told(each, origins) for each in error.errors(include_url=False)]
    if len(problems) == 1:
        origin, got, wanted = problems[0]
        raise InvalidInputError(subject if origin in ("", f"file {file}") else origin, got, wanted)
    alike = dict[tuple[str, str], list[str]]()
    for origin, got, wanted in problems:
        alike.setdefault((f" ({origin})" * bool(origin), wanted), []).append(got)
    lines = [f"{', '.join(got)}{origin}, wanted {wanted}" for (origin, wanted), got in alike.items()]
    raise InvalidInputError(subject, "; ".join(lines), "settings as docs/guides/serving.md explains them")


def _of_environment(environment: Mapping[str, str]) -> Iterator[Given]:
    """Yield what variables set, each value in the type of its key, or else as text, which is refused with the rest."""
    longer = {_STORE: f"{_PREFIX}SERVICE__STORE"}
    named = sorted(name for name in environment if name.startswith(_PREFIX) and "__" in name)
    for name in (each for each in sorted(environment) if each.startswith(_PREFIX) and "__" not in each):
        table = next((table for table in TABLES if name.startswith(f"{_PREFIX}{table.upper()}_")), None)
        if table is not None:  # what other programs are told has other names
            start = f"{_PREFIX}{table.upper()}"
            warn(f"environment {name} sets nothing; perhaps {start}__{name.removeprefix(start).lstrip('_')} is meant")
    for variable in (name for name in [*longer, *named] if environment.get(name)):
        table, _, key = longer.get(variable, variable).removeprefix(_PREFIX).lower().partition("__")
        field = TABLES[table].model_fields.get(key) if table in TABLES else None
        kind: Any = str if field is None else field.annotation
        value: Any = environment[variable]
        if get_origin(kind) is tuple:
            value = [part.strip() for part in value.strip("[] ").split(",") if part.strip()]
        with suppress(ValidationError):
            value = TypeAdapter(kind).validate_python(value)
        yield Given(f"environment {variable}", (table, key), value)


def _told(error: ErrorDetails, origins: Mapping[Key, str]) -> tuple[str, str, str]:
    """Return where one wrong setting comes from, what came, and what was wanted."""
    problem = problem_of(ServiceSettings, error)
    key = tuple(map(str, error["loc"][:2]))
    origin = next((origin for given, origin in origins.items() if given[: len(key)] == key), "")
    if problem.kind == "unknown":
        return origin, f"unknown {problem.place}", _meant(*key)
    return origin, f"{problem.place} = {problem.got}", problem.expected


def _meant(table: str, key: str = "") -> str:
    """Return what may have been meant by a key, or a table, that is not there."""
    if table not in TABLES:
        close = get_close_matches(table, TABLES, 1)
        return f"table [{close[0]}]" if close else f"one of the tables {', '.join(TABLES)}"
    keys = TABLES[table].model_fields
    elsewhere = [f"{other}.{key}" for other in TABLES if key in TABLES[other].model_fields]
    close = [f"{table}.{found}" for found in get_close_matches(key, keys, 1)] or elsewhere
    return close[0] if close else f"one of {', '.join(sorted(keys))}"
