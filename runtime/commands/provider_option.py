"""Options that say what computes pages, for commands that decode, and for those that have others decode."""

import click

from lightpage.runtime.model.execution.providers import CPU, WANTED

PROVIDER = click.option(
    "--provider",
    envvar="LIGHTPAGE_SERVICE__PROVIDER",
    show_envvar=True,
    show_default=CPU,
    help=f"Processor that computes pages: {WANTED}.",
)

CODE_THREADS = click.option(
    "--code-threads",
    type=click.IntRange(1, 64),
    envvar="LIGHTPAGE_SERVICE__CODE_THREADS",
    show_envvar=True,
    help="Threads that share the code of a page, where it is compiled; 1 by default.",
)

BATCHES = click.option(
    "--batches",
    type=click.IntRange(1, 64),
    envvar="LIGHTPAGE_BATCHES__LARGEST",
    show_envvar=True,
    help="Pages computed together at most, on a GPU; by default each by itself.",
)
