"""Count of the CPU cores that this process may use: by affinity and control group, not by the machine's size."""

import math
from pathlib import Path

from lightpage.systems import cores

CGROUP_ROOT = Path("/sys/fs/cgroup")


def available_cpus(root: Path = CGROUP_ROOT, membership: Path = Path("/proc/self/cgroup")) -> int:
    """Cores that this process may keep busy, at least 1.

    The smaller of the scheduler affinity and the CPU quota of its control group and all groups above it (version 1 or
    2, rounded up). `os.cpu_count` would report the whole machine inside a container and oversubscribe it.

    Args:
        root: where control groups are mounted.
        membership: the kernel's list of this process's groups.
    """
    there = cores()
    quotas = [quota for folder in _folders(root, membership) if (quota := _quota(folder)) is not None]
    return max(1, min([there, *(math.ceil(quota) for quota in quotas)]))


def _folders(root: Path, membership: Path) -> list[Path]:
    """Folders that may hold a quota for this process: its own group and every group above it."""
    folders = {root, root / "cpu", root / "cpu,cpuacct"}
    try:
        lines = membership.read_text("utf-8").splitlines()
    except OSError:
        lines = []
    for line in lines:
        _, controllers, group = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        for base in (root / controllers, root / "cpu") if controllers else (root, root / "unified"):
            parts = Path(group.lstrip("/")).parts
            folders |= {base.joinpath(*parts[:depth]) for depth in range(len(parts) + 1)}
    return sorted(folders)


def _quota(folder: Path) -> float | None:
    """Cores that the group at `folder` may use, or None where it sets no limit."""
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            words = " ".join((folder / name).read_text("utf-8") for name in names).split()
            quota, period = float(words[0]), float(words[1])
        except (OSError, ValueError, IndexError):
            continue  # no such file, or "max": no limit of this kind
        if quota > 0 and period > 0:
            return quota / period
    return None
