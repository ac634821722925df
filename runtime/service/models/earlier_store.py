"""Reader of stores whose service had no database yet, as that of version 0.1.0."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from google.protobuf import json_format

from lightpage.errors import BundleError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.models.database import Contents
from lightpage.runtime.service.models.history import Origin, state_of

CURRENT, JOBS = "current.json", "jobs.json"
_DAMAGED = (ValueError, LookupError, TypeError, AttributeError, RecursionError, json_format.Error)

_log = logging.getLogger(__name__)


def read_earlier(folder: Path, fresh: Contents) -> Contents:
    """Return what a store without a database remembers; of what it does not, what is `fresh`.

    A note that is damaged is lost. Jobs that are damaged are forgotten, with a warning.

    Raises:
        OSError: it cannot be read.
    """
    contents = fresh
    if (note := folder / CURRENT).exists():
        try:
            contents = _noted(json.loads(note.read_bytes()), fresh.state.history.current)
            contents = replace(contents, sources=(note,))
        except _DAMAGED as error:
            contents = replace(fresh, lost=str(BundleError(str(note), repr(error), "a note that can be read")))
    if (jobs := folder / JOBS).exists():
        try:
            found = _jobs(json.loads(jobs.read_bytes())["jobs"], contents.state.history.current)
            contents = replace(contents, jobs=found, sources=(*contents.sources, jobs))
        except _DAMAGED as error:
            _log.warning("jobs of earlier are forgotten: %s cannot be read: %r", jobs, error)
    return contents


def _noted(note: dict[str, Any], base_version: str) -> Contents:
    names = note["history"] if "history" in note else [None, *filter(None, [note["bundle"]])]
    versions = tuple(base_version if name is None else name.removesuffix(".zip") for name in names)
    origins, keys, pinned = note.get("origins", {}), note.get("keys", {}), set(note.get("pinned", []))
    own = {version: keys.get(version, "") for version in origins if origins[version] == Origin.RECALIBRATED}
    bundles = {
        version: {"origin": origins.get(version), "key": own.get(version), "pinned": version in pinned}
        for version in {*origins, *pinned}
    }
    history = {"versions": versions, "cursor": note.get("cursor", len(versions) - 1)}
    return Contents(str(note["base"]), state_of({"history": history, "bundles": bundles}))


def _jobs(noted: list[dict[str, Any]], current: str) -> dict[str, bytes]:
    jobs = [json_format.ParseDict(job, pb.Job(), ignore_unknown_fields=True) for job in noted]
    for job in jobs:
        if job.state == pb.JOB_STATE_RUNNING and job.result.model_version == current:
            job.state = pb.JOB_STATE_DONE  # the service was killed before it noted so
    return {job.id: job.SerializeToString() for job in jobs}
