"""The process of one GenTL camera, started by `gentl` with a TASK and a socket on its stdin.

Producers are libraries of camera makers, and harvesters holds the interpreter while it waits for a frame. Neither is to
happen in the process that serves. It ends when the socket's other end does.
"""

from __future__ import annotations

import mmap
import os
import sys
import threading

from lightpage.helper_process import parent_link
from lightpage.runtime.device.cameras.gentl_device import CameraGoneError, CameraRefusedError, GenTLDevice
from lightpage.runtime.device.cameras.gentl_link import Answer, Do, Failure, Request, Task

_FAREWELL_S = 2.0
"""A producer that does not let go of its camera for so long is left as it is."""


def main(task_json: str) -> int:
    """Do what comes over the socket until its other end is closed."""
    task = Task.model_validate_json(task_json)
    with parent_link() as link, mmap.mmap(task.memory, task.memory_bytes) as memory:
        try:
            device = GenTLDevice(task)
        except CameraRefusedError as error:
            link.sendall(Answer(number=0, failure=_failure(error, gone=False)).to_line())
            return 1
        try:
            link.sendall(Answer(number=0).to_line())
            with link.makefile("rb") as stream:
                for line in stream:
                    link.sendall(_answer(device, Request.model_validate_json(line), memory).to_line())
        except OSError:
            pass  # the other end is closed
        finally:
            _say_farewell(device)
    return 0


def _answer(device: GenTLDevice, request: Request, memory: mmap.mmap) -> Answer:
    number = request.number
    try:
        if request.do is Do.ARM:
            return Answer(number=number, ready=device.arm())
        if request.do is Do.FRAME:
            return Answer(number=number, arrived=device.frame(request.timeout_s, memory))
        if request.do is Do.FIRE:
            device.fire()
        else:
            device.disarm()
    except CameraRefusedError as error:
        return Answer(number=number, failure=_failure(error, gone=False))
    except CameraGoneError as error:
        return Answer(number=number, failure=Failure(gone=True, got=str(error), expected="a camera that answers"))
    return Answer(number=number)


def _failure(error: CameraRefusedError, gone: bool) -> Failure:
    return Failure(gone=gone, setting=error.setting, got=error.got, expected=error.expected)


def _say_farewell(device: GenTLDevice) -> None:
    """Let go of the camera; a producer that hangs is not waited for."""
    last_call = threading.Timer(_FAREWELL_S, os._exit, (1,))
    last_call.daemon = True
    last_call.start()
    device.close()
    last_call.cancel()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
