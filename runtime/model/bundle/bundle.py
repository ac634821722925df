"""Bundles: one immutable, hashed set of files that decodes one device, read with suspicion and written in one piece."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.codec.code import Code, parse_code
from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import BundleError, CalibrationError, InvalidInputError, ProfileError, raised_as
from lightpage.failures import os_errors, os_failure
from lightpage.files import move_to_new_name, sync_folder, synchronise
from lightpage.metrics.information import decide
from lightpage.page.levels import Levels, check_levels
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.page.symbols import pilot_mask, pilot_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.archive import MAX_BYTES, MAX_FILES, check_name, read_files
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    ESTIMATOR_FILES,
    GOLDEN,
    MANIFEST,
    OPTIONAL_FILES,
    PILOTS,
    REQUIRED_FILES,
    TABLE,
    TWIN,
    Manifest,
    check_version,
    parse_manifest,
    sha256,
)
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.bundle.signature_file import read_signature

if TYPE_CHECKING:
    from lightpage.calibration.document import Calibration

MAX_ARRAY_BYTES = MAX_BYTES
"""All arrays of one .npz file, unpacked: it is compressed by itself, and may be a bomb inside a small bundle."""

MAX_MANIFEST_BYTES = 16 << 20
"""A manifest that is read alone: a recalibration a minute for a year makes half of that."""

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Fixed time in the zip, so that the same contents give the same bytes."""

_LEAST_CONTRAST = 2.0
"""Residual of swapped frames over that of right ones below which the two cannot be told apart by it."""
_SIDE_PX = 2
"""Side of the blocks of pixels that get one count: a sample of the usual grid, which still has all fringes."""
_COARSE_SHARE = 0.6
"""Of the residual's limit, that frames in few counts may come to. The bench device's come to 0.47 where its field is
recovered by descent, and to 0.53 by reflections."""
_COUNTS = 32
"""Counts that are left of a camera's. At 15,000 electrons a step is about four times a bright pixel's own noise."""
_ROOTS = 16
"""Values that are left of the roots of a camera's counts. At 15,000 electrons a step is about five times the noise."""


@dataclass(frozen=True)
class Golden:
    """A frame pair and the decoder's expected answer p, float32 [2, ny, nx].

    Its frames are stored in few counts: they prove what a runtime computes, not how well a page reads.
    """

    pair: FramePair
    p: NDArray[np.float32] = field(repr=False)


