"""The packages of the library: each imports only those below it and only what they export, and so do the tests."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "rooms.py"


def check(script: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, script, "check"], capture_output=True, text=True, check=False)


def test_imports_run_downward_without_circles_and_only_to_public_modules() -> None:
    result = check(SCRIPT)
    assert result.returncode == 0, result.stdout
    assert result.stdout.split("\n") == ["0 circle", "0 upward", "0 private", "0 no floor", "0 test", ""]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the script beside two packages that import each other."""
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
    return copy


def test_a_lazy_import_that_runs_up_is_found(copy: Path) -> None:
    result = check(copy)
    assert result.returncode == 1
    assert (
        "circle of 3 files: scenecaptum.attr, scenecaptum.attr._secret, scenecaptum.metrics" in result.stdout
    )
    assert "upward: scenecaptum.metrics:2 imports scenecaptum.attr._secret" in result.stdout
    assert "private: scenecaptum.metrics:2 imports scenecaptum.attr._secret" in result.stdout


PACKAGE = "scenecaptum"  # apart from the code below, which the check would read in this file too

# Code, the private name that it uses, and the line.
USES = {
    "an import": (f"from {PACKAGE}.attr._secret import thing", "attr._secret.thing", 1),
    "an import of the module": (f"from {PACKAGE}.attr import _secret", "attr._secret", 1),
    "an import inside a function": (f"def f():\n    import {PACKAGE}.attr._secret", "attr._secret", 2),
    "an attribute": (f"from {PACKAGE} import attr as a\na._secret", "attr._secret", 2),
    "code in a string": (f"CODE = '''\n    import {PACKAGE}.attr._secret as s\n'''", "attr._secret", 1),
    "a name in a string": (f"patch('{PACKAGE}.attr._secret.thing')", "attr._secret.thing", 1),
    "a private name of a public module": (f"from {PACKAGE}.attr import _thing", "attr._thing", 1),
}


@pytest.mark.parametrize("use", USES)
def test_only_tests_of_a_package_use_what_is_private_to_it(copy: Path, tmp_path: Path, use: str) -> None:
    code, name, line = USES[use]
    allowed = ("attr/test_secret.py", "attr/deeper/test_secret.py", "test_attr.py")
    refused = ("extremes/test_other.py", "helper.py", "metrics/test_other.py")
    for file in allowed + refused:
        path = tmp_path / "tests" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(code)
    found = [one for one in check(copy).stdout.splitlines() if one.startswith("test")]
    assert found == [
        f"test: tests/{file}:{line} uses {PACKAGE}.{name}, which is for tests/attr/ only" for file in refused
    ]


@pytest.mark.parametrize(
    "code",
    [
        f"from {PACKAGE}.metrics import late",
        f"import {PACKAGE}\n{PACKAGE}.__version__",
        f"from {PACKAGE} import attr\nattr.late._x",
        "from other import _secret",
        f"TEXT = 'not {PACKAGE} code: attr._secret'",
    ],
)
def test_public_names_are_for_all_tests(copy: Path, tmp_path: Path, code: str) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_any.py").write_text(code)
    assert "0 test" in check(copy).stdout
