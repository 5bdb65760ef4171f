"""What puts single rows of a ranking in doubt, for files and tables that other programs read."""

from __future__ import annotations

from ..protocols import Attribution, Scale
from ._effect_notes import range_marked, range_notes
from ._notes import caution_groups, jump_notes, untrusted_groups
from ._text import findings


def row_cautions(attribution: Attribution, scale: Scale | None = None) -> dict[str, str]:
    """Return for each parameter that a table marks why it does, with the mark before each reason.

    ``!`` stands for an inaccurate derivative, ``?`` for an unreliable standard error, ``~`` for an effect that may
    be read for something else, and ``–`` for directions of a pose that are left out.
    """
    names = [row.name for row in attribution.ranking(scale=scale)]
    marked = {"!": caution_groups(attribution, names), "?": untrusted_groups(attribution)}
    of_ranges = range_marked(range_notes(attribution, scale))
    found = {}
    for name in names:
        reasons = [
            f"{mark} {reason}"
            for mark, groups in marked.items()
            for reason, whose in groups.items()
            if name in whose
        ]
        if name in of_ranges:
            # Of this row alone: a note on several names the first of them.
            own = range_notes(attribution, scale, [name])
            reasons += [
                f"~ {note}" for note in findings(note for note, whose in own.items() if name in whose)
            ]
        reasons += [" ".join(note.split()) for note in jump_notes(attribution, [name])]
        if reasons:
            found[name] = "; ".join(reasons)
    return found