@dataclass(frozen=True, repr=False)
class Bundle:
    """A bundle whose files match their hashes. `Decoder` checks its decoder and runs its golden page;
    `lightpage.runtime.model.execution.twin.OnnxTwin` checks the twin, where it is needed.

    Attributes:
        path: folder or zip that it was read from.
        manifest: facts of the bundle and hashes of its files.
        files: contents of the others by name.
        digest: SHA-256 of the manifest as it is written, and so of all of the bundle.
    """

    path: Path
    manifest: Manifest
    files: Mapping[str, bytes]
    digest: str

    def __repr__(self) -> str:
        return f"<Bundle {self.path}, {self.version}, of {self.manifest.created}>"

    @classmethod
    def open(cls, path: str | Path, key: BundleKey | None = None, signature: bytes = b"") -> Bundle:
        """Read the folder or zip at `path` and check every file against the manifest.

        Args:
            path: path of the bundle.
            key: key that a zip must be signed with; None for any or none.
            signature: signature of the zip; empty for that in the file beside it.

        Raises:
            BundleError: a missing, extra, changed or misplaced file, a newer schema, or no bundle at all; or with a
                key, no zip that is signed with it.
        """
        path = Path(path)
        content = None if key is None else _signed(path, key, signature or read_signature(path))
        files = read_files(path, content)
        subject = f"bundle {path}"
        if MANIFEST not in files:
            raise BundleError(subject, f"no {MANIFEST}", f"a bundle with its {MANIFEST}")
        written = files.pop(MANIFEST)
        manifest = parse_manifest(written, f"{subject}: {MANIFEST}")
        _check_listing(set(manifest.files), subject)
        for name in sorted(set(manifest.files) | set(files)):
            if name not in files:
                raise BundleError(f"{subject}: {name}", "nothing", "the file that the manifest lists")
            if name not in manifest.files:
                raise BundleError(f"{subject}: {name}", "a file that the manifest does not list", "listed files only")
            if (found := sha256(files[name])) != manifest.files[name]:
                raise BundleError(f"{subject}: {name}", f"SHA-256 {found}", manifest.files[name])
        return cls(path, manifest, files, sha256(written))

    @property
    def subject(self) -> str:
        """Return what an error about this bundle calls it."""
        return f"bundle {self.path}"

    @property
    def version(self) -> str:
        """The version string that replies carry."""
        return self.manifest.version

    @property
    def is_estimator(self) -> bool:
        """True for a bundle of a calibration alone: pages are estimated by the fitted waves, without a network."""
        return self.files.keys() >= set(ESTIMATOR_FILES)

    @cached_property
    def profile(self) -> Profile:
        """The nominal device.

        Raises:
            BundleError: the manifest's profile does not validate.
        """
        with raised_as(BundleError, ProfileError):
            return parse_profile(self.manifest.profile, f"{self.subject}: profile")

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration that the bundle was made with.

        Raises:
            CalibrationError: its text is no calibration of its profile.
        """
        from lightpage.calibration.document import parse_calibration

        with raised_as(CalibrationError, ProfileError):
            calibration = parse_calibration(self.manifest.calibration, f"{self.subject}: calibration")
            calibration.check_profile(self.profile)
        return calibration

    @cached_property
    def modulation(self) -> Modulation:
        """Return what the modulator makes of its levels; nominal where the calibration does not tell.

        Raises:
            CalibrationError: see `calibration`.
        """
        # a document that tells nothing of it need not be read, which takes modules that decoding does without
        return self.calibration.modulator if "\n[modulation]" in self.manifest.calibration else NOMINAL

    def levels(self, count: int) -> Levels:
        """So many levels of a page, as this device shows them.

        Raises:
            CalibrationError: see `calibration`.
            PageError: a level count outside 2..256.
        """
        return self.modulation.page_levels(count)

    @cached_property
    def table(self) -> SamplingTable:
        """Re-traced tensors that replace the graph's defaults, by input name; empty where there are none.

        Raises:
            BundleError: unreadable, or names that are no table input.
        """
        if TABLE not in self.files:
            return {}
        return self._arrays(TABLE, self.manifest.table_inputs)

    @cached_property
    def golden(self) -> Golden:
        """The golden page.

        Raises:
            BundleError: unreadable or incomplete.
        """
        names = ("in_phase", "quadrature", "p")
        arrays = self._arrays(GOLDEN, names)
        if missing := set(names) - set(arrays):
            raise BundleError(f"{self.subject}: {GOLDEN}", f"no {', '.join(sorted(missing))}", f"all of {list(names)}")
        return Golden(FramePair(arrays["in_phase"], arrays["quadrature"]), arrays["p"])

    @cached_property
    def pilot_mask(self) -> NDArray[np.bool_]:
        """Return where this device's pages carry pilots, [ny, nx]: the bundle's own positions, or else the profile's.

        Raises:
            BundleError: the bundle's positions have another shape or type.
        """
        if PILOTS not in self.files:
            return pilot_mask(self.profile)
        mask = self._pilots.get("mask")
        if mask is None or mask.shape != self.profile.page_shape or mask.dtype != np.bool_ or not mask.any():
            got = "nothing" if mask is None else f"{mask.dtype} {mask.shape}, {np.count_nonzero(mask)} pilots"
            raise BundleError(f"{self.subject}: {PILOTS}: mask", got, f"bool {self.profile.page_shape} with pilots")
        return mask

    @cached_property
    def pilot_phases(self) -> NDArray[np.float32] | None:
        """The device's own fixed pilots as nominal phases, radians, one a True of `pilot_mask` in row order.

        None where the pilots follow the profile's seeded pattern.

        Raises:
            BundleError: another number of phases, another type, or values that are not finite.
        """
        phases = self._pilots.get("phases")
        if phases is None:
            return None
        subject, count = f"{self.subject}: {PILOTS}: phases", int(np.count_nonzero(self.pilot_mask))
        if phases.shape != (count,) or phases.dtype != np.float32:
            raise BundleError(subject, f"{phases.dtype} {phases.shape}", f"float32 ({count},), one a pilot")
        if not np.isfinite(phases).all():
            raise BundleError(subject, "NaN or infinity", "finite numbers")
        return phases

    @cached_property
    def earlier_codes(self) -> tuple[Code, ...]:
        """Codes that the device's pages were written with before, the oldest first.

        Raises:
            BundleError: one of the manifest's earlier codes does not validate.
        """
        with raised_as(BundleError, InvalidInputError):
            subject = f"{self.subject}: earlier codes"
            return tuple(parse_code(text, subject) for text in self.manifest.earlier_codes)

    @cached_property
    def code(self) -> Code | None:
        """Return how user bytes are protected on this device's pages, None where that was not chosen.

        Raises:
            BundleError: the manifest's code does not validate.
        """
        if self.manifest.code is None:
            return None
        with raised_as(BundleError, InvalidInputError):
            return parse_code(self.manifest.code, f"{self.subject}: code")

    def written_pilots(self, levels: int) -> NDArray[np.uint8]:
        """Levels of the pilots on pages that are written for this device, in row order, uint8 [pilots].

        The device's own phases, each to its nearest level, or else the profile's seeded pattern.

        Raises:
            BundleError: see `pilot_mask` and `pilot_phases`.
            PageError: a level count outside 2..256.
        """
        if self.pilot_phases is None:
            return pilot_symbols(self.profile, levels)[self.pilot_mask]
        check_levels(levels)
        return decide(self.pilot_phases, levels)

    @cached_property
    def _pilots(self) -> dict[str, NDArray[Any]]:
        return self._arrays(PILOTS, ("mask", "phases")) if PILOTS in self.files else {}

    def _arrays(self, name: str, expected: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The arrays of one .npz file, each at most once and none but those `expected`, bounded before any is unpacked.

        zipfile reads no more of a member than the size in its header, so those sizes bound what is unpacked.
        """
        subject = f"{self.subject}: {name}"
        try:
            with zipfile.ZipFile(io.BytesIO(self.files[name])) as archive:
                entries = archive.infolist()
            found = [entry.filename for entry in entries]
            if set(found) - {f"{key}.npy" for key in expected} or len(found) != len(set(found)):
                raise BundleError(subject, f"members {found[:MAX_FILES]}", f"{list(expected)} only, each once, as .npy")
            if (size := sum(entry.file_size for entry in entries)) > MAX_ARRAY_BYTES:
                raise BundleError(subject, f"{size} bytes unpacked", f"at most {MAX_ARRAY_BYTES}")
            with np.load(io.BytesIO(self.files[name]), allow_pickle=False) as arrays:
                return {key: arrays[key] for key in arrays.files}
        except BundleError:
            raise
        except Exception as error:  # numpy and zipfile raise many kinds on damaged data
            raise BundleError(subject, error, "arrays in .npz format") from None


