"""Lets callers in: the endpoint of a service, the memory that it shares, its health, and what begins work by itself."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from lightpage.runtime.client.shared_memory import memory_path
from lightpage.runtime.client.wire.address import check_free, is_local
from lightpage.runtime.service.assembly import Assembly
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration
from lightpage.runtime.service.models.incoming import Incoming
from lightpage.runtime.service.monitoring.traces import Traces
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.health_server import HealthServer, next_port
from lightpage.runtime.service.server.server import LightpageServer
from lightpage.runtime.service.settings import OFF, ServiceSettings
from lightpage.runtime.service.shared_memory import SharedMemory


@dataclass(frozen=True)
class Endpoints:
    """The addresses of a service.

    Attributes:
        target: address for calls.
        health: address for health checks; None where they are off.
    """

    target: str
    health: str | None


@contextmanager
def listening(settings: ServiceSettings, assembly: Assembly, certificates: Certificates | None) -> Iterator[Endpoints]:
    """Yield where a service is reached, which listens until the end.

    Args:
        settings, assembly: the service.
        certificates: certificates with which it meets its callers; None for no TLS.

    Raises:
        InvalidInputError: an address cannot be listened on.
    """
    service, plane, recalibrator = settings.service, assembly.plane, assembly.recalibrator
    with ExitStack() as stack:
        traces = health = None
        if settings.traces.endpoint is not None:
            traces = stack.enter_context(Traces(settings.traces.endpoint, settings.traces.share))
        server = LightpageServer(
            plane,
            recalibrator,
            service.address,
            certificates=certificates,
            inference=settings.inference.enabled,
            traces=traces,
        )
        check_free("address", service.address)  # before anything else takes a port
        if service.shared_memory:
            limits, path = settings.limits, memory_path(service.address)
            memory = SharedMemory(path, limits.shared_bytes, limits.shared_regions, limits.stall_s)
            plane.shared = stack.enter_context(memory)
        if service.health_address != OFF:  # entered first: it says NOT_SERVING until the last call has ended
            address = service.health_address or next_port(service.address)
            plain = settings.tls.plain_health or (is_local(address) and service.health_address is None)
            files = None if plain else settings.tls.files()
            health = stack.enter_context(HealthServer(address, server.health, files)).target
        stack.enter_context(server)
        if service.incoming is not None:
            stack.enter_context(Incoming(plane.models, plane.limits.model_bytes, plane.uploads, service.incoming))
        if (own := settings.self_calibration).is_on:
            stack.enter_context(SelfCalibration(plane, assembly.monitor, recalibrator, own, kept=assembly.kept))
        yield Endpoints(server.target, health)
