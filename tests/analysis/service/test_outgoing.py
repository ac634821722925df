"""The trace of a service shows whom it calls."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from analysis.service.outgoing import PLANTED, Called, by_phase, calls, seen_when_planted
from lightpage.errors import LightpageError

TRACE = """\
71 1764100000.100000 connect(3, {sa_family=AF_UNIX, sun_path="/var/run/nscd/socket"}, 110) = -1 ENOENT (No such file)
71 1764100000.200000 connect(3, {sa_family=AF_INET, sin_port=htons(50052), sin_addr=inet_addr("127.0.0.1")}, 16) = 0
72 1764100000.300000 sendto(4, [{nlmsg_len=20}], 20, 0, {sa_family=AF_NETLINK, nl_pid=0, nl_groups=00000000}, 12) = 20
73 1764100001.100000 connect(5, {sa_family=AF_INET6, sin6_port=htons(443), sin6_flowinfo=htonl(0), \
inet_pton(AF_INET6, "2001:db8::7", &sin6_addr), sin6_scope_id=0}, 28 <unfinished ...>
73 1764100001.200000 <... connect resumed>) = -1 EINPROGRESS (Operation now in progress)
74 1764100001.300000 sendmmsg(6, [{msg_hdr={msg_name={sa_family=AF_INET, sin_port=htons(9), \
sin_addr=inet_addr("192.0.2.9")}, msg_namelen=16}, msg_len=3}], 1, 0) = 1
74 1764100001.400000 connect(6, {sa_family=AF_INET, sin_port=htons(53), sin_addr=inet_addr("127.0.0.53")}, 16) = 0
74 1764100002.000000 +++ exited with 0 +++
"""


def test_addresses_of_other_machines_and_name_servers_are_outgoing(tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    trace.write_text(TRACE)
    found = list(calls(trace))
    assert [(call.call, call.address, call.port) for call in found if call.outgoing] == [
        ("connect", "2001:db8::7", 443),
        ("sendmmsg", "192.0.2.9", 9),
        ("connect", "127.0.0.53", 53),
    ]
    assert [call.address for call in found if not call.outgoing] == ["/var/run/nscd/socket", "127.0.0.1"]
    phases = by_phase(found, {"start": 1764100000.15, "decode": 1764100001.0, "stop": 1764100001.35})
    assert [counted.total() for counted in phases.values()] == [2, 2, 1]


@pytest.mark.parametrize("address", ["127.0.0.1", "::1", "0.0.0.0", "::"])
def test_this_machine_is_not_outgoing(address: str) -> None:
    assert not Called(0.0, "connect", address, 50051).outgoing


def test_what_goes_past_the_trace_is_no_silence(tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    trace.write_text("71 1764100000.100000 io_uring_setup(8, {flags=0}) = 4\n")
    with pytest.raises(LightpageError, match="past which nothing is seen"):
        list(calls(trace))


def test_planted_calls_are_seen(tmp_path: Path) -> None:
    if shutil.which("strace") is None:
        pytest.skip("strace is not installed")
    assert {call.address: call.port for call in seen_when_planted(tmp_path)} == PLANTED
