"""The store: what it remembers, whom it keeps out, what it sweeps, what it says when it is not well or hangs."""

import errno
import fcntl
import itertools
import json
import os
import resource
import shutil
import signal
import sqlite3
import stat
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from google.protobuf import json_format

from lightpage.errors import BundleError, StoreError
from lightpage.files import WITHOUT_LOCKS
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.bundle.manifest import sha256
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import NOBODY
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.audit import AuditLog, Entry
from lightpage.runtime.service.models.database import DAMAGED, DATABASE, write_job
from lightpage.runtime.service.models.folder import LOCK
from lightpage.runtime.service.models.history import History, Known, Origin
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import KEPT_BUNDLES, PROBE_S, Store
from lightpage.runtime.service.models.store_health import LONGEST_S, StoreHealth
from tests.clock import HandClock
from tests.lightpage.full_disk import full_disk
from tests.runtime import toy
from tests.waiting import eventually

Start = Callable[..., DataPlane]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture
def start(decoder: Decoder, folder: Path) -> Start:
    """Starts a service as it is after a restart; the one before is ended."""
    running: list[DataPlane] = []

    def begin(base: Decoder = decoder, **options: object) -> DataPlane:
        for plane in running:
            plane.models.store.close()
        often = itertools.count(0.0, PROBE_S).__next__  # it is tried whenever somebody asks
        store = Store(folder, base.bundle, **{"clock": often, **options})  # type: ignore[arg-type]
        running[:] = [DataPlane(Models(base, store))]
        return running[0]

    return begin


def put(folder: Path, *versions: str) -> None:
    folder.mkdir(exist_ok=True)
    for version in versions:
        toy.write_toy_bundle(folder / f"{version}.zip", version=version)


@pytest.fixture
def worn(start: Start, folder: Path) -> DataPlane:
    """A service with a history: base, r1, r2, r3."""
    plane = start()
    put(folder, "toy-1+r1", "toy-1+r2", "toy-1+r3")
    for number in (1, 2, 3):
        plane.models.activate(f"toy-1+r{number}")
    return plane


def failing(number: int) -> Mock:
    """A call of the system that fails."""
    return Mock(side_effect=OSError(number, os.strerror(number)))


def trouble(plane: DataPlane) -> str:
    """What is wrong with the store, empty where nothing is."""
    found = plane.models.store.trouble()
    return "" if found is None else found.text


def figure(plane: DataPlane, name: str, **labels: str) -> float | None:
    return plane.metrics.registry.get_sample_value(name, labels)


def history(plane: DataPlane) -> History:
    return plane.models.now.state.history


def test_the_history_survives_a_restart(worn: DataPlane, start: Start) -> None:
    worn.models.rollback()
    after = start()
    assert history(after) == history(worn)
    assert after.models.current.version == "toy-1+r2"
    assert after.models.roll_forward()[0].version == "toy-1+r3"
    again = start()
    assert [again.models.rollback()[0].version for _ in range(3)] == ["toy-1+r2", "toy-1+r1", "toy-1"]
    assert start().models.roll_forward()[0].version == "toy-1+r1"


@pytest.mark.usefixtures("worn")
def test_pins_survive_a_restart_and_another_base(start: Start, tmp_path: Path) -> None:
    assert start().models.pin("toy-1+r1", True).pinned
    other = Decoder.load(toy.write_toy_bundle(tmp_path / "other.zip", version="other"), threads=1)
    for bases, places in (([], 4), ([other], 1), ([], 4)):
        plane = start(*bases)
        assert plane.models.now.state.bundles["toy-1+r1"] == Known(Origin.RECALIBRATED, None, True)
        assert len(history(plane).versions) == places


def test_a_second_service_is_kept_out_and_what_a_killed_one_left_is_swept(decoder: Decoder, folder: Path) -> None:
    put(folder, "toy-1+r1")
    (folder / ".toy-1+r2.zip-abc").mkdir()
    (folder / ".toy-1+r2.zip-abc" / "bundle.zip").write_bytes(b"half")
    for name in (".upload-x", ".probe-x", ".current.json-x", ".nfs1", "notes.txt"):
        (folder / name).write_bytes(b"half")
    (folder / ".upload-link").symlink_to(folder / "toy-1+r1.zip")
    with Store(folder, decoder.bundle):
        left = sorted(path.name for path in folder.iterdir())
        with pytest.raises(StoreError, match="model store"):
            Store(folder, decoder.bundle)
    assert left == sorted([".nfs1", LOCK, "notes.txt", "toy-1+r1.zip"])
    Store(folder, decoder.bundle).close()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
