"""Every example in the README and in the docstrings runs."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest

import scenecaptum

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(scenecaptum.__path__, "scenecaptum.")
    if "__main__" not in module.name
)


def test_readme_examples_run(mi):
    readme = Path(__file__).parents[1] / "README.md"
    failed, attempted = doctest.testfile(str(readme), module_relative=False, optionflags=FLAGS)
    assert attempted > 8
    assert failed == 0


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name, mi):
    failed, _ = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert failed == 0
