"""Run the notebooks of this folder, and store their outputs.

Outputs are stored without times, versions and names of kernels, which differ between runs or machines.

    python examples/notebooks/run.py [NOTEBOOK ...]
"""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent
_STYLE = FOLDER.parents[1] / "docs" / "matplotlibrc"  # that of the documentation's figures
_IGNORED_WARNING = (
    "ignore:IProgress not found"  # by tqdm, on importing Captum; no notebook has a progress bar
)


def run(path: Path, **parameters: Any) -> nbformat.NotebookNode:
    """Return a notebook with fresh outputs.

    Parameters
    ----------
    path
        The notebook.
    parameters
        Values that replace those assigned in the notebook's cell tagged ``parameters``, by name.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell raises; the message shows the cell and its traceback.
    ValueError
        If that cell does not assign a parameter, or not on a separate line.
    """
    notebook = nbformat.read(path, as_version=4)
    (cell,) = (item for item in notebook.cells if "parameters" in item.metadata.get("tags", ()))
    for name, value in parameters.items():
        cell.source, count = re.subn(rf"^{name} = [^#\n]*", f"{name} = {value!r}  ", cell.source, flags=re.M)
        if count != 1:
            raise ValueError(f"{path.name} assigns its parameter {name} {count} times instead of once")
    NotebookClient(
        notebook,
        resources={"metadata": {"path": str(path.parent)}},  # where a user's kernel starts
        record_timing=False,
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],
    ).execute(env=os.environ | {"PYTHONWARNINGS": _IGNORED_WARNING, "MATPLOTLIBRC": str(_STYLE)})
    # The kernel added its Python version.
    notebook.metadata.language_info = {"name": "python"}
    return notebook


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("notebooks", type=Path, nargs="*", metavar="NOTEBOOK", help="default: all of them")
    for path in parser.parse_args().notebooks or sorted(FOLDER.glob("*.ipynb")):
        nbformat.write(run(path), path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
