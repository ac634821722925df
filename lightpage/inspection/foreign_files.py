"""Looks at files of other programs: what arrays they hold, how their counts lie, and how to import them."""

from __future__ import annotations

import math
import shlex
from contextlib import closing
from pathlib import Path

from lightpage.device.profile import Profile
from lightpage.errors import FrameError
from lightpage.foreign.array import MOST_BYTES, SEPARATOR, ForeignArray, spread
from lightpage.foreign.frames import Counts, Pages, first_axis_of_pages, whole_counts
from lightpage.foreign.hdf5_file import arrays_in
from lightpage.foreign.import_job import DEPTHS
from lightpage.foreign.mat_file import mat_arrays
from lightpage.foreign.numpy_file import arrays_of
from lightpage.foreign.opening import open_array
from lightpage.inspection.exposure import histogram
from lightpage.inspection.finding import Fact, Finding, shape_fact, shape_text
from lightpage.recording.exposure import check_light
from lightpage.recording.hdf5 import hdf, open_hdf5

_SAMPLED = 8
_SAMPLE_BYTES = 1 << 26
_DRAWN = 4
_LARGEST_SYMBOL = 256
_KINDS = ("neither", "symbols", "frames")
"""What an array of a profile's shape is, in the order in which arrays of a file are chosen."""
_NEEDED = "an array of counts"
_TOLD = 20


def look_at_hdf5(path: Path, profile: Profile | None = None) -> Finding:
    """Return what arrays an HDF5 file of another program has, or a .mat file that is one.

    Raises:
        InvalidInputError, StorageError, SurroundingsError: it cannot be read.
    """
    matlab = path.suffix.lower() == ".mat"
    found = Finding(path, "MATLAB file" if matlab else "HDF5 file of another program")
    with found.trying("a file that is whole"), open_hdf5(path, f"file {path}") as file:
        _several(found, arrays_in(file, matlab), profile)
    return found


def look_at_archive(path: Path, profile: Profile | None = None) -> Finding:
    """Return what arrays an .npz file has."""
    found = Finding(path, "arrays of NumPy")
    with found.trying("an archive that is whole"):
        _several(found, arrays_of(path), profile)
    return found


def look_at_mat(path: Path, profile: Profile | None = None) -> Finding:
    """Return what arrays a .mat file has, of any version."""
    if hdf.is_hdf5(path):
        return look_at_hdf5(path, profile)
    found = Finding(path, "MATLAB file")
    with found.trying("a file that is whole"):
        _several(found, mat_arrays(path), profile)
    return found


def look_at_array(path: Path, kind: str, profile: Profile | None = None) -> Finding:
    """Return what the one array of a file, or the pictures of a folder, are."""
    found = Finding(path, kind)
    with found.trying(_NEEDED), closing(open_array(str(path))) as array:
        _one(found, array, found.quoted, profile)
    return found


def _several(found: Finding, arrays: dict[str, tuple[int, ...]], profile: Profile | None) -> None:
    for name, shape in list(arrays.items())[:_TOLD]:
        found.facts[f"array {name}"] = shape_fact(shape)
    if len(arrays) > _TOLD:
        found.facts["further arrays"] = len(arrays) - _TOLD
    if not arrays:
        found.problems.append("no array of numbers with two to four axes")
        return
    name = max(arrays, key=lambda each: (_KINDS.index(_kind(arrays[each], profile)), math.prod(arrays[each])))
    with closing(open_array(f"{found.path}{SEPARATOR}{name}")) as array:
        _one(found, array, shlex.quote(f"{found.path}{SEPARATOR}{name}"), profile)


