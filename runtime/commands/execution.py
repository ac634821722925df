"""Options of commands that decode: bundle, threads, execution provider, batches, and where TensorRT keeps engines."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import click

from lightpage.runtime.commands.provider_option import BATCHES, PROVIDER
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.providers import CPU, Provider


class Load(Protocol):
    """Opens the decoder that the options name."""

    def __call__(self, code_threads: int = 1) -> Decoder:
        """Open it; raises as `Decoder.load` does."""


THREADS = click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
ENGINE_CACHE = click.option(
    "--engine-cache",
    type=click.Path(file_okay=False, path_type=Path),
    envvar="LIGHTPAGE_SERVICE__ENGINE_CACHE",
    show_envvar=True,
    help="Folder where TensorRT keeps its engines; without, it builds them each time, for minutes.",
)


def decoder_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Gives a command these options; it is called with a `Load` as `load` in their place."""

    @click.option("--bundle", default=DEFAULT, show_default=True, help="A bundle's path, or the name of a shipped one.")
    @THREADS
    @PROVIDER
    @BATCHES
    @ENGINE_CACHE
    @click.option(
        "--steps", type=click.IntRange(1), help="Gauss-Newton steps of a page; all that the bundle has if left out."
    )
    @functools.wraps(command)
    def with_decoder(
        *,
        bundle: str,
        threads: int | None,
        provider: str | None,
        batches: int | None,
        engine_cache: Path | None,
        steps: int | None,
        **others: Any,
    ) -> Any:
        chosen = Provider.parse(CPU if provider is None else provider, engine_cache)
        batching = Batching(batches or 1)

        def load(code_threads: int = 1) -> Decoder:
            return Decoder.load(bundle_path(bundle), threads, chosen, batching, code_threads, steps)

        return command(load=load, **others)

    return with_decoder
