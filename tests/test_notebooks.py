"""Every notebook runs from top to bottom but for its benches, and is stored with its outputs."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from tests.extras import why
from tests.twins import gige

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


# Trainings that are long enough for a figure; a few iterations show that they run.
LONG = {"03_flow": ("Ni(iterations=80)", "Pinn(iterations=500)")}
WITH_CAMERA = "08_lab"


def kinds(notebook: Any) -> list[list[str]]:
    """For each code cell the kinds of its outputs, such as "stream" or "image/png"."""
    return [
        sorted({kind for output in cell.outputs for kind in output.get("data", {output.output_type: None})})
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def measured(notebook: Any) -> list[Any]:
    """Cells that take minutes, of benches that have tests of their own: it is enough that they are stored."""
    return [cell for cell in notebook.cells if "bench" in cell.metadata.get("tags", ())]


def test_no_notebook_is_stored_with_an_error_and_each_bench_has_drawn() -> None:
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        outputs = [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]
        assert outputs and not any(output["output_type"] == "error" for output in outputs), path
        benches = [cell for cell in cells if "bench" in cell["metadata"].get("tags", ())]
        drawn = [any("image/png" in output.get("data", {}) for output in cell["outputs"]) for cell in benches]
        assert all(drawn), path


def test_all_code_of_a_notebook_is_in_cells_which_run() -> None:
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert not [cell for cell in cells if cell["cell_type"] != "code" and "```" in "".join(cell["source"])], path


@pytest.mark.slow("runs the notebooks, which record, solve and draw in kernels of their own: minutes")
@pytest.mark.usefixtures("mission")  # has compiled most kernels, which each notebook would compile again
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_runs_from_top_to_bottom_and_shows_what_is_stored(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nbformat = pytest.importorskip("nbformat", reason=why("nbformat"))  # seconds, with jsonschema: not in each worker
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))  # not every user may write to a home
    if path.stem == WITH_CAMERA and not gige.installed:
        pytest.skip("needs aravis-tools")
    notebook = nbformat.read(path, as_version=4)
    benches = measured(notebook)
    notebook.cells = [cell for cell in notebook.cells if cell not in benches]
    stored = kinds(notebook)
    for long in LONG.get(path.stem, ()):
        (cell,) = [cell for cell in notebook.cells if long in cell.source]
        cell.source = cell.source.replace(long, re.sub(r"=\d+", "=5", long))
    with gige.port() if path.stem == WITH_CAMERA else nullcontext():
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}).execute()
    assert kinds(notebook) == stored, "run the notebook and store it with its outputs"
