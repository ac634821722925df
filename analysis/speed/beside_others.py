"""Times commands beside one busy process for each core, over the same with one thread.

`python -m analysis.speed.beside_others` prints both ratios of `lightpage simulate`, and with `--recording` those of
`calibrate`, `train` and `evaluate` too.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

import click

from lightpage.cli.options import FiniteRange
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_BUSY = "import os, sys\nwhile os.getppid() == int(sys.argv[1]):\n    sum(range(100_000))"


@contextmanager
def busy_cores(processes: int | None = None) -> Iterator[None]:
    """Keep cores busy while the `with` statement lasts, with so many processes; by default one for each core."""
    with ExitStack() as stack:
        for _ in range(processes or len(os.sched_getaffinity(0))):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", _BUSY, str(os.getpid())]))
            stack.callback(process.kill)
        yield


def timed(words: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Time a command: seconds, and seconds of CPU time.

    Raises:
        subprocess.CalledProcessError: it fails.
    """
    kept = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "lightpage.cli.main", *words],
        env=kept | environment,
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        timeout=3600,
    )
    seconds, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def commands(folder: Path, pages: int, recording: Path | None) -> dict[str, list[str]]:
    """Commands that are timed, by name."""
    made = {"simulate": f"simulate --profile bench --pages {pages} --force --out {folder}/S.h5".split()}
    if recording is not None:
        known = f"--profile bench --recording {recording}"
        made["calibrate"] = f"calibrate {known} --out {folder}/C.toml".split()
        made["train"] = (
            f"train {known} --calibration {folder}/C.toml --preset standard --steps 20 --synthetic-pages 0 "
            f"--test-share 0.2 --out {folder}/run"
        ).split()
        made["evaluate"] = f"evaluate --recording {recording}".split()
    return made


@click.command()
@click.option("--pages", default=2, show_default=True, type=click.IntRange(1), help="Simulated in a run.")
@click.option(
    "--rounds", default=3, show_default=True, type=click.IntRange(1), help="Rounds of each command, either way."
)
@click.option(
    "--recording", type=click.Path(path_type=Path, exists=True), help="Recording of a bench device, for the others."
)
@click.option("--limit", default=1.2, show_default=True, type=FiniteRange(0), help="Ratio that is wanted.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(pages: int, rounds: int, recording: Path | None, limit: float, json_path: Path | None) -> None:
    """Time commands beside busy processes."""
    figures: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name, busy_cores():
        for command, words in commands(Path(name), pages, recording).items():
            ratios = []
            for _ in track(range(rounds), command, unit="round"):
                subprocess.run(["rm", "-rf", f"{name}/run"], check=True)
                own = timed(words, {})
                subprocess.run(["rm", "-rf", f"{name}/run"], check=True)
                one = timed(words, ONE_THREAD)
                ratios.append((own[0] / one[0], own[1] / one[1]))
            time_ratio, cpu_ratio = (median(each) for each in zip(*ratios, strict=True))
            figures[command] = {"time": time_ratio, "cpu_time": cpu_ratio}
            click.echo(f"{command:<10} time {time_ratio:.2f}, CPU time {cpu_ratio:.2f} (wanted <= {limit:g})")
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    main()