@pytest.mark.parametrize("lacking", ["flock", "lockf"])
def test_a_file_system_without_locks_of_either_kind_will_do(
    lacking: str, number: int, start: Start, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    opened, connect = [], sqlite3.connect
    monkeypatch.setattr(fcntl, lacking, failing(number))
    monkeypatch.setattr(sqlite3, "connect", lambda at, **options: opened.append(at) or connect(at, **options))
    WITHOUT_LOCKS.clear()
    start().models.pin("toy-1", True)
    assert start().models.now.state.known("toy-1").pinned
    assert opened
    assert all(uri.endswith("&nolock=1") for uri in opened)
    assert caplog.text.count("no lock") == 1


def test_a_lock_that_fails_in_another_way_is_logged(
    start: Start, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fcntl, "flock", failing(errno.EBADF))  # as over NFS, of a file that can only be read
    assert trouble(start()) == ""
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_damaged_bundle_is_said_and_the_newest_before_it_that_is_there_serves(
    worn: DataPlane, start: Start, folder: Path
) -> None:
    (folder / "toy-1+r3.zip").write_bytes(b"damaged")
    (folder / "toy-1+r1.zip").unlink()
    plane = start()
    assert plane.models.current.version == "toy-1+r2"
    assert "toy-1+r3.zip" in trouble(plane)
    assert figure(plane, "lightpage_store_ok") == 0
    assert figure(plane, "lightpage_store_trouble", reason="bundle") == 1
    assert figure(plane, "lightpage_model_info", version="toy-1+r2") == 1
    plane.models.pin("toy-1", True)  # says nothing of what is to be in service
    plane = start()
    assert "toy-1+r3.zip" in trouble(plane)
    assert plane.models.rollback()[0].version == "toy-1"
    assert trouble(plane) == trouble(start()) == ""
    (folder / "toy-1+r2.zip").unlink()
    assert "toy-1+r2.zip" in trouble(start())


def test_nothing_is_deleted_while_it_is_not_settled_what_is_to_be_in_service(
    worn: DataPlane, start: Start, folder: Path
) -> None:
    (folder / DATABASE).unlink()
    plane = start(kept=0)
    plane.models.prune()
    assert plane.models.store.folder.versions() == ["toy-1+r1", "toy-1+r2", "toy-1+r3"]
    plane.models.activate("toy-1+r2")
    plane.models.prune()
    assert plane.models.store.folder.versions() == ["toy-1+r2"]


def changed(sql: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute(sql)

    return change


@pytest.mark.usefixtures("worn")
@pytest.mark.parametrize(
    "damage",
    [
        Path.unlink,
        lambda path: os.truncate(path, path.stat().st_size - 4096),
        lambda path: path.write_bytes(b"junk"),
        changed("PRAGMA application_id = 7"),
        changed("PRAGMA user_version = 9"),
        changed("UPDATE models SET state = json_set(state, '$.history.cursor', 7)"),
        changed("UPDATE models SET state = json_set(state, '$.history.cursor', 'x')"),
        changed("UPDATE models SET state = json_set(state, '$.history.versions[1]', '../x')"),
        changed('UPDATE models SET state = json_set(state, \'$.bundles\', json(\'{"a": {"origin": "stolen"}}\'))'),
        changed("DELETE FROM models"),
        changed("DROP TABLE jobs"),
    ],
)
def test_a_database_that_is_damaged_or_gone_is_said(damage: Callable[[Path], None], start: Start, folder: Path) -> None:
    database = folder / DATABASE
    damage(database)
    content = database.read_bytes() if database.exists() else None
    plane = start()
    assert (plane.models.current.version, DATABASE in trouble(plane)) == ("toy-1", True)
    assert figure(plane, "lightpage_store_trouble", reason="note") == 1
    with pytest.raises(StoreError), plane.models.store.transaction():  # what is no state of the models
        pass
    with pytest.raises(BundleError):
        plane.models.rollback()
    assert (database.read_bytes() if database.exists() else None) == content  # the next start says it again
    plane.models.pin("toy-1", True)  # says nothing of what is to be in service
    kept = folder / DAMAGED
    assert (kept.read_bytes() if kept.exists() else None) == content
    plane = start()
    assert (plane.models.entry(plane.models.base).pinned, DATABASE in trouble(plane)) == (True, True)
    plane.models.activate("toy-1+r2")
    assert trouble(plane) == ""
    assert start().models.current.version == "toy-1+r2"


@pytest.mark.usefixtures("worn")
def test_a_database_that_cannot_be_read_is_no_damaged_one_and_nothing_is_written_over_it(
    start: Start, folder: Path
) -> None:
    away = (folder / DATABASE).rename(folder / "away")
    (folder / DATABASE).mkdir()  # it cannot be opened
    plane = start(kept=0)
    assert plane.models.current.version == "toy-1"
    plane.models.prune()
    for change in (lambda: plane.models.activate("toy-1+r2"), lambda: plane.models.store.check()):
        with pytest.raises(StoreError, match="at a start"):
            change()
    assert "unable to open" in trouble(plane)
    assert not (folder / DAMAGED).exists()
    (folder / DATABASE).rmdir()
    away.rename(folder / DATABASE)
    assert start().models.current.version == "toy-1+r3"


def test_a_transaction_is_on_the_disk_where_a_folder_cannot_be_synchronised(
    worn: DataPlane, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite itself would say that it failed, after its end, with a stricter setting."""
    synced, fsync = list[bool](), os.fsync

    def sync(descriptor: int) -> None:
        synced.append(stat.S_ISDIR(os.fstat(descriptor).st_mode))
        failing(errno.EINVAL)() if synced[-1] else fsync(descriptor)

    monkeypatch.setattr(os, "fsync", sync)
    with worn.models.store.transaction() as database:
        assert database.execute("PRAGMA synchronous").fetchone() == (2,)
        write_job(database, "job", b"message", 1)
        assert not synced
    assert synced == [True]
    worn.models.rollback()
    assert start().models.current.version == "toy-1+r2"


def test_a_database_that_another_program_holds_is_no_damaged_one(
    worn: DataPlane, start: Start, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda at, **options: connect(at, **{**options, "timeout": 0.01}))
    other = connect(folder / DATABASE, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(StoreError, match="locked"):
        worn.models.rollback()
    with pytest.raises(StoreError, match="locked"):
        start()
    other.close()
    assert start().models.current.version == "toy-1+r3"


def dying(run: Callable[..., sqlite3.Cursor]) -> Callable[..., sqlite3.Cursor]:
    def method(*given: object) -> sqlite3.Cursor:
        Dying.left -= 1
        if Dying.left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return run(*given)

    return method


class Dying(sqlite3.Connection):
    """A connection of a process that is killed at one of its statements."""

    left = 0
    execute, executemany = map(dying, (sqlite3.Connection.execute, sqlite3.Connection.executemany))


def killed(work: Callable[[], object]) -> int:
    """How a process ends that does a work, and ends or is killed."""
    if not (child := os.fork()):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        work()
        os._exit(0)
    return os.waitpid(child, 0)[1]


def test_a_kill_at_any_statement_leaves_all_of_a_change_or_nothing(
    worn: DataPlane, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, state = worn.models.store, worn.models.now.state.noting("toy-1", pinned=True)
    later, found = replace(state, history=state.history.stepped(-1)), set()
    entry = partial(AuditLog(store).write, Entry("rollback", NOBODY, "toy-1+r3", "toy-1+r2"))
    job = partial(write_job, id_="job", message=b"message", kept=1)
    monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Dying))
    for Dying.left in range(20):
        status = killed(partial(store.save, later, entry, job, settles=True))
        Dying.left = 999
        store = start().models.store
        kept = store.contents
        with store.transaction() as database:
            ((lines,),) = database.execute("SELECT count(*) FROM audit WHERE NOT exported")
        found.add((status, kept.state == later, lines, *kept.jobs))
        assert kept.state in (later, worn.models.now.state)
        if status == 0:
            break
    assert found == {(signal.SIGKILL, False, 3), (0, True, 4, "job")}


def earlier_store(folder: Path, base: Decoder, **note: object) -> None:
    """Make a store of a service that had no database, with two jobs."""
    put(folder, "toy-1+r1", "toy-2")
    result = pb.RecalibrationResult(model_version="toy-1+r1")
    jobs = [pb.Job(id="a", state=pb.JOB_STATE_DONE), pb.Job(id="b", state=pb.JOB_STATE_RUNNING, result=result)]
    if note:
        (folder / "current.json").write_text(json.dumps(note | {"base": sha256(base.bundle.manifest.to_json())}))
    (folder / "jobs.json").write_text(json.dumps({"jobs": [json_format.MessageToDict(job) for job in jobs]}))


@pytest.mark.parametrize("how", ["at a statement", "in a write"])
def test_a_kill_in_the_first_transaction_loses_nothing(
    how: str, decoder: Decoder, start: Start, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A write that would make a file larger than the limit kills the process, also in the midst of a COMMIT."""

    def first() -> None:
        if how == "in a write":
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_FSIZE, (left, left))
        else:
            monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Dying))
        Store(folder, decoder.bundle)

    statuses = set()
    for left in range(20) if how == "at a statement" else range(0, 40960, 1024):
        shutil.rmtree(folder, ignore_errors=True)
        earlier_store(folder, decoder, bundle="toy-1+r1.zip")
        Dying.left = left
        statuses.add(killed(first))
        plane = start()
        assert (plane.models.current.version, trouble(plane)) == ("toy-1+r1", "")
        assert list(plane.models.store.contents.jobs) == ["a", "b"]
        plane.models.store.close()
    assert statuses == {signal.SIGKILL if how == "at a statement" else signal.SIGXFSZ, 0}


