"""How Sphinx builds the documentation: `make docs`."""

from __future__ import annotations

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
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"scenecaptum {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sphinx = False


def _keep_colons(_app: Any, what: str, _name: str, _what: Any, _options: Any, lines: list[str]) -> None:
    """Keep napoleon from taking a property's words before a colon for its type."""
    if what == "property":
        lines.insert(0, "")


def setup(app: Any) -> None:
    """Register what differs from Sphinx's own ways."""
    app.connect("autodoc-process-docstring", _keep_colons, priority=100)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
