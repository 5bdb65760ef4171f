"""Checkpoints: a folder that caches finished renders and backward passes, to resume interrupted jobs.

The result of a render or backward pass depends only on its arguments. A job is resumed by running it again with
the same arguments: calls whose results are in the folder are read from there, whatever the attribution method.
"""

# Users give a folder; these names are for the rooms above.
__all__: list[str] = []

from ._digest import digest as digest
from ._renderer import CheckpointedRenderer as CheckpointedRenderer
from ._renderer import with_checkpoint as with_checkpoint
from ._renderer import without_checkpoint as without_checkpoint
from ._stopwatch import Stopwatch as Stopwatch
from ._store import Checkpoint as Checkpoint
from ._store import Folder as Folder