@pytest.mark.parametrize("note", ["history", "bundle"])
def test_what_a_store_without_a_database_remembers_is_taken_over_once(
    note: str, decoder: Decoder, start: Start, folder: Path
) -> None:
    origins = {"toy-1+r1": "recalibrated", "toy-2": "uploaded"}
    content: dict[str, object] = {
        "history": {"history": [None, "toy-1+r1.zip", "toy-2.zip"], "cursor": 1, "pinned": ["toy-2"]}
        | {"origins": origins, "keys": {"toy-1+r1": "a key"}},
        "bundle": {"bundle": "toy-1+r1.zip"},  # version 0.1.0
    }[note]
    earlier_store(folder, decoder, **content)
    with full_disk(10):
        plane = start()
    assert plane.models.current.version == "toy-1+r1"
    if note == "bundle":
        plane.models.pin("toy-1", False)  # the first change begins the database, with all that was remembered
    for _ in range(2):
        plane = start()
        assert plane.models.current.version == "toy-1+r1"
        assert trouble(plane) == ""
        found = plane.models.store.contents
        assert [pb.Job.FromString(job).state for job in found.jobs.values()] == [pb.JOB_STATE_DONE] * 2
        assert list(found.jobs) == ["a", "b"]
        if note == "history":
            known = {"toy-1+r1": Known(Origin.RECALIBRATED, "a key"), "toy-2": Known(Origin.UPLOADED, None, True)}
            assert (history(plane).versions, found.state.bundles) == (("toy-1", "toy-1+r1", "toy-2"), known)
        assert sorted(path.name for path in folder.glob("*.json*")) == ["current.json.imported", "jobs.json.imported"]


