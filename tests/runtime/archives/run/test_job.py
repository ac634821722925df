"""What a run was asked: the same question goes on, another one is refused, and names mean the files that are there."""

import errno
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from lightpage.errors import BundleError, InvalidInputError, StorageError
from lightpage.runtime.archives.run.job import bundle_sha256
from lightpage.runtime.archives.run.question import found_recordings, of_fleet, of_recordings, with_round
from lightpage.runtime.archives.run.task import Choices, FineTuning, NamedBundle, Operation
from tests.runtime import toy
from tests.runtime.archives.jobs import BUNDLE, NEWER, PASSES, STAYS, job, source

UNREAD = NamedBundle(path=Path("/toy.zip"), sha256="", version="")


@pytest.mark.parametrize(
    ("choices", "subject"),
    [
        ({"range_pages": 4}, "range_pages"),
        ({"tracking": False}, "tracking"),
        ({"operation": Operation.EVALUATE}, "operation"),
        ({"parts": 2}, "parts"),
        ({"provider": "cuda"}, "provider"),
        ({"steps": 1}, "steps"),
        ({"fine_tuning": FineTuning()}, "fine_tuning"),
    ],
)
def test_another_choice_is_another_question(choices: dict[str, Any], subject: str) -> None:
    asked = job().model_copy(update={"choices": job().choices.model_copy(update=choices)})
    with pytest.raises(InvalidInputError) as error:
        job().check(Path("out"), asked)
    assert error.value.subject == f"bulk run out: {subject}"
    job().check(Path("out"), job())


def test_steps_that_no_bundle_of_a_run_has_are_refused(toy_zip: Path) -> None:
    network = NamedBundle(path=toy_zip, sha256="0" * 64, version="toy-1")
    asked = job().model_copy(update={"choices": job().choices.model_copy(update={"steps": 2})})
    with pytest.raises(InvalidInputError, match=r"toy\.zip: steps: got"):
        asked.model_copy(update={"bundles": (UNREAD, network)}).check_steps()
    asked.model_copy(update={"bundles": (UNREAD,)}).check_steps()  # the workers tell why it is not read


def test_other_recordings_bundles_or_runs_are_another_question_and_files_that_have_gone_are_not(tmp_path: Path) -> None:
    there = source("c").model_copy(update={"path": tmp_path})
    before = job(source("a"), source("b"), there)
    before.check(Path("out"), job(source("a"), there))  # the workers tell of b
    deep = before.choices.model_copy(update={"fine_tuning": FineTuning()})
    with_run = there.model_copy(update={"run": Path("/other"), "device": "c"})
    for asked, own, got in (
        (job(source("a"), source("d"), there), before, "/d.h5"),
        (job(source("a"), source("b")), before, str(tmp_path)),
        (before.model_copy(update={"bundles": (NEWER,)}), before, "toy-2"),
        (
            job(with_run).model_copy(update={"choices": deep}),
            job(with_run.model_copy(update={"run": None})).model_copy(update={"choices": deep}),
            "/other",
        ),
    ):
        with pytest.raises(InvalidInputError) as error:
            own.check(Path("out"), asked)
        assert got in error.value.got
    before.check(Path("out"), before.model_copy(update={"bundles": (UNREAD,)}))


def test_a_bundle_is_taken_from_where_it_lies_now_and_kept_where_it_has_gone() -> None:
    moved = BUNDLE.model_copy(update={"path": Path("/elsewhere.zip")})
    assert job().with_bundles_of(job().model_copy(update={"bundles": (moved,)})).bundles == (moved,)
    assert job().with_bundles_of(job().model_copy(update={"bundles": (UNREAD,)})).bundles == (BUNDLE,)
    unread = job().model_copy(update={"bundles": (UNREAD,)})
    assert unread.with_bundles_of(job()).bundles == (BUNDLE,)


def test_a_newer_bundle_is_a_round_and_the_same_round_once_it_has_moved(toy_zip: Path, tmp_path: Path) -> None:
    moved = shutil.copy(toy_zip, tmp_path / "moved.zip")
    (newest,) = with_round(with_round(job(), str(toy_zip)), str(moved)).rounds
    assert (newest.path, newest.version) == (moved, "toy-1")
    other = toy.write_toy_bundle(tmp_path / "other.zip", version="toy-2")
    asked = with_round(job(rounds=(newest,)), str(other))
    assert [model.version for model in asked.rounds] == ["toy-1", "toy-2"]


