"""The last steps of every export: a version, and proof with the runtime's own decoder."""

from __future__ import annotations

import shutil
from pathlib import Path

from lightpage.errors import BundleError
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.new_bundle import judged_manifest
from lightpage.runtime.model.bundle.bundle import write_bundle
from lightpage.runtime.model.bundle.manifest import Manifest, check_version
from lightpage.runtime.model.decoding.batch_graph import with_proven_batches
from lightpage.runtime.model.decoding.decoder import Decoder


def check_new(out: Path, version: str | None) -> None:
    """Check the path and the version of a bundle that is to be made.

    Raises:
        BundleError: something is at `out`, or `version` is none.
    """
    if version is not None:
        check_version(version, "--version")
    if out.exists():
        raise BundleError(f"--out {out}", "something that exists", "a new path: bundles are never overwritten")


def proven(
    out: Path, manifest: Manifest, files: dict[str, bytes], recording: Path | None, progress: Progress
) -> tuple[Manifest, dict[str, bytes]]:
    """Load the bundle beside `out` as the service does.

    Returns:
        its manifest, with the code and the verdict of a recording's pages, and its files, those for many pages only if
        they decode.

    Raises:
        RecordingError: the recording is of another device.
        BundleError: the decoder does not say what it should.
    """
    partial = out.with_name(f".{out.stem}-unproven{out.suffix}")
    _remove(partial)
    try:
        write_bundle(partial, manifest, files)
        decoder = Decoder.load(partial)
        files = dict(with_proven_batches(decoder.bundle, decoder.graph).files)
        if recording is not None:
            with Recording.open(recording) as pages:
                manifest = judged_manifest(decoder, pages, manifest, progress)
    finally:
        _remove(partial)
    return manifest, files


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
