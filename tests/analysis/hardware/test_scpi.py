"""The bench of the serial line counts what it says, and would see an answer that is given to the wrong query."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.hardware.scpi import Experiment, emulated, main
from runtime.trigger.scpi_port import ScpiPort
from runtime.virtual_device.serial_port import Fault


def test_no_answer_is_given_to_the_wrong_query(tmp_path: Path) -> None:
    arguments = f"--queries 60 --fault-rate 0.1 --unplug-every 20 --json {tmp_path}/scpi.json"
    done = CliRunner().invoke(main, arguments.split(), standalone_mode=False, catch_exceptions=False)
    found = json.loads((tmp_path / "scpi.json").read_text())
    assert (found["wrong_query"], found["altered"]) == (0, 0)
    assert found["unplugged"] == 3
    assert found["right"] + sum(found["lost"].values()) == found["queries"]
    assert found["right"] > 30
    assert sum(found["faults"].values()) > 5
    assert "answered with another's value" in done.output


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_without_faults_every_query_is_answered(kind: str) -> None:
    with emulated(kind, 1) as (port, device):
        outcome = Experiment(port, device, 0.0, 1).run(40, 1000)
    assert (outcome.right, outcome.queries, dict(outcome.lost)) == (40, 40, {})


def test_a_line_that_does_not_synchronise_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(self: ScpiPort, port: object) -> None:
        self._synchronised = True
        self._buffer.clear()

    def once(self: ScpiPort, *query: object) -> str:
        return self.ask(*query)[0]  # type: ignore[arg-type]

    monkeypatch.setattr(ScpiPort, "_synchronise", nothing)
    monkeypatch.setattr(ScpiPort, "ask_twice", once)
    with emulated("pty", 2) as (port, device):
        experiment = Experiment(port, device, 0.0, 2)
        port.late_s = (0.15, 0.2)
        late = iter([True, False, False, False] * 20)
        port.fault = lambda message: Fault.LATE if message.endswith("?") and next(late, False) else None
        outcome = experiment.run(40, 1000)
    assert outcome.wrong_query > 0
