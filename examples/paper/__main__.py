"""Reproduce the figures and claims of the paper, and say where they differ.

Runs on the office and on the rooms in ``shared/scenes``, where present. Writes the figures into a folder, and with
``--write`` the page that sets the paper beside what was measured, or the sections of some claims in it.

    python examples/paper [CLAIM ...] [--out FOLDER] [--write docs/paper.md] [--room office] [--quick] [--resnet]
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import shutil
import sys
import time
from pathlib import Path

import torch
from _claims import CLAIMS, chosen
from _rooms import FULL, QUICK, names
from _section import Section

HEAD = """# The paper, tried again

"Scene Parameter Saliency via Differentiable Light Transport" (Beresna and Fiume) asks which parameters of a scene
a metric of its picture depends on. Each section sets a claim of the paper beside what
`python examples/paper --write docs/paper.md` measured. The paper's kitchen is not among our rooms; {rooms}. The
network is {network}.
"""


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="examples/paper"
    )
    parser.add_argument("claims", nargs="*", choices=[[], *CLAIMS], metavar="CLAIM", help=", ".join(CLAIMS))
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder of the figures")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="write the page, its figures beside it")
    parser.add_argument("--room", action="append", help="only this room")
    parser.add_argument("--quick", action="store_true", help="tiny pictures, to see that it works")
    parser.add_argument(
        "--resnet", action="store_true", help="the paper's ResNet-50, whose weights are downloaded"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # Dr.Jit has threads of its own
    size = dataclasses.replace(QUICK if options.quick else FULL, resnet=options.resnet)
    rooms = [room for room in names() if not options.room or room in options.room]
    if not rooms:
        sys.exit(f"none of these rooms is there: {', '.join(options.room)}")
    options.out.mkdir(parents=True, exist_ok=True)

    sections = []
    for name in chosen(options.claims):
        began = time.perf_counter()
        sections.append(CLAIMS[name](rooms, size, options.out))
        print(
            f"{sections[-1].markdown(str(options.out))}\n\n{time.perf_counter() - began:.0f} s\n", flush=True
        )
    if options.write:
        write(options.write, options.out, sections, rooms, resnet=size.resnet)


def write(page: Path, folder: Path, sections: list[Section], rooms: list[str], *, resnet: bool) -> None:
    """Write the page, with copies of its figures in ``pictures/paper`` beside it.

    Of a page that is there already only these sections are renewed.
    """
    pictures = page.parent / "pictures" / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for name, _ in section.figures:
            shutil.copy(folder / name, pictures / name)
    network = (
        "the paper's ResNet-50" if resnet else "the small classifier of shapes that ships with scenecaptum"
    )
    head = HEAD.format(rooms=f"these are {', '.join(rooms)}", network=network)
    kept = re.split(r"^(?=## )", page.read_text(), flags=re.MULTILINE)[1:] if page.is_file() else []
    texts = {text[3 : text.index("\n")]: text for text in kept}
    texts |= {one.title: one.markdown("pictures/paper") for one in sections}
    page.write_text("\n\n".join(text.rstrip() for text in (head, *texts.values())) + "\n")


if __name__ == "__main__":
    main()
