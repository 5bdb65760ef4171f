"""The rooms of the package: each knows those below it, and of these only what is public."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "rooms.py"


def test_imports_run_downward_without_circles_and_only_to_public_modules() -> None:
    result = subprocess.run([sys.executable, SCRIPT, "check"], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout
    assert result.stdout.split("\n") == ["0 circle", "0 upward", "0 private", "0 no floor", ""]


def test_a_lazy_import_that_runs_up_is_found(tmp_path: Path) -> None:
    package = tmp_path / "src" / "scenecaptum"
    for room, content in {
        "metrics": "def late():\n    from ..attr._secret import thing\n",
        "attr": "from ..metrics import late\n",
    }.items():
        (package / room).mkdir(parents=True)
        (package / room / "__init__.py").write_text(content)
    (package / "attr" / "_secret.py").write_text("from . import x\n")
    (tmp_path / "scripts").mkdir()
    copy = tmp_path / "scripts" / "rooms.py"
    copy.write_text(SCRIPT.read_text())
    result = subprocess.run([sys.executable, copy, "check"], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert (
        "circle of 3 files: scenecaptum.attr, scenecaptum.attr._secret, scenecaptum.metrics" in result.stdout
    )
    assert "upward: scenecaptum.metrics:2 imports scenecaptum.attr._secret" in result.stdout
    assert "private: scenecaptum.metrics:2 imports scenecaptum.attr._secret" in result.stdout
