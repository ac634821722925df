"""A worker's process, started by `local` with its number of threads."""

from __future__ import annotations

import os
import queue
import sys
import threading

from lightpage.helper_process import parent_link
from lightpage.runtime.archives.run.task import Task
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.model.execution.memory import share_freed_memory

_DRIVER_GONE = 3


def main(worker: Worker) -> None:
    """Have it do one task after the other until the driver is gone or wants no more, whatever is being done then."""
    share_freed_memory()
    link = parent_link()
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        try:
            with link.makefile("rb") as lines:
                for line in lines:
                    tasks.put(line)
        finally:
            os._exit(_DRIVER_GONE)

    threading.Thread(target=listen, name="lightpage-driver", daemon=True).start()
    worker.tell = lambda step: link.sendall(step.model_dump_json().encode() + b"\n")
    while True:
        outcome = worker.work(Task.model_validate_json(tasks.get()))
        link.sendall(outcome.model_dump_json().encode() + b"\n")


if __name__ == "__main__":
    main(Worker(int(sys.argv[1])))
