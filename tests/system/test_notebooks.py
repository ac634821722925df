"""Notebooks of the docs: each runs from end to end on a small device, and is kept with what the whole run showed."""

from pathlib import Path
from typing import Any

import pytest

from lightpage.codec.code import Code
from lightpage.runtime.model.bundle.bundle import Bundle, write_bundle
from tests.system.notebooks import FOLDER, NAMES, executed, notebook

MOST_BYTES = 300_000
SMALLER = {
    "calibrate-and-train": """
os.environ["PAGES"] = "6"
os.environ["TRAINING"] = (
    "--steps 10 --channels 8 --blocks 1 --synthetic-pages 0 --test-share 0.25"
)""",
    "decode-a-recording": 'os.environ.update(PROFILE="{profile}", BUNDLE="{bundle}", PAGES="2")',
    "store-a-photograph": """
os.environ.update(PROFILE="{profile}", BUNDLE="{bundle}", DEVICE="", DRIFT="--set geometry.pipe_angle_deg=-0.2")
SIDE_PX, PAGES = 16, 4""",
}
"""What stands in place of the cell of parameters."""
CODE = Code(levels=8, coded_bits=2, rate_per_mille=500, corrections=2)
"""Code of the small device's bundle."""
LONG = "export"
"""Tag of cells that are left out: half a minute of CPU, for what others test."""


def shown(book: Any) -> list[set[str]]:
    """Kinds of output of each cell of code that a test runs, but progress, which a slow machine alone tells."""
    cells = [cell for cell in book.cells if cell.cell_type == "code" and LONG not in cell.metadata.get("tags", [])]
    kinds = [{kind for output in cell.outputs for kind in output.get("data", {output.get("name")})} for cell in cells]
    return [each - {"stderr"} for each in kinds]


def test_they_are_kept_as_a_run_from_end_to_end_left_them() -> None:
    assert sorted(SMALLER) == NAMES
    for name in NAMES:
        cells = [cell for cell in notebook(name).cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
        assert (FOLDER / f"{name}.ipynb").stat().st_size <= MOST_BYTES


# Half a minute for healing, which `test_healing.py` tests by the same commands.
_LONG = pytest.param("store-a-photograph", marks=pytest.mark.long)


@pytest.mark.parametrize("name", ["calibrate-and-train", "decode-a-recording", _LONG])
def test_it_runs_on_a_small_device_and_shows_what_is_kept(
    name: str, small_device: list[str], small_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    bundle = Bundle.open(small_bundle)
    coded = bundle.manifest.model_copy(update={"code": CODE.to_toml()})
    path = write_bundle(tmp_path / "coded.zip", coded, bundle.files)
    parameters = SMALLER[name].format(profile=small_device[1], bundle=path)
    book = executed(name, f"import os\n{parameters}", without=LONG)
    assert "image/jpeg" in set().union(*shown(book))
    assert shown(book) == shown(notebook(name))
