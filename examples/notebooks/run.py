"""Run the notebooks of this folder, and keep what they show.

Outputs are stored without what differs from run to run or from machine to machine: times, versions, and the names
of kernels.

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
_UNASKED = "ignore:IProgress not found"  # tqdm's, on importing Captum: no notebook here shows a progress bar


def run(path: Path, **parameters: Any) -> nbformat.NotebookNode:
    """Return a notebook with fresh outputs.

    Parameters
    ----------
    path
        The notebook.
    parameters
        Values in place of those that the notebook's cell tagged ``parameters`` assigns, by name.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        Where a cell raises; the message shows the cell and its traceback.
    ValueError
        Where that cell does not assign a parameter, or not on a line of its own.
    """
    notebook = nbformat.read(path, as_version=4)
    (cell,) = (one for one in notebook.cells if "parameters" in one.metadata.get("tags", ()))
    for name, value in parameters.items():
        cell.source, count = re.subn(rf"^{name} = [^#\n]*", f"{name} = {value!r}  ", cell.source, flags=re.M)
        if count != 1:
            raise ValueError(f"{path.name} assigns its parameter {name} {count} times instead of once")
    NotebookClient(
        notebook,
        resources={"metadata": {"path": str(path.parent)}},  # where a reader's kernel would start, too
        record_timing=False,
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],
    ).execute(env=os.environ | {"PYTHONWARNINGS": _UNASKED})
    # The kernel has added which Python it is.
    notebook.metadata.language_info = {"name": "python"}
    return notebook


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("notebooks", type=Path, nargs="*", metavar="NOTEBOOK", help="all of them by default")
    for path in asked.parse_args().notebooks or sorted(FOLDER.glob("*.ipynb")):
        nbformat.write(run(path), path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
