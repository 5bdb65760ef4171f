"""Results as files: one self-contained HTML page to explore in a browser, JSON and CSV."""

# What users see; the other names are for the rooms above.
__all__ = ["Comparison", "Section", "Table", "write_csv", "write_json", "write_report", "write_section"]

from ._data import Comparison as Comparison
from ._data import Table as Table
from ._data import describe_objects as describe_objects
from ._data import different_values as different_values
from ._numbers import json_text as json_text
from ._numbers import write_csv as write_csv
from ._numbers import write_json as write_json
from ._pixels import encode_figure as encode_figure
from ._write import Section as Section
from ._write import fill_template as fill_template
from ._write import write_report as write_report
from ._write import write_section as write_section