def read_manifest(path: Path) -> Manifest:
    """The manifest of the zip at `path`, whose other files are not looked at.

    Raises:
        BundleError: no bundle, or a damaged one.
    """
    subject = f"bundle {path}"
    try:
        with zipfile.ZipFile(path) as archive, archive.open(MANIFEST) as file:
            text = file.read(MAX_MANIFEST_BYTES + 1)
    except Exception as error:  # zipfile raises many kinds on damaged data
        raise BundleError(subject, error, f"a zip with its {MANIFEST}") from None
    if len(text) > MAX_MANIFEST_BYTES:
        raise BundleError(f"{subject}: {MANIFEST}", f"more than {MAX_MANIFEST_BYTES} bytes", "a shorter one")
    return parse_manifest(text, f"{subject}: {MANIFEST}")


def residual_limit(right: float, swapped: float) -> float | None:
    """Half way, in ratio, between the residuals of right and of swapped frames; None where both are alike."""
    return float(np.sqrt(right * swapped)) if swapped > _LEAST_CONTRAST * right else None


def shows_page(coarse: float, limit: float) -> bool:
    """Return whether coarse frames still fit the homodyne equations well enough to hold a page.

    Args:
        coarse: residual of the frames `in_few_counts`.
        limit: largest residual of a pair that the bundle decodes.

    Returns:
        Whether `coarse` leaves room below the limit: the image is also looked for off its place.
    """
    return coarse <= _COARSE_SHARE * limit


def in_few_counts(pair: FramePair, bit_depth: int) -> FramePair:
    """Means of blocks of 2 x 2 pixels, each one of 32 counts: compressed, they take about a sixth of the room.

    Args:
        pair: counts [H, W].
        bit_depth: bits of a count, 8 to 16.

    Returns:
        Frames of the same shapes and types, none of them black or at full scale.
    """
    step = (1 << bit_depth) // _COUNTS
    return FramePair(_coarse(pair.in_phase, step), _coarse(pair.quadrature, step))