def _one(found: Finding, array: ForeignArray, named: str, profile: Profile | None) -> None:
    """Tell of an array, how frames in it are exposed, and whether it fits a profile."""
    found.facts |= {"shape": shape_fact(array.shape), "type": str(array.dtype)}
    if profile is not None:
        found.profile = profile
        _fits(found, array, profile)
    if not 2 <= len(array.shape) <= 4 or array.dtype.kind not in "uif" or 0 in array.shape:
        found.problems.append(f"type {array.dtype} of shape {array.shape}: neither frames nor symbols")
        return
    if _in_colour(array, profile):
        found.problems.append(f"a last axis of {array.shape[-1]}, as in colour: wanted grey pictures, or --profile P")
        return
    pages = Pages(array, _page_shape(array, profile), "pages", together=False)
    if (size := math.prod(pages.shape) * array.dtype.itemsize) > MOST_BYTES:
        found.problems.append(f"a page of {size / 1e9:.3g} GB, more than is looked at")
        return
    most = max(1, min(_SAMPLED, _SAMPLE_BYTES // max(1, size)))
    looked_at = range(min(most, pages.count)) if array.in_sequence else spread(pages.count, most)
    frames = {number: pages.page(number) for number in looked_at}
    found.facts["pages looked at"] = Fact(list(looked_at), ", ".join(map(str, looked_at)))
    symbols, title = _may_be_symbols(array, profile), f"{Path(named).name}, page"
    unit = "symbol" if symbols else "counts"
    found.pictures = lambda: [(f"{title} {number}", frames[number], unit) for number in list(frames)[:_DRAWN]]
    if symbols:
        found.facts["may be"] = "symbols"
        found.next.append(f"lightpage import --symbols {named} --in-phase I --quadrature Q ... --profile P --out R.h5")
        return
    with found.trying("counts"):
        _counts(found, {number: whole_counts(frame, f"page {number}") for number, frame in frames.items()})
    found.next.append(
        f"lightpage import --in-phase {named} --quadrature Q --reference-in-phase RI --reference-quadrature RQ "
        "--symbols S --profile P --out R.h5"
    )


def _may_be_symbols(array: ForeignArray, profile: Profile | None) -> bool:
    """Return whether an array is symbols: by the profile, or else since its values and pages are that small."""
    if (kind := _kind(array.shape, profile)) != "neither":
        return kind == "symbols"
    return len(array.shape) == 3 and max(array.shape[-2:]) < _LARGEST_SYMBOL and array.dtype.itemsize == 1


def _in_colour(array: ForeignArray, profile: Profile | None) -> bool:
    """Return whether the last axis seems to be colours, not the columns or the number of the pages."""
    known = array.pages_last or _kind(array.shape, profile) != "neither"
    return len(array.shape) > 2 and array.shape[-1] in (3, 4) and not known


def _page_shape(array: ForeignArray, profile: Profile | None) -> tuple[int, int]:
    """Return rows and columns of a page: the profile's, or those of the axes on which its program has them."""
    for shape in () if profile is None else (profile.frame_shape, profile.page_shape):
        if first_axis_of_pages(array, shape) is not None:
            return shape
    rows, columns = array.shape[:2] if array.pages_last else array.shape[-2:]
    return rows, columns


def _counts(found: Finding, frames: dict[int, Counts]) -> None:
    """Tell of the counts of some frames, and which of them have no usable light."""
    least, peak = min(int(each.min()) for each in frames.values()), max(int(each.max()) for each in frames.values())
    bits = next(depth for depth in DEPTHS if peak < 1 << depth)
    value = {"least": least, "greatest": peak, "bits": bits}
    found.facts["counts"] = Fact(value, f"{least} to {peak}, so {bits} bits or more")
    for number, frame in frames.items():
        try:
            check_light(f"page {number}", frame, bits)
        except FrameError as error:
            found.problems.append(f"{error.subject} {error.got}")
    found.histograms["frames"] = histogram(list(frames.values()), bits)


def _fits(found: Finding, array: ForeignArray, profile: Profile) -> None:
    """Tell whether frames or symbols fit a profile."""
    if (kind := _kind(array.shape, profile)) != "neither":
        found.facts["fits"] = Fact({"kind": kind, "profile": profile.name}, f"{kind} of profile {profile.name}")
    else:
        wanted = f"{shape_text(profile.frame_shape)} pixels or {shape_text(profile.page_shape)} symbols"
        turned = profile.frame_shape[::-1] in (array.shape[-2:], array.shape[:2])
        more = "; turned by 90 degrees they fit: --turn-in-phase, --turn-quadrature" if turned else ""
        found.problems.append(f"shape {array.shape}, and profile {profile.name} has {wanted}{more}")


def _kind(shape: tuple[int, ...], profile: Profile | None) -> str:
    """Return which pages of a profile an array holds by its shape, of `_KINDS`."""
    ends = shape[-2:], shape[:2]
    if profile is not None and profile.frame_shape in ends:
        return "frames"
    return "symbols" if profile is not None and profile.page_shape in ends else "neither"
