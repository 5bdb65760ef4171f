"""How Sphinx builds the documentation: `make docs`."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from sphinx.domains.python import PyObject

from scenecaptum import __version__

project = "scenecaptum"
copyright = "The scenecaptum developers"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "performance.md"]  # the latter is part of another page
templates_path = ["_templates"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
napoleon_google_docstring = False
# Properties say what they are themselves: a class that describes them as attributes would do so twice.
napoleon_use_ivar = True
napoleon_attr_annotations = False
default_role = "py:obj"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"scenecaptum {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sphinx = False
html_use_index = False


def _mend_docstring(_app: Any, what: str, _name: str, _thing: Any, _options: Any, lines: list[str]) -> None:
    """Keep napoleon from taking words for types: a property's before a colon, and the first of two attributes."""
    if what == "property":
        lines.insert(0, "")
    if "Attributes" in lines:
        for number in range(lines.index("Attributes"), len(lines)):
            if re.fullmatch(r"\w+(, \w+)+", lines[number]):
                lines[number] = lines[number].replace(", ", ",\u200b")


def _hide_constructor(
    _app: Any, what: str, _name: str, thing: Any, _options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Hide how results are made, which is not for users to do: their attributes are described."""
    is_result = what == "class" and (dataclasses.is_dataclass(thing) or issubclass(thing, tuple))
    return ("" if is_result else signature), returns


def _skip_numbered_field(
    _app: Any, _what: str, _name: str, thing: Any, _skip: bool, _options: Any
) -> bool | None:
    """Skip the fields of a named tuple, of which Python says only their number: the class describes them."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


def setup(app: Any) -> None:
    """Register what differs from Sphinx's own ways."""
    app.connect("autodoc-process-docstring", _mend_docstring, priority=100)
    app.connect("autodoc-process-signature", _hide_constructor)
    app.connect("autodoc-skip-member", _skip_numbered_field)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
