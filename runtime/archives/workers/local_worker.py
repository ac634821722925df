"""A worker's process, started by `local` with its number of threads."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading

from lightpage.helper_process import parent_link
from lightpage.runtime.archives.run.task import Outcome, Step, Task
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.model.execution.memory import share_freed_memory

_DRIVER_GONE = 3


def main(worker: Worker) -> None:
    """Have it do one task after the other until the driver is gone or wants no more, whatever is being done then."""
    share_freed_memory()
    link = parent_link()
    threading.Thread(target=_end_with_driver, args=(link,), name="lightpage-driver", daemon=True).start()

    def answer(told: Outcome | Step) -> None:
        link.sendall(told.model_dump_json().encode() + b"\n")

    worker.tell = answer
    for line in link.makefile("rb"):
        answer(worker.work(Task.model_validate_json(line)))


def _end_with_driver(link: socket.socket) -> None:
    """End this process once the other end of its socket is closed."""
    hung_up = select.poll()
    hung_up.register(link, 0)
    hung_up.poll()
    os._exit(_DRIVER_GONE)


if __name__ == "__main__":
    main(Worker(int(sys.argv[1])))
