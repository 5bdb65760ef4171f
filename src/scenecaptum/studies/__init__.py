"""Studies: many scenes, cameras, metrics and designs, on one machine or a cluster.

Example
-------
>>> from scenecaptum import studies
>>> study = studies.Study(["cornell-box"], metrics=["luminance"], resolution=(16, 16), spp=8)
>>> len(study)
1
"""

# What users call; the other names are for the rooms above.
__all__ = [
    "Cell",
    "GroupEffect",
    "RoomEffect",
    "Study",
    "StudyResult",
    "Summary",
    "plot_effect_by_room",
    "plot_gallery",
    "plot_rank_stability",
]

from ._figures import plot_effect_by_room as plot_effect_by_room
from ._figures import plot_gallery as plot_gallery
from ._figures import plot_rank_stability as plot_rank_stability
from ._random_effects import RoomEffect as RoomEffect
from ._recipe import Cell as Cell
from ._result import StudyResult as StudyResult
from ._study import Study as Study
from ._summary import GroupEffect as GroupEffect
from ._summary import Summary as Summary
