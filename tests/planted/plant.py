"""Plants each fault of the list in a copy of the files, and tells which of them the named tests find."""

import argparse
import contextlib
import hashlib
import json
import os
import queue
import re
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
KEPT = ("tests/planted", "tests/clock.py", "tests/waiting.py")  # from today's files, whatever --tests says
PYTEST = (sys.executable, "-m", "pytest", "-xq", "-m", "not long", "-p", "no:cacheprovider", "--tb=line")


def git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout


def digest(*what: object) -> str:
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def run(folder: Path, tests: list[str], limit_s: float, fault: Fault | None) -> dict[str, Any]:
    """Run test files in a copy, with a fault if there is one: whether they pass, what fails, seconds, last words."""
    path = folder / (fault.file if fault else tests[0].partition("::")[0])
    whole, began = path.read_text(), time.monotonic()
    if fault:
        path.write_text(fault.planted(folder))
        second = 2e9 + int(digest(fault)[:6], 16)
        os.utime(path, (second, second))  # it tells Python whether what it has compiled is of this text
    with tempfile.TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as made:
        command, out = [*PYTEST, f"--basetemp={made}/tests", *tests], Path(made, "out")
        own: Any = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": str(folder)}, "start_new_session": True}
        with out.open("wb") as file:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, **own)
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            for number in (signal.SIGTERM, signal.SIGKILL):  # to whatever the tests began and left
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
                    time.sleep(0.2)
            process.wait()
            path.write_text(whole)
        told = out.read_text(errors="replace")
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", told, re.M) or told.splitlines()[-1:] or ["?"]
    by = {0: "", None: "a hang"}.get(code, failed[0])
    return {"passed": code == 0, "by": by, "seconds": round(time.monotonic() - began, 1), "out": told[-4000:]}


def measure(faults: list[Fault], given: argparse.Namespace, temporary: Path) -> list[dict[str, Any]]:
    """Run every named test file as it is, which must pass, and then each fault's."""
    today = git("-c", "user.name=planted", "-c", "user.email=planted", "stash", "create").decode().strip() or "HEAD"
    parts = [(today, ".", ":!tests"), (given.tests, "tests"), (today, *KEPT)] if given.tests else [(today, ".")]
    copies, results = queue.SimpleQueue[Path](), given.out or temporary
    for folder in (temporary / str(number) / "copy" for number in range(WORKERS)):
        folder.mkdir(parents=True)
        for revision, *paths in parts:
            subprocess.run(["tar", "-x", "-C", folder], input=git("archive", revision, "--", *paths), check=True)
        copies.put(folder)
    files = [row for row in git("ls-tree", "-r", today).splitlines() if b"\ttests/planted/" not in row]
    state, names = digest(files, given.tests), sorted({name for fault in faults for name in fault.tests})
    results.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    seconds: dict[str, float] = {}

    def result(one: Fault | str) -> dict[str, Any]:
        fault = one if isinstance(one, Fault) else None
        tests = sorted(one.tests, key=lambda name: seconds[name]) if isinstance(one, Fault) else [one]
        limit_s = given.timeout or (60 + 5 * sum(seconds[name] for name in tests) if fault else 600)
        kept = results / f"{digest(state, tests, fault)}.json"
        if kept.exists():
            return dict(json.loads(kept.read_text()))
        folder, made, left = copies.get(), dict[str, Any](), 3
        try:
            while left:  # a test that fails once, and then not, finds nothing
                made = run(folder, tests, limit_s, fault)
                left = 0 if made["passed"] or not run(folder, [made["by"]], limit_s, fault)["passed"] else left - 1
        finally:
            copies.put(folder)
        if made["passed"] or fault:
            kept.with_suffix(".part").write_text(json.dumps(made, indent=1))
            kept.with_suffix(".part").replace(kept)
        return made

    pool = ThreadPoolExecutor(WORKERS)
    try:
        for name, got in zip(names, pool.map(result, names), strict=True):
            seconds[name] = got["seconds"]
            print(f"[{len(seconds)}/{len(names)}] as it is {got['seconds']:6.1f} s  {name}", flush=True)
            if not got["passed"]:
                sys.exit(f"{name} fails without a fault:\n{got['out']}")
        for fault, got in zip(faults, pool.map(result, faults), strict=True):
            word, of = "NOT FOUND" if got["passed"] else "found    ", {"area": fault.area, "kind": fault.kind}
            rows.append({"id": fault.id, **of, "found": not got["passed"], "by": got["by"], "seconds": got["seconds"]})
            print(f"[{len(rows)}/{len(faults)}] {word} {got['seconds']:6.1f} s  {fault.id:23} {got['by']}", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    known = [fault.id for fault in load("fault")]
    parser.add_argument("--only", action="append", choices=known, metavar="ID", help="a fault; may be repeated")
    parser.add_argument("--tests", metavar="REV", help="take tests/ from this git revision")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keeps results: the same command goes on")
    parser.add_argument("--json", type=Path, metavar="FILE", help="file for the results")
    parser.add_argument("--timeout", type=float, metavar="S", help="seconds; 60, and 5 times as long as without it")
    given = parser.parse_args()
    faults = [fault for fault in load("fault") if fault.id in (given.only or [fault.id])]
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
