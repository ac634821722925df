"""Runs the notebooks of the docs: `python -m tests.system.notebooks [NAME ...]` keeps what they show in them."""

import os
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def notebook(name: str) -> Any:
    """Return a notebook as it is kept."""
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def executed(name: str, parameters: str | None = None, without: str = "") -> Any:
    """Return a notebook as a run from end to end leaves it.

    Args:
        name: name of the notebook.
        parameters: source that stands in for the cell with this tag.
        without: tag of cells that are passed over.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    book = notebook(name)
    if parameters is not None:
        (cell,) = (cell for cell in book.cells if "parameters" in cell.metadata.get("tags", []))
        cell.source = parameters
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    client = NotebookClient(
        book,
        timeout=None,
        coalesce_streams=True,
        record_timing=False,
        skip_cells_with_tag=without,
        resources={"metadata": {"path": FOLDER}},
    )
    client.execute(env=os.environ | {"PATH": path})
    return book


if __name__ == "__main__":
    for each in sys.argv[1:] or NAMES:
        nbformat.write(executed(each), FOLDER / f"{each}.ipynb")
