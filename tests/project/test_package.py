"""The wheel and the source distribution, installed and used outside the repository."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_wheel_and_source_distribution_run_outside_the_repository(tmp_path: Path) -> None:
    """As `make package`: each is installed into an environment of its own, with all that it depends on."""
    download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", tmp_path, "build"]
    index = subprocess.run(download, capture_output=True, text=True, check=False)
    if index.returncode:
        pytest.skip(f"pip cannot download from its index: {index.stderr.strip().splitlines()[-1]}")
    # The tests' own paths and settings are not to reach what is installed.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run(
        [ROOT / "scripts" / "check-package"], env={**environment, "PYTHON": sys.executable}, check=True
    )
