"""A fit that waits for leave to go on."""

import threading
from dataclasses import dataclass, field

from lightpage.progress import Progress
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RefitResult
from tests.runtime import toy


@dataclass
class SlowFit:
    """Fits the toy device once `go` is set; tells of a step now and then, at which it can be stopped."""

    entered: threading.Event = field(default_factory=threading.Event)
    go: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)

    def __call__(self, bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
        self.entered.set()
        try:
            while not self.go.wait(0.01):
                progress("wait", 0.1)
            return toy.fit_references(bundle, pages, progress, decoder)
        finally:
            self.ended.set()