def test_jobs_alone_are_taken_over(decoder: Decoder, start: Start, folder: Path) -> None:
    earlier_store(folder, decoder)
    (folder / "toy-1+r1.zip").unlink()
    assert list(start().models.store.contents.jobs) == ["a", "b"]
    assert [path.name for path in folder.glob("*.json*")] == ["jobs.json.imported"]


@pytest.mark.parametrize("change", [{"cursor": 7}, {"cursor": "x"}, {"history": [3, "../x.zip"]}, {"pinned": 3}])
def test_an_earlier_note_that_contradicts_itself_is_a_damaged_store(
    change: dict[str, object], start: Start, folder: Path
) -> None:
    put(folder, "toy-1+r1")
    note = folder / "current.json"
    note.write_text(json.dumps({"base": "x", "history": [None, "toy-1+r1.zip"], "cursor": 1, "origins": {}} | change))
    assert note.name in trouble(start())
    assert note.exists()


def test_pinned_loaded_and_foreign_bundles_are_never_pruned_and_pruned_ones_leave_the_history(
    start: Start, folder: Path
) -> None:
    names = [f"toy-1+r{number}" for number in range(1, KEPT_BUNDLES + 8)]
    plane = start()
    put(folder, *names[:6])
    for name in ("bench", *names[6:]):
        (folder / f"{name}.zip").write_bytes(b"")
    for age, name in enumerate(["bench", *names]):
        os.utime(folder / f"{name}.zip", (age, age))
    for name in names[:6]:
        plane.models.activate(name)
    plane.models.pin(names[1], True)
    plane.models.prune()
    assert [model.version for model in plane.models.loaded] == names[2:6]
    assert set(plane.models.store.folder.versions()) == {"bench", *names[1:6], *names[-KEPT_BUNDLES:]}
    assert history(plane).versions == history(start()).versions == ("toy-1", *names[1:6])


