"""A bundle is loaded whole, unchanged and, with a key, signed, or not at all; its golden page is in few counts."""

import io
import json
import os
import shutil
import stat
import zipfile
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from lightpage.errors import BundleError, InvalidInputError
from lightpage.recording.exposure import check_light
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle import archive
from lightpage.runtime.model.bundle.archive import read_files
from lightpage.runtime.model.bundle.bundle import Bundle, in_few_counts, in_few_roots, npz, shows_page, write_bundle
from lightpage.runtime.model.bundle.manifest import (
    DECODER,
    ESTIMATOR_FILES,
    GOLDEN,
    MANIFEST,
    PILOTS,
    TABLE,
    Manifest,
    parse_manifest,
)
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.bundle.signature_file import signature_path
from lightpage.runtime.model.decoding.decoder import Decoder
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
        copy = shutil.copytree(toy_folder, tmp_path / file.name)
        data = bytearray(file.read_bytes())
        data[len(data) // 3] ^= 1
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
    with pytest.raises(BundleError, match="no such file"):
        Bundle.open(path)
    for content in (b"", data[: len(data) // 2], data[:-1], b"PK\x03\x04 but no more"):
        path.write_bytes(content)
        with pytest.raises(BundleError, match="zip"):
            Bundle.open(path)


@pytest.mark.parametrize(
    ("name", "content"), [("decoder.onnx", None), (MANIFEST, None), ("notes.txt", b"hello"), ("table.npz", b"unlisted")]
)
def test_a_missing_or_unlisted_file_is_named(name: str, content: bytes | None, toy_zip: Path, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=name):
        Bundle.open(rewrite_zip(toy_zip, tmp_path / "other.zip", {name: content}))


@pytest.mark.parametrize("lacking", ESTIMATOR_FILES)
def test_some_graphs_of_an_estimator_are_a_damaged_bundle(lacking: str, toy_zip: Path, tmp_path: Path) -> None:
    graphs = {name: b"graph" for name in ESTIMATOR_FILES if name != lacking}
    with pytest.raises(BundleError, match=f"got no {lacking}"):
        write_bundle(tmp_path / "partial.zip", toy.manifest(), {**toy.files(), **graphs})
    whole = write_bundle(tmp_path / "whole.zip", toy.manifest(), {**toy.files(), **graphs, lacking: b"graph"})
    files = read_files(whole)
    manifest = json.loads(files.pop(MANIFEST))
    del manifest["files"][lacking], manifest["manifest_sha256"]
    text = Manifest.model_validate_json(json.dumps(manifest)).to_json()
    with pytest.raises(BundleError, match=f"got no {lacking}"):
        Bundle.open(rewrite_zip(whole, tmp_path / "cut.zip", {lacking: None, MANIFEST: text}))


def test_an_estimator_without_the_noise_of_its_steps_is_a_damaged_bundle(toy_zip: Path, tmp_path: Path) -> None:
    graphs = dict.fromkeys(ESTIMATOR_FILES, toy.files()[DECODER])
    path = write_bundle(tmp_path / "no-noise.zip", toy.manifest(), {**toy.files(), **graphs})
    with pytest.raises(BundleError, match=r"decoder\.onnx: .* noise"):
        Decoder.load(path, steps=1)
    with pytest.raises(BundleError, match="input noise"):
        Decoder.load(path)


def test_a_newer_schema_says_which(toy_zip: Path) -> None:
    text = json.loads(zipfile.ZipFile(toy_zip).read(MANIFEST)) | {"schema_version": 2, "something_new": True}
    with pytest.raises(BundleError, match="schema_version: got 2"):
        parse_manifest(json.dumps(text).encode(), "manifest")


@pytest.mark.parametrize("text", [b"[]", b"\xff\xfe", b'{"format": "other"}', b"[" * 100_000])
def test_a_foreign_manifest_is_refused(text: bytes) -> None:
    with pytest.raises(BundleError):
        parse_manifest(text, "manifest")


LITTER = [".DS_Store", "__MACOSX/._manifest.json", "._decoder.onnx", "Thumbs.db"]


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


@pytest.mark.parametrize("name", ["../evil.onnx", "/etc/evil", "..\\evil", "C:evil", "nul\0byte", "sub/"])
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
    for make in (os.mkdir, os.mkfifo):
        make(folder / "twin.onnx")
        with pytest.raises(BundleError, match=r"twin\.onnx"):
            Bundle.open(folder)
        (os.rmdir if make is os.mkdir else os.unlink)(folder / "twin.onnx")
    path = rewrite_zip(toy_zip, tmp_path / "points.zip", {"twin.onnx": None})
    with zipfile.ZipFile(path, "a") as archive:
        entry = zipfile.ZipInfo("twin.onnx")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(BundleError, match="special file"):
        Bundle.open(path)


def test_a_zip_bomb_is_stopped_at_the_limit(toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "MAX_BYTES", 1_000_000)
    path = rewrite_zip(toy_zip, tmp_path / "bomb.zip", {"table.npz": bytes(20_000_000)})
    assert path.stat().st_size < 100_000
    with pytest.raises(BundleError, match="unpacked"):
        read_files(path)
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
            monkeypatch.setattr("lightpage.runtime.model.bundle.bundle.MAX_ARRAY_BYTES", 1_000_000)
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
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError("disk full")))
    for name in ("failed.zip", "failed"):
        with pytest.raises(BundleError, match="disk full"):
            toy.write_toy_bundle(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "edit"),
    [({"version": "v 2"}, {}), ({"camera_bit_depth": 99}, {}), ({}, {"other.bin": b""}), ({}, {"../x": b""})],
)
def test_what_could_not_be_read_again_is_not_written(
    change: dict[str, object], edit: dict[str, bytes], tmp_path: Path
) -> None:
    with pytest.raises(BundleError):
        write_bundle(tmp_path / "odd.zip", toy.manifest().model_copy(update=change), toy.files() | edit)
    assert list(tmp_path.iterdir()) == []


