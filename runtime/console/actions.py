"""Actions of a person on the console: recalibrate, and go back to the model before."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.answers import job_info
from lightpage.runtime.client.wire.status import without_folders
from lightpage.runtime.recalibration.known_pages import MIN_PAGES
from lightpage.runtime.service.caller import Actor, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator

ROLE = Role.ADMIN
"""Who may do all of it."""


class _Asked(BaseModel):
    model_config = ConfigDict(extra="forbid")

    action: Literal["recalibrate", "roll back"]
    expected: str = Field(pattern="^[!-~]+$")


class Actions:
    """Does what the console asks for with a service's models and recalibrator.

    Args:
        plane: data plane with the models.
        recalibrator: recalibrator of the service.
        pages: numbers of the source's fully known pages, as self-calibration has them; none for the first two that the
            source has.
    """

    def __init__(self, plane: DataPlane, recalibrator: Recalibrator, pages: Sequence[int] = ()) -> None:
        self._plane, self._recalibrator, self._pages = plane, recalibrator, pages or range(MIN_PAGES)

    def available(self) -> list[str]:
        """Return the actions that make sense now."""
        found = ["recalibrate"] if self._plane.has_source else []
        return [*found, "roll back"] if self._plane.models.now.state.history.cursor else found

    def job(self) -> dict[str, Any] | None:
        """Return how the newest recalibration stands, as JSON has it; None where there has been none."""
        jobs = self._recalibrator.jobs.all()
        if not jobs:
            return None
        job = job_info(jobs[0])
        told = job.step if job.result is None else job.result.told
        if job.error is not None:
            told = without_folders(str(job.error))
        return {"id": job.id, "state": job.state, "fraction": job.fraction, "told": told}

    def do(self, content: bytes, actor: Actor) -> str:
        """Do what a JSON object asks for: its `action`, with the model `expected` in service; return what came of it.

        Raises:
            InvalidInputError: no such object.
            LightpageError: it could not be done; nothing was changed.
        """
        try:
            asked = _Asked.model_validate_json(content)
        except ValidationError as error:
            got = "; ".join(": ".join([*map(str, each["loc"]), each["msg"]]) for each in error.errors())
            expected = 'a JSON object of "action" and "expected", the version of the model in service'
            raise InvalidInputError("action", got, expected) from None
        if asked.action == "roll back":
            current, before = self._plane.models.rollback(asked.expected, actor=actor)
            return f"{current.version} is in service again, {before.version} is not"
        # By number: whoever reads the source's next pages goes on where it was.
        pages = self._recalibrator.source_pages(0, self._pages)
        return f"job {self._recalibrator.start(pages, asked.expected, 'console', actor).id} has begun"
