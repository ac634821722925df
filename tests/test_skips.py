import tomllib
from pathlib import Path

import pytest

from tests.skips import NO_FILTERS, REQUIRE_ALL

ROOT = Path(__file__).resolve().parents[1]
TESTS = f"""
import pytest

def test_passes():
    pass

def test_lacks_something():
    pytest.skip("no oscilloscope")

@pytest.mark.skipif(True, reason="no laser")
def test_lacks_something_before_it_begins():
    pass

def test_is_on_another_kernel():
    pytest.skip({NO_FILTERS!r})

@pytest.mark.xfail
def test_is_known_to_fail():
    assert False
"""
FILE = 'import pytest\n\npytest.importorskip("no_such_package")'


@pytest.mark.parametrize(
    ("required", "outcomes"),
    [("1", {"passed": 1, "failed": 1, "errors": 2, "skipped": 1}), ("0", {"passed": 1, "skipped": 4})],
)
def test_a_skip_fails_with_its_reason_where_everything_is_required(
    required: str, outcomes: dict[str, int], pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv(REQUIRE_ALL, required)
    addopts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]["ini_options"]["addopts"]
    pytester.makeini(f"[pytest]\naddopts = {addopts} -p tests.skips")
    pytester.makepyfile(test_tests=TESTS, test_file=FILE)
    found = pytester.runpytest_subprocess("--continue-on-collection-errors", "-n", "1")
    found.assert_outcomes(xfailed=1, **outcomes)
    for reason in ("no oscilloscope", "no laser", "could not import 'no_such_package'*"):
        found.stdout.fnmatch_lines_random([f"*{f'{REQUIRE_ALL}=1 allows no skip: ' * int(required)}{reason}"])


def test_continuous_integration_requires_everything() -> None:
    assert f"export {REQUIRE_ALL}=1\n" in (ROOT / ".ci" / "run").read_text("utf-8")
