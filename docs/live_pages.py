"""Write the live pages of the documentation: the report of report.md, and the sliders of explore.md.

Both are of the bundled office, and in docs/_static/live. Write them again when the report, the page of explore, or
what they show has changed; a test says when that is so. It takes a few minutes.

    python docs/live_pages.py [FOLDER]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from scenecaptum import cli

LIVE = Path(__file__).parent / "_static" / "live"
METRICS = "--metric ugr --metric luminance"
REPORT = f"attribute office {METRICS} --inputs reflectance --inputs emitters --resolution 256x144 --spp 256"
# Few sliders, because the file has an image for each of them.
SLIDERS = f"explore office {METRICS} --resolution 256x144 --top 5"


def write_report(path: Path, command: str = REPORT) -> None:
    """Write the report of the office's glare and brightness, and none of the other files of the command."""
    with tempfile.TemporaryDirectory() as folder:
        cli.main([*command.split(), "--report", "--out", folder])
        path.write_bytes((Path(folder) / "report.html").read_bytes())


def write_sliders(path: Path, command: str = SLIDERS) -> None:
    """Write the sliders that predict the office's glare and brightness."""
    cli.main([*command.split(), "--to", str(path)])


def main(folder: Path) -> None:
    """Write both pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_report(folder / "office-report.html")
    write_sliders(folder / "office-sliders.html")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else LIVE)
