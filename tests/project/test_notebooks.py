"""The notebooks in examples/notebooks/ run at a reduced size, and their stored outputs are complete and clean."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from loading import load_script
from PIL import Image

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 1_500_000  # bytes of all notebooks, which every clone contains

# Paths of a user's or build machine, and what identifies a process.
PRIVATE = re.compile(r"(?<![\w.:/])/\w+/\w|\b[A-Z]:\\|\bat 0x[0-9a-f]+|ipykernel")

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def runner() -> ModuleType:
    return load_script(FOLDER / "run.py")


def outputs(notebook: Any) -> list[Any]:
    return [one for cell in notebook["cells"] for one in cell.get("outputs", ())]


def written(output: Any) -> str:
    """Return the text of an output."""
    data = {kind: text for kind, text in output.get("data", {}).items() if not kind.startswith("image/")}
    return "\n".join("".join(text) for text in (output.get("text", ""), *data.values()))


@every_notebook
def test_every_cell_runs(path: Path) -> None:
    steps = {"STEPS": 1} if "STEPS = " in path.read_text() else {}
    notebook = runner().run(path, RESOLUTION=(24, 16), SPP=8, **steps)
    unclean = [one for one in outputs(notebook) if one.get("name") == "stderr"]
    assert not unclean, "a warning would be stored with the notebook"
    before = json.loads(path.read_text())
    assert [kinds(cell) for cell in notebook["cells"]] == [kinds(cell) for cell in before["cells"]]


def kinds(cell: Any) -> list[str]:
    """Return the kinds of a cell's outputs: text, table or image."""
    return sorted(kind for one in cell.get("outputs", ()) for kind in one.get("data", [one.get("name")]))


@every_notebook
def test_stored_outputs_are_complete_and_clean(path: Path) -> None:
    notebook = json.loads(path.read_text())
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    counts = [cell["execution_count"] for cell in code]
    assert counts == list(range(1, len(code) + 1)), "run it: make notebooks"
    shown = outputs(notebook)
    assert {one["output_type"] for one in shown} <= {"stream", "display_data", "execute_result"}
    assert not [one for one in shown if one.get("name") == "stderr"]
    assert not [one for one in shown if PRIVATE.search(written(one))]
    assert notebook["metadata"]["language_info"] == {"name": "python"}
    assert all(cell["metadata"].keys() <= {"tags"} for cell in notebook["cells"])
    pictures = [one["data"]["image/png"] for one in shown if "image/png" in one.get("data", {})]
    assert len(pictures) >= 2
    for picture in pictures:
        assert min(Image.open(io.BytesIO(base64.b64decode(picture))).size) >= 200


@every_notebook
def test_links_of_notebooks_exist(path: Path) -> None:
    notebook = json.loads(path.read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "markdown"]
    prose = "\n".join("".join(cell["source"]) for cell in cells)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", prose) if not link.startswith("http")]
    assert links
    assert not [link for link in links if not (FOLDER / link).exists()]
    scripts = re.findall(r"examples/[\w/]+\.py", prose)
    assert not [script for script in scripts if not (FOLDER.parents[1] / script).is_file()]


def test_notebooks_are_small() -> None:
    assert 0 < sum(path.stat().st_size for path in NOTEBOOKS) < LARGEST


@pytest.mark.parametrize("text", ["in /home/ann/rooms", "C:\\Users", "<Figure at 0x7f2a>", "ipykernel_42"])
def test_traces_of_a_machine_are_detected(text: str) -> None:
    assert PRIVATE.search(text)


def test_a_parameter_that_a_notebook_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="SAMPLES"):
        runner().run(NOTEBOOKS[0], SAMPLES=1)
