"""A bundle is loaded whole and unchanged, or not at all."""

from __future__ import annotations

import io
import json
import os
import shutil
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import BundleError
from runtime.bundle.archive import read_files
from runtime.bundle.bundle import Bundle, npz, write_bundle
from runtime.bundle.manifest import GOLDEN, MANIFEST, PILOTS, TABLE, parse_manifest
from tests.runtime import toy


def rewrite_zip(source: Path, target: Path, edit: dict[str, bytes | None]) -> Path:
    """Copy a zip with some members replaced, added or (None) dropped."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        members = {name: old.read(name) for name in old.namelist()} | edit
        for name, data in members.items():
            if data is not None:
                new.writestr(name, data)
    return target


@pytest.mark.parametrize("kind", ["zip", "folder"])
def test_what_is_written_is_what_is_read(kind: str, toy_zip: Path, toy_folder: Path) -> None:
    bundle = Bundle.open(toy_zip if kind == "zip" else toy_folder)
    assert bundle.version == "toy-1"
    assert dict(bundle.files) == toy.files()
    assert bundle.profile == toy.PROFILE
    assert bundle.table == {}
    assert bundle.golden.p.shape == (2, *toy.PAGE)


def test_equal_contents_give_equal_bytes(toy_zip: Path, tmp_path: Path) -> None:
    assert toy.write_toy_bundle(tmp_path / "again.zip").read_bytes() == toy_zip.read_bytes()


def test_a_flipped_byte_in_any_file_of_a_folder_is_refused(toy_folder: Path, tmp_path: Path) -> None:
    for file in sorted(toy_folder.iterdir()):
        size = file.stat().st_size
        for place in sorted({0, size // 3, size // 2, size - 2}):
            copy = shutil.copytree(toy_folder, tmp_path / f"{file.name}-{place}")
            data = bytearray(file.read_bytes())
            data[place] ^= 1
            (copy / file.name).write_bytes(data)
            with pytest.raises(BundleError):
                Bundle.open(copy)


def test_a_flipped_byte_anywhere_in_a_zip_is_refused_or_changes_nothing(toy_zip: Path, tmp_path: Path) -> None:
    data = toy_zip.read_bytes()
    refused = 0
    places = range(0, len(data), max(1, len(data) // 150))
    for place in places:
        damaged = bytearray(data)
        damaged[place] ^= 1 << (place % 8)
        path = tmp_path / "damaged.zip"
        path.write_bytes(damaged)
        try:
            bundle = Bundle.open(path)
        except BundleError:
            refused += 1
        else:  # a time stamp in the zip's directory, say: no content of the bundle
            assert dict(bundle.files) == toy.files()
            assert bundle.manifest == Bundle.open(toy_zip).manifest
    assert refused > 0.8 * len(places)


def test_what_is_no_whole_zip_is_refused(toy_zip: Path, tmp_path: Path) -> None:
    data, path = toy_zip.read_bytes(), tmp_path / "cut.zip"
    with pytest.raises(BundleError, match="nothing"):
        Bundle.open(path)
    for content in (b"", data[:10], data[: len(data) // 2], data[:-1], b"not a zip at all", b"PK\x03\x04 but no more"):
        path.write_bytes(content)
        with pytest.raises(BundleError, match="zip"):
            Bundle.open(path)


@pytest.mark.parametrize("name", ["decoder.onnx", "twin.onnx", "golden.npz", MANIFEST])
def test_a_missing_file_is_named(name: str, toy_zip: Path, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=name):
        Bundle.open(rewrite_zip(toy_zip, tmp_path / "less.zip", {name: None}))


def test_an_unlisted_file_is_named(toy_zip: Path, toy_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=r"notes\.txt"):
        Bundle.open(rewrite_zip(toy_zip, tmp_path / "more.zip", {"notes.txt": b"hello"}))
    folder = shutil.copytree(toy_folder, tmp_path / "more")
    (folder / "table.npz").write_bytes(b"not listed")
    with pytest.raises(BundleError, match=r"table\.npz"):
        Bundle.open(folder)


def test_a_newer_schema_or_a_wrong_key_says_which(toy_zip: Path, tmp_path: Path) -> None:
    text = json.loads(zipfile.ZipFile(toy_zip).read(MANIFEST)) | {"schema_version": 2, "something_new": True}
    with pytest.raises(BundleError, match="schema_version: got 2"):
        Bundle.open(rewrite_zip(toy_zip, tmp_path / "newer.zip", {MANIFEST: json.dumps(text).encode()}))
    manifest = toy.manifest().model_copy(update={"camera_bit_depth": 99})
    with pytest.raises(BundleError, match="camera_bit_depth"):
        parse_manifest(manifest.to_json(), "manifest")


@pytest.mark.parametrize("text", [b"", b"[]", b"{", b"\xff\xfe", b'{"format": "other"}', b"[" * 100_000, b"NaN"])
def test_a_foreign_manifest_is_refused(text: bytes) -> None:
    with pytest.raises(BundleError):
        parse_manifest(text, "manifest")


LITTER = [".DS_Store", "__MACOSX/._manifest.json", "._decoder.onnx", "Thumbs.db", "desktop.ini", ".hidden"]


@pytest.mark.parametrize("packed_with_its_folder", [False, True])
def test_what_systems_put_beside_files_is_passed_over(
    packed_with_its_folder: bool, toy_zip: Path, tmp_path: Path
) -> None:
    path = rewrite_zip(toy_zip, tmp_path / "littered.zip", dict.fromkeys(LITTER, b"x"))
    if packed_with_its_folder:
        with zipfile.ZipFile(path) as archive:
            contents = {f"my bundle/{name}": archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            archive.mkdir("my bundle")
            for name, data in contents.items():
                archive.writestr(name, data)
    assert Bundle.open(path).manifest == Bundle.open(toy_zip).manifest


def test_a_bundle_that_kubernetes_mounts_is_read_and_no_other_link(toy_zip: Path, tmp_path: Path) -> None:
    folder, data = tmp_path / "mounted", tmp_path / "mounted" / "..2026_11_26"
    data.mkdir(parents=True)
    with zipfile.ZipFile(toy_zip) as archive:
        archive.extractall(data)
    (folder / "..data").symlink_to(data.name)
    for file in data.iterdir():
        (folder / file.name).symlink_to(f"..data/{file.name}")
    assert Bundle.open(folder).version == Bundle.open(toy_zip).version
    (tmp_path / "outside").write_bytes((data / "golden.npz").read_bytes())
    (folder / "golden.npz").unlink()
    (folder / "golden.npz").symlink_to("../outside")
    with pytest.raises(BundleError, match=r"golden\.npz"):
        Bundle.open(folder)


@pytest.mark.parametrize("name", ["../evil.onnx", "/etc/evil", "a/b", "..\\evil", "C:evil", "..", "nul\0byte", "sub/"])
def test_a_zip_entry_that_is_a_path_is_refused_and_nothing_is_written(name: str, toy_zip: Path, tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    path = rewrite_zip(toy_zip, inside / "climbs.zip", {name.replace("\0", "@"): b"x"})
    path.write_bytes(path.read_bytes().replace(b"nul@byte", b"nul\0byte"))  # zipfile itself would cut the name
    with pytest.raises(BundleError, match="file name"):
        Bundle.open(path)
    assert [p.name for p in tmp_path.iterdir()] == ["inside"]
    assert [p.name for p in inside.iterdir()] == ["climbs.zip"]


def test_a_manifest_that_lists_a_path_is_refused(toy_zip: Path, tmp_path: Path) -> None:
    listing = toy.manifest().model_copy(update={"files": {"../decoder.onnx": "0" * 64}})
    path = rewrite_zip(toy_zip, tmp_path / "lists.zip", {MANIFEST: listing.to_json()})
    with pytest.raises(BundleError, match=r"\.\./decoder\.onnx"):
        Bundle.open(path)


def test_links_and_folders_inside_are_refused(toy_zip: Path, toy_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(toy_folder, tmp_path / "points")
    (folder / "twin.onnx").unlink()
    os.symlink(toy_folder / "twin.onnx", folder / "twin.onnx")
    with pytest.raises(BundleError, match="link"):
        Bundle.open(folder)
    for make in (os.mkdir, os.mkfifo):
        os.unlink(folder / "twin.onnx") if make is os.mkdir else os.rmdir(folder / "twin.onnx")
        make(folder / "twin.onnx")
        with pytest.raises(BundleError, match=r"twin\.onnx"):
            Bundle.open(folder)
    path = rewrite_zip(toy_zip, tmp_path / "points.zip", {"twin.onnx": None})
    with zipfile.ZipFile(path, "a") as archive:
        entry = zipfile.ZipInfo("twin.onnx")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(BundleError, match="special file"):
        Bundle.open(path)


def test_a_zip_bomb_is_stopped_at_the_limit(toy_zip: Path, tmp_path: Path) -> None:
    path = rewrite_zip(toy_zip, tmp_path / "bomb.zip", {"table.npz": bytes(20_000_000)})
    assert path.stat().st_size < 100_000
    with pytest.raises(BundleError, match="unpacked"):
        read_files(path, max_bytes=1_000_000)
    many = rewrite_zip(toy_zip, tmp_path / "many.zip", {f"f{index}": b"" for index in range(100)})
    with pytest.raises(BundleError, match="104 files"):
        read_files(many)


@pytest.mark.parametrize(("name", "member"), [(TABLE, "homodyne"), (GOLDEN, "p"), (PILOTS, "mask")])
def test_a_bomb_inside_a_file_or_an_array_of_no_known_name_is_refused(
    name: str, member: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = npz(mask=np.ones(toy.PAGE, bool), homodyne=np.zeros(2, np.float32), extra=np.zeros(2))
    bomb = npz(**{member: np.zeros(20_000_000, np.uint8)})
    assert len(bomb) < 100_000
    for content, named in ((odd, "extra"), (bomb, rf"{name}: got 20000\d\d\d")):
        path = write_bundle(tmp_path / f"{named[:5]}.zip", toy.manifest(), toy.files() | {name: content})
        bundle = Bundle.open(path)
        if content is bomb:
            monkeypatch.setattr("runtime.bundle.bundle.MAX_ARRAY_BYTES", 1_000_000)
            monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("unpacked"))
        with pytest.raises(BundleError, match=named):
            arrays_of(bundle, name)


def arrays_of(bundle: Bundle, name: str) -> object:
    return {TABLE: lambda: bundle.table, GOLDEN: lambda: bundle.golden, PILOTS: lambda: bundle.pilot_mask}[name]()


@pytest.mark.parametrize("name", ["twice.zip", "twice"])
def test_a_bundle_is_never_overwritten(name: str, tmp_path: Path) -> None:
    path = toy.write_toy_bundle(tmp_path / name)
    before = Bundle.open(path).manifest
    with pytest.raises(BundleError, match="exists"):
        toy.write_toy_bundle(path, version="toy-2")
    assert Bundle.open(path).manifest == before


def test_a_write_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", full)
    for name in ("failed.zip", "failed"):
        with pytest.raises(BundleError, match="disk full"):
            toy.write_toy_bundle(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("edit", "named"),
    [({"twin.onnx": None}, "twin"), ({"other.bin": b""}, "other.bin"), ({"../x": b""}, "file name")],
)
def test_only_the_files_of_a_bundle_can_be_written(edit: dict[str, bytes | None], named: str, tmp_path: Path) -> None:
    contents = {name: data for name, data in (toy.files() | edit).items() if data is not None}
    with pytest.raises(BundleError, match=named):
        write_bundle(tmp_path / "odd.zip", toy.manifest(), contents)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("change", [{"version": "v 2"}, {"version": ""}, {"camera_bit_depth": 99}])
def test_a_manifest_that_could_not_be_read_again_is_not_written(change: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=next(iter(change))):
        write_bundle(tmp_path / "odd.zip", toy.manifest().model_copy(update=change), toy.files())
    assert list(tmp_path.iterdir()) == []


def test_a_table_may_hold_only_named_inputs_and_no_pickles(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, homodyne=np.array([{"a": 1}], dtype=object))
    for name, table in (("other", npz(other=np.zeros(2, np.float32))), (TABLE, buffer.getvalue())):
        path = write_bundle(tmp_path / f"{name}.zip", toy.manifest(), toy.files() | {TABLE: table})
        with pytest.raises(BundleError, match=name):
            _ = Bundle.open(path).table
