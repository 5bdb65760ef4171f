"""Reproduce the figures and claims of the paper, and report the differences.

Runs on the office and on the rooms in ``shared/scenes``, if they exist. Writes the figures into a folder, and with
``--write`` also the page that compares the paper with the measurements, or only the sections of some claims.

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

HEAD = """# Reproducing the paper

After this page you know which claims of "Scene Parameter Saliency via Differentiable Light Transport" (Beresna and
Fiume) could be reproduced. The paper asks which parameters of a scene a metric of its image depends on. Each
section compares a claim of the paper with the measurements of `python examples/paper --write docs/paper.md`. The
paper's kitchen is not available here; the rooms are {rooms}.
The network is {network}.
"""


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, prog="examples/paper"
    )
    parser.add_argument("claims", nargs="*", choices=[[], *CLAIMS], metavar="CLAIM", help=", ".join(CLAIMS))
    parser.add_argument("--out", type=Path, default=Path("out/paper"), help="folder for the figures")
    parser.add_argument(
        "--write", type=Path, metavar="PAGE", help="write the page, and its figures beside it"
    )
    parser.add_argument("--room", action="append", help="only this room")
    parser.add_argument("--quick", action="store_true", help="tiny images, as a smoke test")
    parser.add_argument("--resnet", action="store_true", help="the paper's ResNet-50 (downloads its weights)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # Dr.Jit has its own threads
    size = dataclasses.replace(QUICK if options.quick else FULL, resnet=options.resnet)
    rooms = [room for room in names() if not options.room or room in options.room]
    if not rooms:
        sys.exit(f"none of these rooms is available: {', '.join(options.room)}")
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

    In an existing page, only these sections are replaced.
    """
    pictures = page.parent / "pictures" / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    for section in sections:
        for name, _ in section.figures:
            shutil.copy(folder / name, pictures / name)
    network = (
        "the paper's ResNet-50" if resnet else "the small classifier of shapes that ships with scenecaptum"
    )
    head = HEAD.format(rooms=", ".join(rooms), network=network)
    existing = re.split(r"^(?=## )", page.read_text(), flags=re.MULTILINE)[1:] if page.is_file() else []
    texts = {text[3 : text.index("\n")]: text for text in existing}
    texts |= {section.title: section.markdown("pictures/paper") for section in sections}
    page.write_text("\n\n".join(text.rstrip() for text in (head, *texts.values())) + "\n")


if __name__ == "__main__":
    main()
