"""Measure how fast and how exactly a GPU decodes pages in batches, and where its time goes.

    python -m analysis.gpu.bench --out runs/bench-gpu

Kept decoders of the full-size page are put into their batched form, and decode pages that are simulated here. One of
them becomes a bundle, which a service and `lightpage bulk` read pages with. What is measured is kept part by part in
`gpu.json`, with the card's name; no part is begun that would end behind `--seconds`, and the same command goes on with
the next. The table has every target with its verdict; that of two CPU cores is `python -m analysis.speed.speed`'s.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from analysis.gpu.kept_parts import Kept
from analysis.gpu.targets import TRAVELS_MB, table
from lightpage.cli.main import run
from lightpage.errors import ProviderError
from lightpage.metrics.provenance import PROVENANCE, provenance
from lightpage.runtime.model.execution.providers import CPU, CUDA, Provider
from lightpage.runtime.model.execution.session import check_provider

_ROOT = Path(__file__).resolve().parents[2]
_SOURCES = ("lightpage", "runtime", "train", "export", "analysis", "proto")
_ENVIRONMENT = "an environment of its own with `pip install '.[gpu,train]'`, which `make bench-gpu` makes"


def check_machine(provider: Provider) -> str:
    """Check that onnxruntime and torch have the provider, and return the card's name.

    Raises:
        ProviderError: one of them has it not.
    """
    try:
        check_provider(provider)
    except ProviderError as error:
        raise ProviderError(error.subject, error.got, _ENVIRONMENT) from None
    import torch  # behind the first check, which says more where both are missing

    if provider.name == CPU:
        return CPU
    if not torch.cuda.is_available():
        got = f"torch {torch.__version__}, which sees no GPU"
        raise ProviderError(f"provider {provider}", got, f"an NVIDIA GPU, its driver, and {_ENVIRONMENT}")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    return torch.cuda.get_device_name(provider.device)


def travels(kept: Path, library: Path | None) -> dict[str, Any]:
    """Megabytes that a bare machine must be sent; there is a sum if ONNX Runtime's archive is among them."""
    sources = [
        path for name in _SOURCES for path in (_ROOT / name).rglob("*") if path.suffix in (".py", ".toml", ".c", ".h")
    ]
    files = {path.resolve(): path.stat().st_size for path in (*sources, *kept.rglob("*")) if path.is_file()}
    found: dict[str, Any] = {"program_and_weights": sum(files.values()) / 1e6}
    if library is not None:
        found["library"] = library.stat().st_size / 1e6
        found["megabytes"] = sum(found.values())
        found["most"] = TRAVELS_MB
    return found


@click.command()
@click.option(
    "--kept",
    "folder",
    default=Path("analysis/weights/paper/-0.6deg-32e-4px"),
    show_default=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of a data set with kept decoders.",
)
@click.option("--preset", "presets", multiple=True, default=("standard", "fast", "accurate"), show_default=True)
@click.option("--reflections", default=4, show_default=True, help="Rounds to the field of the slower presets.")
@click.option("--batch", "batches", multiple=True, type=int, default=(8, 1), show_default=True, help="Pages a batch.")
@click.option("--provider", default=CUDA, show_default=True, type=click.Choice([CUDA, CPU]))
@click.option("--seconds", default=480.0, show_default=True, help="Longest time of everything.")
@click.option("--served", default=16, show_default=True, help="Pages a batch of the service and of bulk.")
@click.option("--pages", "simulated", type=click.Path(path_type=Path), help="Folder for simulated pages; --out's.")
@click.option("--library", type=click.Path(path_type=Path, exists=True), help="ONNX Runtime's archive, if it is sent.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder for gpu.json.")
def main(
    folder: Path,
    presets: tuple[str, ...],
    reflections: int,
    batches: tuple[int, ...],
    provider: str,
    seconds: float,
    served: int,
    simulated: Path | None,
    library: Path | None,
    out: Path,
) -> None:
    """Measure the batched forms of kept decoders."""
    chosen = Provider.parse(provider)
    card = check_machine(chosen)
    from analysis.gpu.course import Course  # it needs torch, which has just been looked for

    for path in (out, simulated or out):
        path.mkdir(parents=True, exist_ok=True)
    kept = Kept(out / "gpu.json", {"card": card, PROVENANCE: provenance(weights=folder).to_json()}, seconds)
    kept.parts["travels"] = travels(folder, library)
    course = Course(kept, folder, chosen, reflections, simulated or out)
    for preset in presets:
        course.measure(preset, batches)
    course.measure_product(served, out)
    click.echo("\n".join(table(kept.parts, course.page)))
    click.echo(f"{kept.path}: {seconds - kept.left_s:.0f} s")
    if kept.left_out:
        click.echo(f"left for another run of the same command: {'; '.join(kept.left_out)}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.gpu.bench"))
