"""The sections of docs/extending.md: their code as modules, and their lines of a registry."""

from __future__ import annotations

import doctest
import re
import types
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"


def section(title: str) -> str:
    (text,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return str(text)


def code(title: str) -> types.ModuleType:
    """Return a module with the imports and definitions of a section."""
    module = types.ModuleType(title)
    parser = doctest.DocTestParser()
    kept = r"(import|from|class|def|mi) |mi\."
    for example in parser.get_examples(
        "".join(re.findall(r"```python\n(.*?)```", section(title), re.DOTALL))
    ):
        if re.match(kept, example.source):
            exec(compile(example.source, str(PAGE), "exec"), vars(module))
    return module


def entry(title: str, module: types.ModuleType, **known: Any) -> dict[str, Any]:
    """Return the line of the registry, as a dict."""
    (line,) = re.findall(r'^    ("\w+": .*),$', section(title), re.MULTILINE)
    found: dict[str, Any] = eval(f"{{{line}}}", {**vars(module), **known})
    return found
