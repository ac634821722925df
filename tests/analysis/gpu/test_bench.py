"""The benchmark on a GPU: nothing is measured twice or begun too late, and a target that nobody measured says so."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from analysis.gpu.bench import main
from analysis.gpu.kept_parts import Kept
from analysis.gpu.targets import table, targets
from lightpage.errors import InvalidInputError, ProviderError
from tests.clock import HandClock


def test_parts_are_kept_and_none_is_begun_that_ends_too_late(tmp_path: Path) -> None:
    clock, path = HandClock(), tmp_path / "gpu.json"
    kept = Kept(path, {"card": "A"}, 100, clock)
    assert kept.part("a, form", 10, lambda: clock.advance(45) or 1) == 1
    assert kept.part("bundle", 20, lambda: 1 / 0) is None
    assert kept.part("b, form", 10, lambda: 3) is None  # it may take longer than the one of its kind did
    assert kept.left_out == ["bundle", "b, form"]
    again = Kept(path, {"card": "A"}, 100, clock)
    assert [again.part(name, 20, lambda: 4) for name in ("a, form", "bundle")] == [1, 4]
    with pytest.raises(InvalidInputError):
        Kept(path, {"card": "B"}, 100)


def test_every_target_has_a_verdict() -> None:
    batch = {"pages": 1, "pages_per_s": 160.0, "graph_ms_a_page": 6.0, "alone_ms": 40.0, "air": [4.8], "memory_gb": 8.3}
    parts = {
        "standard, 1 a batch": batch,
        "standard, present": {"air": [4.8, 4.7]},
        "standard, floor": {"bytes_ms": 2.5},
    }
    parts |= {
        "service": {"over_in_process": 0.96},
        "page code": {"full size 4x4": {"compiled_ms": 7.0, "user_bytes": 5e4}},
    }
    verdicts = [target.verdict for target in targets(parts, "full size 4x4")]
    assert [verdicts.count(name) for name in ("stretch met", "met", "missed", "not measured")] == [1, 5, 1, 11]
    assert len(table(parts, "full size 4x4")) == 6 + len(verdicts)


def test_an_onnxruntime_without_the_gpu_is_refused_by_name(tmp_path: Path) -> None:
    assert isinstance(CliRunner().invoke(main, ["--out", str(tmp_path / "out")]).exception, ProviderError)
    assert not (tmp_path / "out").exists()
