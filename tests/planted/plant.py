"""Plants each fault of the list in a copy of the files, and tells which of them the named tests find."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.planted.faults import ROOT, Fault, load

WORKERS = 2
KEPT = ("tests/planted/", "tests/clock.py", "tests/waiting.py")
"""What stays the working tree's, where the tests are those of another revision."""
PYTEST = (sys.executable, "-m", "pytest", "-xq", "-m", "not long", "-p", "no:cacheprovider", "--tb=line")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")


def git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout


def digest(*what: object) -> str:
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def copy(folder: Path, revision: str | None) -> None:
    """Copy the tracked files, with the tests of a revision if one is named."""
    for name in filter(None, git("ls-files", "-z").decode().split("\0")):
        old = revision and name.startswith("tests/") and not name.startswith(KEPT)
        if (ROOT / name).is_file() and not old:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    if revision:
        left_out = [f"--exclude={name.rstrip('/')}" for name in KEPT]
        subprocess.run(["tar", "-x", "-C", folder, *left_out], input=git("archive", revision, "tests"), check=True)


def run(folder: Path, tests: list[str], limit_s: float, fault: Fault | None) -> dict[str, Any]:
    """Run test files in a copy, with a fault if there is one: whether they pass, who fails, seconds, and last words."""
    if fault:
        path, whole = folder / fault.file, ROOT / fault.file
        path.write_text(fault.planted())
        other = int(whole.stat().st_mtime) + 2 + int(digest(fault.key)[:6], 16)
        os.utime(path, (other, other))  # by its second Python tells whether what it compiled is of this file
    began, environment = time.monotonic(), {**os.environ, **ONE_THREAD, "PYTHONPATH": str(folder)}
    with (
        tempfile.TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as made,
        open(f"{made}/out", "w") as out,
    ):
        process = subprocess.Popen(
            [*PYTEST, f"--basetemp={made}/tests", *tests],
            **{"cwd": folder, "env": environment, "start_new_session": True},
            **{"stdin": subprocess.DEVNULL, "stdout": out, "stderr": subprocess.STDOUT},
        )  # type: ignore[call-overload]
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:  # nothing that the tests began stays
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
                time.sleep(0.2)
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if fault:
                shutil.copy2(whole, path)
        told = Path(out.name).read_text(errors="replace")
    failed = (
        [*re.findall(r"^(?:FAILED|ERROR) (\S+)", told, re.M), *told.splitlines()[-1:], "?"][0] if code else "a hang"
    )
    seconds = round(time.monotonic() - began, 1)
    return {"passed": code == 0, "by": failed if code != 0 else "", "seconds": seconds, "out": told[-4000:]}


def measure(faults: list[Fault], given: argparse.Namespace, temporary: Path) -> list[dict[str, Any]]:
    """Run every named test file as it is, which must pass, and then each fault's."""
    names = sorted({name for fault in faults for name in fault.tests})
    copies = queue.SimpleQueue[Path]()
    for number in range(WORKERS):
        copies.put(folder := temporary / str(number) / "copy")
        copy(folder, given.tests)
    if missing := [name for name in names if not (folder / name).is_file()]:
        sys.exit(f"no such test files: {', '.join(missing)}")
    files = [row for row in git("ls-tree", "-r", "HEAD").splitlines() if b"\ttests/planted/" not in row]
    today = digest(files, git("diff", "HEAD", "--", ".", ":!tests/planted"), given.tests)
    results = given.out or temporary
    results.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}

    def result(one: Fault | str) -> dict[str, Any]:
        fault = one if isinstance(one, Fault) else None
        tests = sorted(one.tests, key=lambda name: seconds[name]) if isinstance(one, Fault) else [one]
        limit_s = given.timeout or (60 + 5 * sum(seconds[name] for name in tests) if fault else 600)
        kept = results / f"{digest(today, tests, fault and fault.key)}.json"
        if not kept.exists():
            folder = copies.get()
            try:
                made = run(folder, tests, limit_s, fault)
            finally:
                copies.put(folder)
            kept.with_suffix(".part").write_text(json.dumps(made, indent=1))
            kept.with_suffix(".part").replace(kept)
        return dict(json.loads(kept.read_text()))

    rows: list[dict[str, Any]] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for name, got in zip(names, pool.map(result, names), strict=True):
            seconds[name] = got["seconds"]
            print(f"[{len(seconds)}/{len(names)}] as it is {got['seconds']:6.1f} s  {name}", flush=True)
            if not got["passed"]:
                pool.shutdown(wait=False, cancel_futures=True)
                sys.exit(f"{name} fails without a fault:\n{got['out']}")
        for fault, got in zip(faults, pool.map(result, faults), strict=True):
            own = {"id": fault.id, "area": fault.area, "kind": fault.kind, "file": fault.file}
            rows.append({**own, "found": not got["passed"], "by": got["by"], "seconds": got["seconds"]})
            word = "found    " if rows[-1]["found"] else "NOT FOUND"
            print(f"[{len(rows)}/{len(faults)}] {word} {got['seconds']:6.1f} s  {fault.id:23} {got['by']}", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", metavar="ID", help="a fault; several times for several")
    parser.add_argument("--tests", metavar="REV", help="take tests/ from this git revision")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keeps results: the same command goes on")
    parser.add_argument("--json", type=Path, metavar="FILE", help="for the results")
    parser.add_argument("--timeout", type=float, metavar="S", help="of a fault; 60, and 5 times as long as without it")
    given = parser.parse_args()
    faults = [fault for fault in load()[0] if fault.id in (given.only or [fault.id])]
    for fault in faults:
        fault.planted()
    with tempfile.TemporaryDirectory() as temporary:
        rows = measure(faults, given, Path(temporary))
    told: dict[str, Any] = {"commit": git("describe", "--always", "--dirty").decode().strip(), "tests": given.tests}
    for of in ("kind", "area"):
        groups = {row[of]: [other["found"] for other in rows if other[of] == row[of]] for row in rows}
        told[f"by {of}"] = {name: f"{sum(found)}/{len(found)}" for name, found in sorted(groups.items())}
        print(f"by {of}: {', '.join(f'{name} {share}' for name, share in told[f'by {of}'].items())}")
    told["found"] = f"{sum(row['found'] for row in rows)} of {len(rows)}"
    print(f"found: {told['found']}")
    if given.json:
        given.json.write_text(json.dumps({**told, "faults": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