def test_what_may_pass_is_looked_at_again_and_what_was_given_up_on_request(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(), 16, 2)
    at = {"path": tmp_path / "a.h5"}
    lacking = job(source("a", PASSES).model_copy(update=at))
    assert lacking.passing()
    assert [each.pages for each in lacking.looked_at_again().sources] == [2]
    assert not job(source("a", STAYS)).passing()
    left = lacking.unopened_given_up([0])
    assert (left.sources[0].given_up, left.passing()) == (True, False)
    assert left.looked_at_again().sources[0].problem == PASSES
    assert left.looked_at_again(given_up=True).sources[0].problem is None
    assert not job().unopened_given_up([0, 1]).sources[0].given_up
    of_bundle = lacking.model_copy(update={"bundles": (UNREAD,)})
    assert not of_bundle.unopened_given_up([0]).sources[0].given_up


@pytest.mark.parametrize("name", ["a[1].h5", "what?.h5", "line\nbreak.h5"])
def test_a_file_that_exists_under_exactly_that_name_is_meant(name: str, toy_zip: Path, tmp_path: Path) -> None:
    (folder := tmp_path / "[shelf]").mkdir()
    (folder / name).touch()
    assert found_recordings([str(folder / name)]) == found_recordings([f"{folder}/*.h5"]) == [folder / name]
    (folder / "fleet.toml").write_text(
        f'[[device]]\nname = "one"\nbundle = "../toy.zip"\nrecordings = [{json.dumps(name, ensure_ascii=False)}]\n'
    )
    (found,) = of_fleet(Choices(operation=Operation.DECODE), folder / "fleet.toml", None).sources
    assert found.path == folder / name


def test_recordings_are_named_once_in_order_and_a_home_folder_may_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("b.h5", "a.h5", "long.h5"):
        (tmp_path / name).touch()
    monkeypatch.setenv("HOME", str(tmp_path))
    assert [path.name for path in found_recordings(["~/?.h5", f"{tmp_path}/b.h5"])] == ["a.h5", "b.h5"]
    assert found_recordings(["absent.h5"], tmp_path) == [tmp_path / "absent.h5"]  # whoever opens it tells of it
    with pytest.raises(InvalidInputError, match=r"^--recordings x\*"):
        found_recordings(["x*"], tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "device = 3",
        "[[device]]\nname='a'\nbundle='toy.zip'\nrecordings=['a.h5']\n" * 2,
        "[[device]]\nname='a'\nbundle='toy.zip'\nrecordings=[]",
        "[[device]",
    ],
)
def test_a_fleet_that_makes_no_sense_is_refused(text: str, tmp_path: Path) -> None:
    (path := tmp_path / "fleet.toml").write_text(text)
    with pytest.raises(InvalidInputError) as error:
        of_fleet(Choices(operation=Operation.DECODE), path, None)
    assert error.value.subject == f"fleet {path}"


def test_what_a_run_knows_is_not_opened_again(toy_zip: Path, tmp_path: Path) -> None:
    bundle = Path(shutil.copy(toy_zip, tmp_path / "toy.zip"))
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(), 16, 2)
    choices = Choices(operation=Operation.DECODE)
    before = of_recordings(choices, [str(tmp_path / "a.h5")], str(bundle), None)
    assert [(each.pages, each.problem) for each in before.sources] == [(2, None)]
    (tmp_path / "a.h5").write_bytes(b"no recording")
    assert of_recordings(choices, [str(tmp_path / "a.h5")], str(bundle), before).sources == before.sources
    (lost,) = of_recordings(choices, [str(tmp_path / "a.h5")], str(bundle), None).sources
    assert (lost.pages, lost.stamp) == (0, None)
    assert lost.problem is not None


def test_a_bundle_that_cannot_be_read_is_told_from_one_that_is_another(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BundleError, match="gone"):
        bundle_sha256(tmp_path / "gone.zip")
    monkeypatch.setattr(hashlib, "file_digest", Mock(side_effect=OSError(errno.EIO, "Input/output error")))
    with pytest.raises(StorageError, match="bundle"):
        bundle_sha256(toy_zip)
