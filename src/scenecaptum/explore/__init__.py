"""Explore a scene: drag a parameter, see the picture and the metric move, and confirm it by a render."""

# What users see.
__all__ = ["Exploration", "Recipe"]

from ._session import Exploration as Exploration
from ._session import Recipe as Recipe
