"""Reproduce the figures and claims of the paper, and report the differences.

Runs on the office and on the rooms in ``shared/scenes``, if they exist. Writes the figures into a folder, and with
``--write`` also the page that compares the paper with the measurements, or only the sections of some claims.

    python examples/paper [CLAIM ...] [--out FOLDER] [--write docs/paper.md] [--room office] [--quick] [--resnet]
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import torch
from _claims import CLAIMS, chosen
from _page import write
from _rooms import FULL, QUICK, names


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

    sections = {}
    for name in chosen(options.claims):
        began = time.perf_counter()
        sections[name] = CLAIMS[name](rooms, size, options.out)
        print(f"{sections[name].markdown()}\n\n{time.perf_counter() - began:.0f} s\n", flush=True)
    if options.write:
        network = "the paper's ResNet-50" if options.resnet else "the classifier of shapes of scenecaptum"
        write(options.write, options.out, sections, {"rooms": rooms, "network": network})


if __name__ == "__main__":
    main()
