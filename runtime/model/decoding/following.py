"""A decoder that follows its device's image from page to page, for who calls it from Python."""

from functools import cached_property
from pathlib import Path

from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import DecodedPage, StepLimit
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker
from lightpage.runtime.model.execution.page_graph import check_steps
from lightpage.runtime.model.execution.providers import ON_CPU, Provider


class FollowingDecoder(Decoder):
    """The decoder of a bundle that gives out no page that its pilots contradict, as the service does.

    Pages of one device are decoded best in the order in which they were recorded. Where the image is lost, it is looked
    for, so another order or another recording of the device costs time alone.

    Args:
        bundle: opened and checked.
        threads: number of threads of an inference; all cores if None.
        provider: provider that computes the graph.
        tracking: whether the image is followed; else each page is decoded where calibration saw it.
        steps: largest number of Gauss-Newton steps of a page; see `Decoder`.

    Raises:
        ProviderError, BundleError: see `Decoder`.
    """

    def __init__(
        self,
        bundle: Bundle,
        threads: int | None = None,
        provider: Provider = ON_CPU,
        *,
        tracking: bool = True,
        steps: int | None = None,
    ) -> None:
        super().__init__(bundle, threads, provider=provider, steps=steps)
        self._tracking = tracking

    @cached_property
    def tracker(self) -> Tracker:
        """Return what follows the image."""
        decoder = Decoder(self.bundle, self.threads, self.graph, steps=self.steps)
        return tracker_for(decoder) if self._tracking else NoTracker(decoder)

    def decode(
        self, pair: FramePair, levels: int = 256, pilots: Pilots | None = None, limit: StepLimit | None = None
    ) -> DecodedPage:
        """Decode a frame pair into symbols of `levels` levels.

        Args:
            pair: frames of the page.
            levels: M of the page.
            pilots: known symbols, where they are others than the bundle's.
            limit: limit on the time of an estimator's steps.

        Raises:
            UnconfirmedPageError: the page's pilots contradict what was decoded.
            FrameError, PageError: see `Decoder.decode`.
        """
        return self.tracker.decode(pair, levels, pilots, limit=limit)


def load(
    name_or_path: str | Path,
    threads: int | None = None,
    provider: str = "cpu",
    engine_cache: str | Path | None = None,
    *,
    tracking: bool = True,
    steps: int | None = None,
) -> FollowingDecoder:
    """Return a bundle's decoder: it follows the image from page to page, and raises where pilots contradict a page.

    Args:
        name_or_path: path of a bundle, or the name of a shipped one.
        threads: number of threads of an inference; by default all cores.
        provider: what pages are computed with: ``cpu``, ``cuda``, ``tensorrt``, or ``cuda:1`` for the second GPU.
        engine_cache: folder where TensorRT keeps its engines; without, it builds them each time.
        tracking: whether the image is followed; else each page is decoded where calibration saw it.
        steps: Gauss-Newton steps of a page, where the bundle is of a calibration alone; by default all that it has.
            Fewer take less time and read less.

    Raises:
        BundleError: there is none, or it is damaged.
        InvalidInputError: the text names no provider, or one that keeps no engines; or more steps than the bundle has.
        ProviderError: there is no such provider here.
    """
    cache = None if engine_cache is None else Path(engine_cache)
    bundle = Bundle.open(bundle_path(str(name_or_path)))
    check_steps(bundle, steps)
    return FollowingDecoder(bundle, threads, Provider.parse(provider, cache), tracking=tracking, steps=steps)
