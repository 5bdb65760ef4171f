"""The report: results as one HTML file to explore in a browser, with no network and nothing to install."""

from ._write import write_report as write_report
