"""Ask many rooms what matters: all bundled rooms and all rooms of a folder, from four cameras, by three metrics.

Every cell is the gradient of a metric over all materials of a room, seen from a camera. The summary says which
kinds of materials matter in general, with intervals over rooms, and which only here; the table of costs says what
a cell takes. Run it again to resume it.

    python examples/rooms_study.py [--scenes FOLDER] [--out out/rooms] [--workers 2]
"""

from __future__ import annotations

import sys
from pathlib import Path

from _options import parser

from scenecaptum import View
from scenecaptum.scene import BUNDLED
from scenecaptum.studies import Study, StudyResult

METRICS = ["luminance", "contrast", "ugr"]
CAMERAS = {"as it is": 0, "left": View(turn=-20), "right": View(turn=20), "down": View(tilt=-15)}


def rooms(folder: Path | None) -> dict[str, str]:
    """Return the bundled rooms, and the scene files one level below a folder, by name."""
    found = {name if folder is None else f"{name} (bundled)": name for name in BUNDLED}
    files = [] if folder is None else sorted(folder.glob("*/scene.xml"))
    return found | {file.parent.name: str(file) for file in files}


def print_costs(result: StudyResult) -> None:
    """Print what a cell costs in each room: time after the first cell, time of the first one, and bytes."""
    print(f"\n{'room':24} {'cells':>5} {'seconds':>8} {'first':>6} {'kB':>6}")
    values = result.values().dropna(subset=["seconds"])
    for room, of_room in values.groupby("scene"):
        cells = [cell for cell in result.cells if cell.scene == room]
        size = sum((result.folder / "cells" / f"{result.cells[cell]}.zip").stat().st_size for cell in cells)
        print(
            f"{room:24} {len(of_room):5} {of_room.seconds.median():8.1f} {of_room.seconds.max():6.1f} "
            f"{size / len(cells) / 1e3:6.0f}"
        )
    print(f"all {len(values)} cells: {values.seconds.sum():.0f} s of computation")


def main() -> int:
    options = parser(__doc__, out="out/rooms", resolution="96x54", spp=32)
    options.add_argument("--scenes", type=Path, metavar="FOLDER", help="rooms beside the bundled ones")
    options.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    given = options.parse_args()
    study = Study(
        rooms(given.scenes),
        cameras=CAMERAS,
        metrics=METRICS,
        resolution=given.resolution,
        spp=given.spp,
        max_depth=6,
    )
    result = study.run(given.out, workers=given.workers, show_progress=sys.stderr.isatty())
    print(result, "\n")
    print(result.summary())
    print_costs(result)
    for metric in METRICS:
        result.plot_effects("reflectance", metric=metric).savefig(given.out / f"{metric}.png")
    result.plot_gallery(metric=METRICS[0]).savefig(given.out / "gallery.png")
    print(f"\n{result.write_report(given.out / 'report')}  the summary, the figures and all cells")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
