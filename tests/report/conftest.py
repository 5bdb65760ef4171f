"""The browser in which reports are opened."""

from browsers import browser

__all__ = ["browser"]
