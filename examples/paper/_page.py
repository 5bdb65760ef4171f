"""The page: its top, made from the stored results of all claims, and the sections."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from _claims import CLAIMS
from _figures import MAPS
from _rooms import quick_rooms
from _section import HOLDS, IN_PART, Section, picture, table

INTRODUCTION = """# Reproducing the paper

After this page you know which claims of "Scene Parameter Saliency via Differentiable Light Transport" (Beresna
and Fiume) could be reproduced, and how to repeat the measurements:
`python examples/paper --write docs/paper.md`."""

MAPS_CAPTION = (
    "Effects of the materials on three metrics: blue raises the metric, orange lowers it, grey numbers are within "
    "the noise; the largest three are named below each map"
)
Results = Mapping[str, Mapping[str, Any]]


def write(page: Path, folder: Path, sections: Mapping[str, Section], setup: Mapping[str, Any]) -> None:
    """Write the page, with copies of its pictures and the results in ``pictures/paper`` beside it.

    In an existing page, only these sections are replaced. The top states results of all claims, so those of
    earlier runs are kept in ``results.json``.
    """
    pictures = page.parent / "pictures" / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    for section in sections.values():
        for name in section.pictures:
            shutil.copy(folder / name, pictures / name)
    stored = pictures / "results.json"
    results = json.loads(stored.read_text()) if stored.is_file() else {}
    results |= {
        name: {**setup, "claims": section.claims, "facts": section.facts}
        for name, section in sections.items()
    }
    results = {name: results[name] for name in CLAIMS if name in results}
    stored.write_text(json.dumps(results, indent=2, ensure_ascii=False) + "\n")
    existing = re.split(r"^(?=## )", page.read_text(), flags=re.MULTILINE)[1:] if page.is_file() else []
    texts = {text[3 : text.index("\n")]: text for text in existing}
    texts |= {section.title: section.markdown() for section in sections.values()}
    page.write_text("\n\n".join(text.rstrip() for text in (top(results), *texts.values())) + "\n")


def top(results: Results) -> str:
    """Return what precedes the sections: the conclusions, the maps, and the claims."""
    claims = [claim for result in results.values() for claim in result["claims"]]
    parts = [
        INTRODUCTION,
        " ".join(conclusions({name: result["facts"] for name, result in results.items()})),
        picture(MAPS, MAPS_CAPTION) if "specificity" in results else "",
        "\n".join(table(["claim of the paper", "measured", "verdict"], claims)),
        f"*Holds*: in at least {HOLDS:.0%} of the cases that are counted; *in part*: in at least {IN_PART:.0%}. "
        f"{setups(results)}",
    ]
    return "\n\n".join(filter(None, parts))


def conclusions(facts: Results) -> list[str]:
    """Return three sentences, those whose results are known."""
    sentences = []
    if "ablation" in facts and "stability" in facts:
        steps, ranks = facts["ablation"], facts["stability"]
        sentences.append(
            f"The claim that gradients predict what the parameters do {steps['predicted']}: {steps['agreeing']} "
            f"of {steps['above']} separate steps changed the metric as predicted, and from {ranks['spp']} samples "
            "per pixel on the order of clear effects is that of the reference (Kendall's τ of "
            f"{ranks['worst']:.2f} or more)."
        )
    if "specificity" in facts:
        maps = facts["specificity"]
        sentences.append(
            f"The claim that maps are specific to the metric {maps['specific']}: of {maps['leaders']} leading "
            f"parameters, mean luminance shares {maps['common_with_logit']} with a network's logit but "
            f"{maps['common']} with UGR, and what distinguishes these two is the sign, which the paper leaves out "
            f"({maps['opposite']} of {maps['either']} leaders raise one and lower the other)."
        )
    if "mirror" in facts:
        mirrors = facts["mirror"]
        sentences.append(
            f"Mitsuba's `prb`, which the paper uses, has no derivative of {mirrors['lost']} of "
            f"{mirrors['mirrors']} parameters of smooth mirrors, so its maps cannot show what a mirror does."
        )
    return sentences


def setups(results: Results) -> str:
    """Return the rooms and the network of the measurements."""
    rooms = list(dict.fromkeys(room for result in results.values() for room in result["rooms"]))
    networks = dict.fromkeys(result["network"] for result in results.values())
    without = "; ablation and stability, which render hundreds of images, leave out the kitchen"
    rooms_text = f"{', '.join(rooms)}{without if quick_rooms(rooms) != rooms else ''}"
    return f"Rooms: {rooms_text}. The network is {' or '.join(networks)}."
