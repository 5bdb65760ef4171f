"""The report: results as one self-contained HTML file to explore in a browser."""

from ._write import write_report as write_report
