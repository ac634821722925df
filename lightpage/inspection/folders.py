"""Looks at folders, and at bundles, which may be one: a training run, a bulk run, pictures."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from itertools import islice
from pathlib import Path
from typing import Any

from lightpage.calibration.sampling_table import APART
from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import InvalidInputError
from lightpage.failures import os_errors
from lightpage.files import read_text
from lightpage.foreign.array import readable
from lightpage.foreign.pictures import SUFFIXES
from lightpage.inspection.documents import MOST_BYTES
from lightpage.inspection.finding import Fact, Finding, printable
from lightpage.inspection.foreign_files import look_at_array
from lightpage.run_files import BEGUN, DESCRIPTION
from lightpage.runtime.archives.run.job import FILE as JOB
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import MANIFEST

_MOST_ENTRIES = 10_000
_READ_WHOLE = 64 << 20
"""A bundle up to this size is read whole, so that its hashes are checked."""
_TOLD = 8


def look_at_folder(path: Path, profile: Profile | None) -> Finding:
    """Return what a folder is; what lies in folders below it is not looked at.

    Raises:
        InvalidInputError: it cannot be read, or holds nothing that is known here.
    """
    with os_errors(f"folder {path}", "a folder that can be read"), os.scandir(path) as entries:
        names = sorted(entry.name for entry in islice(entries, _MOST_ENTRIES))
    if MANIFEST in names:
        return look_at_bundle(path)
    if BEGUN in names or DESCRIPTION in names:
        return _run(path, DESCRIPTION in names)
    if JOB in names:
        found = Finding(path, "bulk run")
        found.next.append(f"lightpage report {found.quoted} --out F.html")
        return found
    if any(Path(name).suffix.lower() in SUFFIXES for name in names):
        return look_at_array(path, "folder of pictures", profile)
    told = ", ".join(map(printable, names[:_TOLD])) or "nothing"
    expected = (
        "a bundle, a run, or pictures: lightpage inspect FILE for one in it"
        if names
        else "a bundle, a run, or pictures"
    )
    raise InvalidInputError(f"folder {path}", told, expected)


def look_at_bundle(path: Path) -> Finding:
    """Return what a bundle is, a folder or a zip."""
    found = Finding(path, "bundle")
    with found.trying("a bundle that is whole"):
        size = path.stat().st_size if path.is_file() else sum(each.stat().st_size for each in path.iterdir())
        found.facts["size"] = Fact({"bytes": size}, f"{size / 1e6:.1f} MB")
        if size > _READ_WHOLE:
            found.facts["checked"] = "not whole: evaluate reads all of it"
            return found
        bundle = Bundle.open(path)
        manifest = bundle.manifest
        found.profile = bundle.profile
        rows, columns = bundle.profile.frame_shape
        found.facts |= {
            "version": manifest.version,
            "made": manifest.created,
            "profile": bundle.profile.name,
            "frames": Fact(
                {"rows": rows, "columns": columns, "type": manifest.frame_dtype},
                f"{rows} x {columns}, {manifest.frame_dtype}",
            ),
            "decoder": "fitted waves" if bundle.is_estimator else "network",
            "planes": planes_of(manifest.table_inputs),
            "code": "none" if bundle.code is None else bundle.code.describe(),
            "files": Fact(sorted(manifest.files), ", ".join(sorted(manifest.files))),
            **{name.replace("_", " "): value for name, value in list(manifest.metrics.items())[:_TOLD]},
        }
        if bundle.is_estimator:
            found.facts["calibration"] = bundle.calibration.verdict_sentence or "not judged"
        golden = bundle.golden
        found.pictures = lambda: [
            ("golden page, in-phase", golden.pair.in_phase, "counts"),
            ("golden page, quadrature", golden.pair.quadrature, "counts"),
        ]
    found.next += [
        f"lightpage evaluate --bundle {found.quoted} --recording R.h5",
        f"lightpage serve --bundle {found.quoted} --source recording:R.h5 --address 127.0.0.1:50051",
    ]
    return found


def planes_of(inputs: Collection[str]) -> str:
    """Say which planes of the cameras the graphs of a bundle allow for, by the inputs of their table.

    A recalibration fits places and tilts within these, and adds none.
    """
    common, _, tilted = (name in inputs for name in APART)
    if tilted:
        return "each camera its own, tilted against the other's"
    return "each camera its own" if common else "one for both cameras"


def _run(path: Path, finished: bool) -> Finding:
    found = Finding(path, "training run" if finished else "unfinished training run")
    name = DESCRIPTION if finished else BEGUN
    told = _object(path / name)
    with found.trying("the description of a run"):
        text = told.get("profile_toml") or told.get("--profile")
        found.profile = None if text is None else parse_profile(text, f"{path / name}: profile")
        if finished:
            trained, validated, left = told["pages"]
            found.facts |= {
                "localizer": told["localizer"],
                "profile": "none" if found.profile is None else found.profile.name,
                "pages": Fact(
                    {"trained": trained, "validated": validated, "left": left},
                    f"{trained} trained on, {validated} validated, {left} left for evaluate",
                ),
                "validation AIR": Fact(told["validation_air"], f"{told['validation_air']:.3f} bit a symbol"),
            }
    if finished:
        found.next += [
            f"lightpage export {found.quoted} --recording R.h5 --out B.zip",
            f"lightpage report {found.quoted} --out RUN.html",
        ]
    else:
        found.problems.append("not finished: the same command of lightpage train goes on with it")
    return found


def _object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        InvalidInputError: it is too large, or no JSON object.
    """
    subject, expected = f"file {path}", "a JSON object"
    with readable(subject, expected):
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            raise InvalidInputError(subject, "no file, or a larger one", f"at most {MOST_BYTES >> 20} MiB of JSON")
        told = json.loads(read_text(path, subject, expected))
    if not isinstance(told, dict):
        raise InvalidInputError(subject, type(told).__name__, expected)
    return told