def test_a_table_may_hold_only_named_inputs_and_no_pickles(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, homodyne=np.array([{"a": 1}], dtype=object))
    for name, table in (("other", npz(other=np.zeros(2, np.float32))), (TABLE, buffer.getvalue())):
        path = write_bundle(tmp_path / f"{name}.zip", toy.manifest(), toy.files() | {TABLE: table})
        with pytest.raises(BundleError, match=name):
            _ = Bundle.open(path).table


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
def test_a_golden_page_takes_less_room_and_its_light_is_the_pages(bit_depth: int) -> None:
    top, step, rng = (1 << bit_depth) - 1, (1 << bit_depth) // 32, np.random.default_rng(0)
    counts = np.clip(rng.normal(top / 2, top / 3.3, (2, 301, 200)), 0, top)
    pair = FramePair(*counts.astype(np.uint8 if bit_depth == 8 else np.uint16))
    coarse = in_few_counts(pair, bit_depth)
    for own, few in ((pair.in_phase, coarse.in_phase), (pair.quadrature, coarse.quadrature)):
        assert (few.dtype, few.shape) == (own.dtype, own.shape)
        assert len(np.unique(few)) <= 32
        check_light("frame", few, bit_depth)
        blocks = own[:300].astype(float).reshape(150, 2, 100, 2).mean((1, 3))
        assert np.abs(few[:300:2, ::2] - blocks).max() <= step / 2 + 1
        assert few.mean() == pytest.approx(own.mean(), rel=0.01)
    assert len(npz(a=coarse.in_phase)) < len(npz(a=pair.in_phase)) / 2


