"""Run notebooks and write them back with what they printed and drew: python scripts/build_notebooks.py [FILE ...]

Nothing of the clock or of this machine is kept, so that a notebook that says the same again is the same file.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

PROGRESS = re.compile(r"([a-z]+: .*, \d+ s\n?)+")
"""How far a long command was, which depends on the machine."""
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def build(path: Path) -> None:
    """Execute one notebook in its own folder and replace it; a cell that fails raises and leaves the file alone."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=None, record_timing=False, resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    notebook.metadata = nbformat.from_dict(METADATA)
    for i, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{i:02d}"
        cell.metadata.pop("execution", None)
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not _is_progress(output)]
    nbformat.validate(notebook)
    path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")


def _is_progress(output: Any) -> bool:
    return output.get("name") == "stderr" and PROGRESS.fullmatch(output["text"]) is not None


if __name__ == "__main__":
    for path in [Path(name) for name in sys.argv[1:]] or sorted(NOTEBOOKS.glob("*.ipynb")):
        print(path)
        build(path)
