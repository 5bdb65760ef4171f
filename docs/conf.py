"""Sphinx configuration for `make docs`."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

from sphinx.domains.python import PyObject

from scenecaptum import __version__

sys.path.insert(0, str(Path(__file__).parent))
from example_pages import linked_to_pages, write_pages

project = "scenecaptum"
copyright = "The scenecaptum developers"
release = __version__

extensions = [
    "myst_nb",  # Markdown and notebooks
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "jupyter_execute"]  # what Sphinx and MyST-NB write
nb_execution_mode = "off"  # the outputs that the notebooks store are shown; the tests run them
templates_path = ["_templates"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
napoleon_google_docstring = False
# Properties have docstrings of their own: attributes in the class would document them twice.
napoleon_use_ivar = True
napoleon_attr_annotations = False
default_role = "py:obj"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"scenecaptum {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_js_files = [(name, {"loading_method": "defer"}) for name in ("live.js", "enlarge.js")]
html_copy_source = False
html_show_sphinx = False
html_use_index = False

# The buttons copy the input of an example, without its prompts and without what it prints.
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True


def _fix_docstring(_app: Any, what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Prevent napoleon from parsing words as types: before a colon in a property, and in a list of attributes."""
    if what == "property":
        lines.insert(0, "")
    if "Attributes" in lines:
        for number in range(lines.index("Attributes"), len(lines)):
            if re.fullmatch(r"\w+(, \w+)+", lines[number]):
                lines[number] = lines[number].replace(", ", ",\u200b")


def _hide_constructor(
    _app: Any, what: str, _name: str, obj: Any, _options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Hide the constructors of result classes, which users do not call."""
    is_result = what == "class" and (dataclasses.is_dataclass(obj) or issubclass(obj, tuple))
    return ("" if is_result else signature), returns


def _skip_numbered_field(
    _app: Any, _what: str, _name: str, obj: Any, _skip: bool, _options: Any
) -> bool | None:
    """Skip the fields of a named tuple with Python's default docstring: the class documents them."""
    return True if (getattr(obj, "__doc__", None) or "").startswith("Alias for field number") else None


def _link_to_pages(_app: Any, _name: str, source: list[str]) -> None:
    """Let links to notebooks and scripts lead to their pages."""
    source[0] = linked_to_pages(source[0])


def setup(app: Any) -> None:
    """Write the pages of the examples, and connect the hooks to Sphinx's events."""
    write_pages()
    app.connect("source-read", _link_to_pages)
    app.connect("autodoc-process-docstring", _fix_docstring, priority=100)
    app.connect("autodoc-process-signature", _hide_constructor)
    app.connect("autodoc-skip-member", _skip_numbered_field)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
