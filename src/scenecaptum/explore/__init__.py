"""Explore a scene: drag a parameter, see the picture and the metric move, and a render confirm it."""

# What users see; the other names are for tests.
__all__ = ["Exploration", "section", "serve", "widget"]

from ._files import section as section
from ._server import Server as Server
from ._server import serve as serve
from ._session import Exploration as Exploration
from ._widget import widget as widget
