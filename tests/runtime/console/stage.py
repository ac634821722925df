"""A service of toy pages with a console beside it."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

from lightpage.errors import LostPageError, LostShotError, Reason
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.console.actions import Actions
from lightpage.runtime.console.application import Route, console_routes
from lightpage.runtime.console.last_pages import LastPages
from lightpage.runtime.console.server import serving
from lightpage.runtime.console.state import ConsoleState
from lightpage.runtime.device.acquisition.source import SHOT_S, Shot
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.pages.reading import read_page
from lightpage.runtime.service.server.certificates import Certificates
from tests.runtime import toy


class Losing(toy.ToySource):
    """Every fifth page is a lost shot."""

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        found = super().shot(timeout_s, page)
        if found.page_index % 5 == 4:
            raise LostShotError(f"page {found.page_index}", "no frame", "two frames", Reason.MISSING_FRAME)
        return found


@dataclass
class Stage:
    plane: DataPlane
    state: ConsoleState
    routes: list[Route]
    port: int
    url: str
    close: Callable[[], None]

    def read(self, pages: int) -> None:
        for _ in range(pages):
            with suppress(LostPageError):
                read_page(self.plane, None, None, Caller())


@contextmanager
def stage(decoder: Decoder, tls: TlsFiles | None = None) -> Iterator[Stage]:
    last_pages, monitor, metrics = LastPages(), Monitor(), ServiceMetrics()
    registry = Models(decoder)
    plane = DataPlane(registry, Losing(toy.ToyDevice()), metrics=metrics, observers=[last_pages], monitor=monitor)
    recalibrator = Recalibrator(plane, toy.fit_references)
    state = ConsoleState(last_pages, registry, monitor, "toy:device", Actions(plane, recalibrator))
    routes = console_routes(state, metrics.registry)
    with ExitStack() as stack:
        port = stack.enter_context(serving(routes, 0, certificates=None if tls is None else Certificates(tls)))
        yield Stage(plane, state, routes, port, f"http{'s' if tls else ''}://localhost:{port}", stack.close)
