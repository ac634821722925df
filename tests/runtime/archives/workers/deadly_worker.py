"""A worker that dies or waits at ranges of whose recording a file beside it says so."""

import os
import signal
import threading

from lightpage.runtime.archives.run.task import Outcome, Task
from lightpage.runtime.archives.workers.local_worker import LocalWorker
from lightpage.runtime.archives.workers.work import Worker

KILLS, BEGUN = ".kills", ".begun"


class Deadly(Worker):
    def work(self, task: Task) -> Outcome:
        kills = task.recording.with_suffix(f".{task.pages[0]}{KILLS}")
        if kills.exists() and (left := int(kills.read_text())):
            kills.write_text(str(left - 1))
            os.kill(os.getpid(), signal.SIGKILL)
        begun = task.recording.with_suffix(BEGUN)
        if begun.exists():
            begun.write_text(str(os.getpid()))
            threading.Event().wait()
        return super().work(task)


class DeadlyWorker(LocalWorker):
    kind = Deadly
