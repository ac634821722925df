"""Commands that need no Linux run where its calls are absent, and others say so. No other system is at hand."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from lightpage.recording.reader import Recording
from tests.lightpage.small import small_profile
from tests.runtime import coded, toy

ELSEWHERE = """
import asyncio, multiprocessing.connection, os, select, signal, socket, socketserver, subprocess, sys
import grpc, h5py, matplotlib.figure, onnxruntime, scipy.optimize, scipy.signal, tqdm.rich  # they look after themselves
import torch, lightning.pytorch.trainer.connectors.signal_connector as signals  # so do they, by the system's name
signals._SignalConnector.register_signal_handlers = signals._SignalConnector.teardown = lambda self: None
GONE = {"fcntl", "grp", "pwd", "resource", "termios"}
LACKING = {
    os: "fork sched_getaffinity memfd_create MFD_CLOEXEC pread pwrite posix_fallocate O_CLOEXEC O_NOFOLLOW O_NONBLOCK "
        "O_DIRECTORY geteuid getuid setsid killpg statvfs uname nice sysconf fchmod chown mkfifo ttyname sync",
    signal: "SIGHUP SIGKILL SIGALRM SIGUSR1 SIGUSR2 SIGCHLD SIGPIPE SIGQUIT setitimer alarm pthread_sigmask",
    socket: "AF_UNIX AF_PACKET send_fds recv_fds SO_REUSEPORT",
    select: "poll epoll",
    socketserver: "UnixStreamServer UnixDatagramServer",
}
class Gone:
    def find_spec(self, name, path=None, target=None):
        if name in GONE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Gone())
for name in (*GONE, "tty"):
    sys.modules.pop(name, None)
for module, names in LACKING.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
import json
import lightpage
from lightpage.cli.main import lightpage as commands, run
assert all(getattr(lightpage, name) for name in lightpage.__all__)
print(json.dumps([run(commands, line.split()) for line in json.loads(sys.argv[1])]))
"""


def test_what_needs_no_linux_runs_without_its_calls(toy_zip: Path, small_device: list[str], tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(small_profile().to_toml())
    toy.write_toy_recording(tmp_path / "toy.h5", toy.ToyDevice(), 16, 2)
    bundle = coded.bundle(tmp_path / "coded.zip")
    coded.recording(tmp_path / "pages.h5", coded.pages(bundle, tmp_path))
    lines = [
        "simulate --profile small.toml --pages 2 --out R.h5",
        "inspect R.h5 --json I.json",
        f"evaluate --bundle {toy_zip} --recording toy.h5 --json E.json",
        f"recover --bundle {bundle} --recording pages.h5 --out read.bin --no-tracking",
        f"train {' '.join(small_device)} --out run --steps 10 --channels 4 --blocks 1 --refinements 0 "
        "--synthetic-pages 0 --validation-share 0.25 --test-share 0.5",
        "serve --help",
        "serve --print-config",
    ]
    command = [sys.executable, "-c", ELSEWHERE, json.dumps(lines)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [0, 0, 0, 0, 0, 0, 2], done.stderr
    assert "fcntl" in done.stderr.splitlines()[-1]
    with Recording.open(tmp_path / "R.h5") as recording:
        assert np.ptp(recording.frames(1).in_phase) > 0
    assert json.loads((tmp_path / "E.json").read_text())["pages"] == 2
    assert (tmp_path / "run" / "run.json").is_file()
    assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
