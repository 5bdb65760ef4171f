"""Scenes that come with the library, built from primitives in code: no file is shipped or downloaded."""

from ._office import BUNDLED as BUNDLED
from ._office import cornell_box as cornell_box
from ._office import office as office
from ._office import rgb_film as rgb_film