def test_a_full_disk_is_noticed_and_said_until_there_is_room(
    decoder: Decoder, start: Start, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plane = start()
    store, size = plane.models.store, sum(map(len, decoder.bundle.files.values()))
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2 * size - 1))
        with pytest.raises(StoreError, match="model store"):
            store.check()
        assert str(2 * size) in trouble(plane)
        assert figure(plane, "lightpage_store_trouble", reason="full") == 1
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2 * size))
        assert trouble(plane) == ""
        with pytest.raises(StoreError, match="model store"):
            store.check(2 * size + 1)
    assert figure(plane, "lightpage_store_ok") == 1
    assert sorted(path.name for path in folder.iterdir()) == [LOCK, DATABASE]


def test_a_store_that_cannot_be_written_is_noticed_and_nothing_changes(
    worn: DataPlane, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = worn.models
    with monkeypatch.context() as patch, full_disk(10):
        patch.setattr("lightpage.runtime.service.models.folder.new_file", failing(errno.EROFS))
        for change in (models.rollback, lambda: models.pin("toy-1", True), lambda: models.activate("toy-1")):
            with pytest.raises(StoreError, match="model store"):
                change()
        assert "read-only" in trouble(worn)
        assert figure(worn, "lightpage_store_trouble", reason="read_only") == 1
    assert models.current.version == "toy-1+r3"
    assert not models.now.state.known("toy-1").pinned
    assert trouble(worn) == ""
    assert models.rollback()[0].version == "toy-1+r2"


def test_a_folder_that_is_gone_or_another_is_noticed(start: Start, folder: Path, tmp_path: Path) -> None:
    plane = start()
    assert trouble(plane) == ""
    away = folder.rename(tmp_path / "away")
    assert figure(plane, "lightpage_store_trouble", reason="gone") == 1
    folder.mkdir()  # as under a disk that is not mounted
    (folder / LOCK).touch()
    assert "another folder" in trouble(plane)
    with pytest.raises(StoreError, match="another folder"):
        plane.models.pin("toy-1", True)
    shutil.rmtree(folder)
    away.rename(folder)
    assert trouble(plane) == ""
    (folder / DATABASE).unlink()
    with pytest.raises(StoreError):
        plane.models.pin("toy-1", True)
    assert figure(plane, "lightpage_store_ok") == 1  # there is room; a restart says that it is gone
    assert not (folder / DATABASE).exists()


def test_the_store_is_tried_now_and_then_and_not_whenever_somebody_asks(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = HandClock()
    plane = start(clock=clock.now)
    assert trouble(plane) == ""
    monkeypatch.setattr("lightpage.runtime.service.models.folder.new_file", failing(errno.EROFS))
    clock.advance(PROBE_S - 0.1)
    assert trouble(plane) == ""
    clock.advance(0.1)
    assert "read-only" in trouble(plane)


def test_a_service_without_a_store_has_no_trouble_and_shows_none(decoder: Decoder) -> None:
    plane = DataPlane(Models(decoder))
    plane.models.store.check()
    assert trouble(plane) == ""
    assert figure(plane, "lightpage_store_ok") is None


WAIT_S = 2.0


def test_a_look_at_the_store_that_hangs_is_waited_for_by_nobody_and_shared_by_all() -> None:
    clock, answers, trouble, looks = HandClock(), threading.Event(), "", list[int]()

    def look() -> str:
        looks.append(1)
        answers.wait()
        return trouble

    health = StoreHealth(look, clock=clock)
    assert [health.is_well() for _ in range(8)] == [True] * 8  # nothing is known yet
    clock.advance(LONGEST_S)
    assert health.is_well()
    assert not health.hangs
    clock.advance(0.1)
    assert health.hangs
    assert not health.is_well(WAIT_S)  # no wait: nobody moves the clock
    assert len(looks) == 1
    assert [each.daemon for each in threading.enumerate() if each.name == "lightpage-store-look"] == [True]
    answers.set()
    eventually(lambda: not health.hangs)
    for trouble in ("full", ""):
        assert health.is_well(WAIT_S) == (not trouble)
    assert len(looks) == 3


def test_a_look_that_breaks_is_followed_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda told: None)
    troubles = iter([1, 0, 1])
    health = StoreHealth(lambda: 1 // next(troubles), clock=HandClock())
    assert [health.is_well(WAIT_S) for _ in range(3)] == [False, False, False]
