"""What stores remember whose service had no database yet, as that of version 0.1.0."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from google.protobuf import json_format

from lightpage.errors import BundleError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.models.database import Contents
from lightpage.runtime.service.models.history import History, Known, Origin, State

EARLIER = CURRENT, JOBS = "current.json", "jobs.json"
_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, json_format.Error, BundleError)

_log = logging.getLogger(__name__)


def read_earlier(folder: Path, base_version: str) -> Contents:
    """Return what a store without a database remembers.

    Raises:
        FileNotFoundError: nothing.
        BundleError: its note is damaged. Jobs that are damaged are forgotten, with a warning.
    """
    try:
        note = json.loads((folder / CURRENT).read_text("utf-8"))
        names = note["history"] if "history" in note else [None, *filter(None, [note["bundle"]])]
        versions = tuple(base_version if name is None else name.removesuffix(".zip") for name in names)
        origins, keys, pinned = note.get("origins", {}), note.get("keys", {}), set(note.get("pinned", []))
        own = {version: keys.get(version, "") for version in origins if origins[version] == Origin.RECALIBRATED}
        bundles = {
            version: Known(
                Origin(origins[version]) if version in origins else None, own.get(version), version in pinned
            )
            for version in {*origins, *pinned}
        }
        state = State(History(versions, int(note.get("cursor", len(versions) - 1))), bundles)
        contents = Contents(str(note["base"]), state, _jobs(folder, state.history.current))
        contents.check()
    except FileNotFoundError:
        raise
    except _DAMAGED as error:
        raise BundleError(str(folder / CURRENT), repr(error), "a note that can be read") from None
    return contents


def _jobs(folder: Path, current: str) -> dict[str, bytes]:
    try:
        noted = json.loads((folder / JOBS).read_text("utf-8"))["jobs"]
        jobs = [json_format.ParseDict(job, pb.Job(), ignore_unknown_fields=True) for job in noted]
    except FileNotFoundError:
        return {}
    except _DAMAGED as error:
        _log.warning("jobs of earlier are forgotten: %s cannot be read: %r", folder / JOBS, error)
        return {}
    for job in jobs:
        if job.state == pb.JOB_STATE_RUNNING and job.result.model_version == current:
            job.state = pb.JOB_STATE_DONE  # the service was killed before it noted so
    return {job.id: job.SerializeToString() for job in jobs}