def test_frames_at_full_scale_and_black_ones_stay_within_a_cameras_counts() -> None:
    bright = np.full((4, 6), 4095, np.uint16)
    coarse = in_few_counts(FramePair(bright, np.zeros_like(bright)), 12)
    assert (int(coarse.in_phase.max()), int(coarse.quadrature.max())) == (4095 - 63, 64)


@pytest.mark.parametrize("bit_depth", [8, 12])
def test_few_roots_err_by_a_share_of_the_shot_noise(bit_depth: int) -> None:
    counts = np.arange(1 << bit_depth).astype(np.uint8 if bit_depth == 8 else np.uint16)[None]
    few = in_few_roots(FramePair(counts, counts), bit_depth).in_phase
    assert few.dtype == counts.dtype
    assert len(np.unique(few)) == 16
    assert 0 < few[0, -1] < counts[0, -1]
    bright = counts > counts.max() / 16
    errors = (few.astype(float) - counts)[bright] / np.sqrt(counts[bright])
    assert np.abs(errors).max() < 1.2 * np.sqrt(1 << bit_depth) / 16


def test_few_roots_of_two_rows_are_those_of_their_means() -> None:
    counts = np.random.default_rng(0).integers(0, 256, (5, 7)).astype(np.uint8)
    few = in_few_roots(FramePair(counts, counts), 8, rows=2).in_phase
    means = np.round(counts[:4].reshape(2, 2, 7).mean(1)).astype(np.uint8)
    expected = in_few_roots(FramePair(means, means), 8).in_phase
    np.testing.assert_array_equal(few[0:4:2], few[1:4:2])
    assert np.mean(few[0:4:2] == expected) > 0.9  # means lie between whole counts
    np.testing.assert_array_equal(few[4], in_few_roots(FramePair(counts[4:], counts[4:]), 8).in_phase[0])


@pytest.mark.parametrize(("coarse", "shows"), [(0.0014, True), (0.0019, False), (float("nan"), False)])
def test_a_golden_page_must_stay_clear_of_the_limit(coarse: float, shows: bool) -> None:
    assert shows_page(coarse, 0.003) is shows


def _pem(key: ec.EllipticCurvePublicKey | ed25519.Ed25519PublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


@pytest.fixture
def key(tmp_path: Path) -> ec.EllipticCurvePrivateKey:
    """A private key, and the public one in a file."""
    key = ec.generate_private_key(ec.SECP256R1())
    (tmp_path / "key.pem").write_bytes(_pem(key.public_key()))
    return key


@pytest.fixture
def bundle(toy_zip: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(toy_zip, tmp_path / "mine.zip"))


def test_a_bundle_is_loaded_if_it_is_signed_with_the_key_and_no_other(
    bundle: Path, key: ec.EllipticCurvePrivateKey, toy_folder: Path, tmp_path: Path
) -> None:
    signature, public = key.sign(bundle.read_bytes(), ec.ECDSA(hashes.SHA256())), BundleKey(tmp_path / "key.pem")
    assert Bundle.open(bundle, key=public, signature=signature).version == "toy-1"
    with pytest.raises(BundleError, match=r"mine\.zip: signature"):
        Bundle.open(bundle, key=public)
    signature_path(bundle).write_bytes(signature)
    assert Bundle.open(bundle, key=public).version == "toy-1"
    (tmp_path / "other.pem").write_bytes(_pem(ec.generate_private_key(ec.SECP256R1()).public_key()))
    with pytest.raises(BundleError, match="signature"):
        Bundle.open(bundle, key=BundleKey(tmp_path / "other.pem"))
    with bundle.open("ab") as file:
        file.write(b"\0")
    for path in (bundle, toy_folder):
        with pytest.raises(BundleError, match="signature"):
            Bundle.open(path, key=public)


def test_a_file_that_is_no_public_key_of_a_curve_is_named(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    for content in (None, b"no key", _pem(ed25519.Ed25519PrivateKey.generate().public_key())):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InvalidInputError, match=r"key\.pem"):
            BundleKey(path)
