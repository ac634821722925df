"""The benchmark on a GPU: nothing is measured twice or begun too late, and a target that nobody measured says so."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.gpu.bench import main
from analysis.gpu.kept_parts import Kept
from analysis.gpu.targets import RATES, table, targets
from lightpage.errors import InvalidInputError, ProviderError
from tests.clock import HandClock


def test_parts_are_kept_and_none_is_begun_that_ends_too_late(tmp_path: Path) -> None:
    clock, path = HandClock(), tmp_path / "gpu.json"
    kept = Kept(path, {"card": "A"}, 100, clock)
    assert kept.part("fast, form", 10, lambda: clock.advance(30) or 1) == 1
    assert kept.part("slow, form", 10, lambda: clock.advance(45) or 2) == 2  # 45 of 70 s are left
    assert kept.part("bundle", 20, lambda: 1 / 0) is None
    assert kept.part("late, form", 10, lambda: 3) is None  # as long as others of its kind
    assert kept.left_out == ["bundle", "late, form"]
    again = Kept(path, {"card": "A"}, 100, clock)
    assert again.part("slow, form", 1000, lambda: 0) == 2
    assert again.part("bundle", 20, lambda: 4) == 4
    with pytest.raises(InvalidInputError):
        Kept(path, {"card": "B"}, 100)


def test_every_target_has_a_verdict() -> None:
    batch = {"pages": 1, "pages_per_s": 160.0, "graph_ms_a_page": 6.0, "alone_ms": 40.0, "air": [4.8], "memory_gb": 8.3}
    parts = {
        "standard, 1 a batch": batch,
        "standard, present": {"air": [4.8, 4.7]},
        "standard, floor": {"bytes_ms": 2.5},
    }
    parts["service"] = {"in_process_pages_per_s": 100.0, "over_in_process": 0.96}
    parts["page code"] = {"full size 4x4": {"compiled_ms": 7.0, "user_bytes": 50_000}}
    verdicts = [target.verdict for target in targets(parts, "full size 4x4")]
    assert [verdicts.count(name) for name in ("stretch met", "met", "missed", "not measured")] == [1, 5, 1, 11]
    assert len(table(parts, "full size 4x4")) == 6 + len(verdicts)
    assert {target.verdict for target in targets({}, "bench 4x4")} == {"not measured"}
    assert RATES["standard"][0] < batch["pages_per_s"] < RATES["standard"][1]


def test_an_onnxruntime_without_the_gpu_is_refused_by_name(tmp_path: Path) -> None:
    refused = CliRunner().invoke(main, ["--out", str(tmp_path / "out")])
    assert isinstance(refused.exception, ProviderError)
    assert not (tmp_path / "out").exists()
