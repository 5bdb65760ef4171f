"""Scenes that come with the library, built from primitives in code: no file is shipped or downloaded.

All are ordinary Mitsuba dictionaries. The z axis points up. Every material has a readable name, which is the
prefix of its parameters' names (``chair.reflectance.value``), and every area light is named after its shape
(``sky.emitter.radiance.value``).
"""

from __future__ import annotations

# What users see; the other names are for the room.
__all__ = ["BUNDLED", "classroom", "cornell_box", "office"]

from collections.abc import Callable, Mapping
from types import MappingProxyType

from ._classroom import classroom as classroom
from ._cornell_box import cornell_box as cornell_box
from ._office import office as office
from ._parts import Plugin as Plugin
from ._parts import rgb_film as rgb_film

BUNDLED: Mapping[str, Callable[[], Plugin]] = MappingProxyType(
    {"classroom": classroom, "cornell-box": cornell_box, "office": office}
)