def in_few_roots(pair: FramePair, bit_depth: int, rows: int = 1) -> FramePair:
    """Counts whose roots are rounded to one of 16: the rounding is the same share of each pixel's shot noise.

    Args:
        pair, bit_depth: see `in_few_counts`.
        rows: number of neighbouring pixels of a column that get their mean.

    Returns:
        Frames of the same shapes and types. Compressed, they take about a third of the room, or a sixth by two rows.
    """
    step = np.sqrt(1 << bit_depth) / _ROOTS

    def rounded(frame: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
        height, width = frame.shape
        whole = np.pad(frame, ((0, -height % rows), (0, 0)), mode="edge")
        means = whole.reshape(-1, rows, width).mean(axis=1)
        roots = step * (np.floor(np.sqrt(means) / step) + 0.5)
        return np.asarray(np.round(roots**2), dtype=frame.dtype).repeat(rows, axis=0)[:height]

    return FramePair(rounded(pair.in_phase), rounded(pair.quadrature))


COARSE = (in_few_counts, partial(in_few_roots, rows=2), in_few_roots)
"""Coarse forms of a golden page's frames, the smallest first; the first one that `shows_page` is kept."""


def _coarse(frame: NDArray[np.integer[Any]], step: int) -> NDArray[np.integer[Any]]:
    rows, columns = frame.shape
    whole = np.pad(frame, ((0, -rows % _SIDE_PX), (0, -columns % _SIDE_PX)), mode="edge")
    blocks = whole.reshape(whole.shape[0] // _SIDE_PX, _SIDE_PX, whole.shape[1] // _SIDE_PX, _SIDE_PX)
    means = blocks.sum(axis=(1, 3), dtype=np.uint32) // _SIDE_PX**2
    rounded = np.asarray(means // step * step + step // 2, dtype=frame.dtype)
    return np.ascontiguousarray(rounded.repeat(_SIDE_PX, 0).repeat(_SIDE_PX, 1)[:rows, :columns])


def npz(**arrays: Any) -> bytes:
    """Arrays as the bytes of a compressed .npz file, for `write_bundle`."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def write_bundle(path: str | Path, manifest: Manifest, files: Mapping[str, bytes]) -> Path:
    """Write a bundle in one step: whoever looks sees all of it or nothing. It is on the disk when this returns.

    Args:
        path: a zip where it ends in .zip, else a folder; must not exist.
        manifest: `files` in it is ignored and filled with the hashes.
        files: contents by name, without the manifest.

    Returns:
        `path`.

    Raises:
        BundleError: something is at `path` already, a required file is missing, a name is not allowed, or the manifest
            could not be read again.
    """
    path = Path(path)
    subject = f"bundle {path}"
    _check_listing(set(files), subject)
    if path.exists() or path.is_symlink():
        raise BundleError(subject, "something that exists", "a new path: bundles are never overwritten")
    full = manifest.model_copy(update={"files": {name: sha256(data) for name, data in files.items()}})
    # A manifest changed by `model_copy` has not been validated, and a bundle that cannot be read must not be written.
    check_version(full.version, f"{subject}: version")
    parse_manifest(full.to_json(), f"{subject}: {MANIFEST}")
    contents = {MANIFEST: full.to_json(), **dict(sorted(files.items()))}
    with os_errors(subject, "a folder that can be written", BundleError):
        path.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{path.name[:100]}-", dir=path.parent))
    try:
        if path.suffix == ".zip":
            _write_zip(work / "bundle.zip", contents)
            move_to_new_name(work / "bundle.zip", path)
        else:
            folder = work / "bundle"
            folder.mkdir()
            for name, data in contents.items():
                _write_file(folder / name, data)
            sync_folder(folder)
            os.rename(folder, path)
        sync_folder(path.parent)
    except OSError as error:
        raise os_failure(subject, error, "a new path that can be written", BundleError) from None
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return path


def _write_zip(path: Path, contents: Mapping[str, bytes]) -> None:
    with path.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            packed = name.endswith(".npz")  # compressed by itself
            entry.compress_type = zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, data, compresslevel=9)


def _write_file(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        synchronise(file.fileno())


def _signed(path: Path, key: BundleKey, signature: bytes) -> bytes:
    """The contents of a zip whose signature was checked."""
    subject = f"bundle {path}"
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise BundleError(subject, error, "a zip file: a folder has no signature") from None
    if len(content) > MAX_BYTES:
        raise BundleError(subject, f"more than {MAX_BYTES} bytes", f"at most {MAX_BYTES}")
    key.check(content, signature, subject)
    return content


def _check_listing(names: set[str], subject: str) -> None:
    for name in names:
        check_name(name, subject)
    if missing := REQUIRED_FILES - names:
        raise BundleError(f"{subject}: files", f"no {', '.join(sorted(missing))}", f"{DECODER}, {TWIN} and {GOLDEN}")
    lacking = [name for name in ESTIMATOR_FILES if name not in names]
    if 0 < len(lacking) < len(ESTIMATOR_FILES):
        raise BundleError(
            f"{subject}: files", f"no {', '.join(lacking)}", f"{', '.join(ESTIMATOR_FILES)}, or none of them"
        )
    if extra := names - REQUIRED_FILES - OPTIONAL_FILES:
        raise BundleError(f"{subject}: files", sorted(extra), f"{sorted(REQUIRED_FILES | OPTIONAL_FILES)} only")
