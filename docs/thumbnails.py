"""Cut the thumbnails of the gallery from the documentation's pictures and from the notebooks' stored outputs.

All have one size. Nothing is rendered, except the Gaussian splats, which take a fraction of a second in torch. Run
it again when a picture or a notebook has changed.

    python docs/thumbnails.py [FOLDER]
"""

from __future__ import annotations

import base64
import io
import json
import sys
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageOps

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
SIZE = (480, 270)


class Cut(NamedTuple):
    """A rectangle of a picture: left, top, right and bottom as fractions of its width and height."""

    source: str  # a picture's file in docs/pictures, or a notebook's name and the number of its figure
    box: tuple[float, float, float, float]
    whole: bool = False  # with a white border, instead of cutting off what does not fit


CUTS = {
    "chair-logit": Cut("chair-logit.png", (0.013, 0.214, 0.892, 0.84), whole=True),
    "classroom-daylight": Cut("classroom-daylight.png", (0.068, 0.083, 0.88, 0.914)),
    "desk-lamp": Cut("desk-lamp.png", (0.01, 0.145, 0.489, 0.98)),
    "explore": Cut("explore.png", (0.0, 0.0, 1.0, 1.0)),
    "figures": Cut("guides/seeing-luminance.webp", (0.0, 0.0, 1.0, 1.0), whole=True),
    "first-attribution": Cut("guides/getting-started-map.webp", (0.015, 0.13, 0.88, 0.95)),
    "lost-view": Cut("lost-view.png", (0.006, 0.07, 0.588, 0.88), whole=True),
    "office-glare": Cut("office.png", (0.505, 0.19, 0.996, 0.965)),
    "own-metric": Cut("own-metric.png", (0.461, 0.326, 0.89, 0.911)),
    "paper": Cut("paper/grid-maps.webp", (0.5065, 0.2887, 0.7405, 0.4211)),
    "pixels-or-scene": Cut("pixels-or-scene.png", (0.0, 0.0, 1.0, 0.87), whole=True),
    "rooms-ugr": Cut("rooms-ugr.png", (0.0, 0.16, 1.0, 0.92), whole=True),
    "shortcut": Cut("shortcut-pictures.png", (0.0, 0.09, 0.56, 1.0), whole=True),
    "specificity": Cut("metric_specificity 0", (0.311, 0.687, 0.598, 0.96)),
    "speed": Cut("paper/grid-stability.webp", (0.0, 0.475, 0.53, 0.945), whole=True),
    "texels": Cut("what_a_network_sees 0", (0.462, 0.496, 0.89, 0.919)),
    "two-designs": Cut("two-designs.png", (0.503, 0.19, 0.995, 0.98)),
    "what-a-network-sees": Cut("what_a_network_sees 0", (0.016, 0.308, 0.89, 0.92), whole=True),
    "which-lamp": Cut("office.png", (0.004, 0.19, 0.495, 0.965)),
    "work-plane": Cut("work-plane.png", (0.11, 0.096, 0.819, 0.451)),
}


def thumbnail(name: str) -> Image.Image:
    """Return a thumbnail, by the name of its file."""
    if name == "gaussian-splats":
        return still_life()
    source, box, whole = CUTS[name]
    picture = figure(*source.split()) if " " in source else Image.open(DOCS / "pictures" / source)
    corners = [fraction * length for fraction, length in zip(box, picture.size * 2, strict=True)]
    white = Image.new("RGBA", picture.size, "white")
    white.alpha_composite(picture.convert("RGBA"))
    part = white.convert("RGB").crop(tuple(map(round, corners)))
    if whole:
        return ImageOps.pad(part, SIZE, Image.Resampling.LANCZOS, color="white")
    return ImageOps.fit(part, SIZE, Image.Resampling.LANCZOS)


def figure(notebook: str, number: str) -> Image.Image:
    """Return a figure of a notebook's stored outputs, counted from 0."""
    cells = json.loads((EXAMPLES / "notebooks" / f"{notebook}.ipynb").read_text())["cells"]
    data = [output.get("data", {}) for cell in cells for output in cell.get("outputs", ())]
    pictures = [one["image/png"] for one in data if "image/png" in one]
    return Image.open(io.BytesIO(base64.b64decode(pictures[int(number)])))


def still_life() -> Image.Image:
    """Return the picture of examples/gaussian_splats.py, finer than there."""
    sys.path.insert(0, str(EXAMPLES))
    from gaussian_splats import SplatRenderer

    renderer = SplatRenderer(size=SIZE[0])
    picture = renderer(renderer.inputs, seed=0, spp=None).clamp(0, 1) ** (1 / 2.2)
    whole = Image.fromarray((255 * picture).round().byte().numpy())
    return whole.crop((0, 138, SIZE[0], 138 + SIZE[1]))


def main(folder: Path) -> None:
    """Write all thumbnails into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*CUTS, "gaussian-splats"):
        thumbnail(name).save(folder / f"{name}.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "pictures" / "thumbnails")
