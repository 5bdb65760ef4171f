"""The rooms of the package as its imports draw them: every one counts, lazy and ``TYPE_CHECKING`` ones too.

    python scripts/rooms.py check          print circles, upward arrows, private imports; exit 1 if there are any
    python scripts/rooms.py draw FILE.svg  draw the rooms and who imports whom

A room is a folder or a module of ``src/scenecaptum``. It may import the rooms below it, and of these only what is
public: ``from ..scene import X``, never ``from ..scene._x import X``. A test may use what is private to ``scene``
only if it is in ``tests/scene/``.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).parents[1] / "src" / "scenecaptum"
TESTS = Path(__file__).parents[1] / "tests"
PACKAGE = SOURCE.name

# Top to bottom; the rooms of one floor do not know each other.
FLOORS = (
    ("cli",),
    ("explore",),
    ("studies",),
    ("report",),
    ("explanation",),
    ("validation", "tradeoff", "optimize", "linearization"),
    ("attr",),
    ("estimation",),
    ("rendering",),
    ("scene",),
    ("daylight",),
    ("metrics",),
    ("visualization",),
    ("projection", "denoising"),
    ("executors",),
    ("camera", "checkpoint", "designs", "grid"),
    ("backend", "files", "finite", "images", "ranks", "student", "training_mode"),
    ("protocols",),
    ("errors",),
)


class Import(NamedTuple):
    """One import: the module that has it, what it imports, and the line."""

    importer: str
    imported: str
    line: int

    @property
    def rooms(self) -> tuple[str, str]:
        """The rooms of both."""
        return room_of(self.importer), room_of(self.imported)


def room_of(module: str) -> str:
    """Return the room of a module: ``scenecaptum.scene._graph`` is in ``scene``."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else PACKAGE


def modules() -> dict[str, Path]:
    """Return the file of every module of the package."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(files: Mapping[str, Path]) -> Iterator[Import]:
    """Yield the imports among the modules, wherever in a file they are."""
    for name, path in files.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for node in ast.walk(ast.parse(path.read_text())):
            for target in targets(node, package).values():
                module = target if target in files else target.rpartition(".")[0]
                if module in files and module != name:
                    yield Import(name, module, node.lineno)


def targets(node: ast.AST, package: str = "") -> dict[str, str]:
    """Return the full name of whatever an import statement of a package binds; nothing for other nodes."""
    if isinstance(node, ast.Import):
        return {alias.asname or alias.name: alias.name for alias in node.names}
    if isinstance(node, ast.ImportFrom):
        base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        origin = ".".join([*base, *([node.module] if node.module else [])])
        return {alias.asname or alias.name: f"{origin}.{alias.name}" for alias in node.names}
    return {}


def circles(arrows: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in arrows.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = []
            while not component or component[-1] != node:
                component.append(stack.pop())
            if len(component) > 1:
                found.append(sorted(component))

    for node in arrows:
        if node not in index:
            visit(node)
    return found


def has_private_part(name: str) -> bool:
    """Whether a dotted name leads through anything private: ``scenecaptum.__version__`` does not."""
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def is_private(one: Import) -> bool:
    """Whether a module is imported that another room keeps to itself."""
    importer, imported = one.rooms
    return importer != imported and has_private_part(one.imported)


def private_in_tests() -> Iterator[str]:
    """Yield a line for every use in a test of what is private to a room that is not the test's own."""
    for path in sorted(TESTS.rglob("*.py")):
        first = path.relative_to(TESTS).parts[0]
        own = first.removeprefix("test_").removesuffix(".py")  # tests/scene/… or tests/test_camera.py
        for name, line in sorted(used(ast.parse(path.read_text())), key=lambda use: use[1]):
            if has_private_part(name) and room_of(name) != own:
                where = path.relative_to(TESTS.parent).as_posix()
                yield f"test: {where}:{line} uses {name}, which is for tests/{room_of(name)}/ only"


def used(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield every name of the package that code imports, and private ones that it reads from these, with the line.

    Code and dotted names in strings count: tests run the one in processes of their own and replace the other.
    """
    found = {name: full for node in ast.walk(tree) for name, full in targets(node).items()}
    for node in ast.walk(tree):
        names = list(targets(node).values())
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.attr.startswith("_"):
            names = [f"{found.get(node.value.id)}.{node.attr}"]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and PACKAGE in node.value:
            if re.fullmatch(rf"{PACKAGE}[\w.]+", node.value):
                names = [node.value]
            else:
                names = [name for name, _ in used(parsed(node.value))]
        yield from ((name, node.lineno) for name in names if name.split(".")[0] == PACKAGE)


def parsed(text: str) -> ast.AST:
    """Return a string as code: empty if it is none."""
    try:
        return ast.parse(textwrap.dedent(text))
    except SyntaxError:
        return ast.Module([], [])


def faults(found: list[Import]) -> list[str]:
    """Return a line for every circle of files, arrow between rooms that runs up, and private import."""
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    between: dict[str, set[str]] = defaultdict(set)
    for one in found:
        between[one.importer].add(one.imported)
    lines = [f"circle of {len(circle)} files: {', '.join(circle)}" for circle in circles(between)]
    for one in found:
        importer, imported = one.rooms
        if PACKAGE in (importer, imported) or importer == imported:
            continue
        where = f"{one.importer}:{one.line} imports {one.imported}"
        unknown = {importer, imported} - floor.keys()
        if unknown:
            lines.append(f"no floor for {', '.join(sorted(unknown))}: {where}")
        elif floor[importer] >= floor[imported]:
            lines.append(f"upward: {where}")
        if is_private(one):
            lines.append(f"private: {where}")
    return lines


def draw(found: list[Import], path: Path) -> None:
    """Draw who imports whom, a row for each room from the top floor down: no dot may be below the diagonal."""
    from matplotlib.figure import Figure

    rooms = [room for floor in FLOORS for room in floor]
    lines: dict[str, int] = defaultdict(int)
    for name, file in modules().items():
        lines[room_of(name)] += len(file.read_text().splitlines())
    places = {room: number for number, room in enumerate(rooms)}
    arrows = {one.rooms for one in found if len({*one.rooms}) == 2 and {*one.rooms} <= places.keys()}
    figure = Figure(figsize=(7, 6), layout="constrained")
    ax = figure.add_subplot()
    for start, end in arrows:
        ax.plot(places[end], places[start], "o", color="#0072B2", markersize=7)
    ax.plot([-0.5, len(rooms) - 0.5], [-0.5, len(rooms) - 0.5], color="#8C8C8C", linewidth=0.8)
    ax.set_xticks(range(len(rooms)), rooms, rotation=60, ha="left", rotation_mode="anchor", fontsize=8)
    ax.set_yticks(range(len(rooms)), [f"{room}  {lines[room]:>5} lines" for room in rooms], fontsize=8)
    ax.xaxis.tick_top()
    ax.set_ylim(len(rooms) - 0.5, -0.5)
    ax.set_xlim(-0.5, len(rooms) - 0.5)
    ax.grid(color="#8C8C8C", alpha=0.25, linewidth=0.6)
    ax.tick_params(length=0)
    ax.set_axisbelow(True)
    ax.set_title("A dot: the room of the row imports the room of the column", fontsize=9)
    figure.savefig(path, dpi=130)


def main() -> int:
    """Check or draw, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("check", "draw"))
    parser.add_argument("file", type=Path, nargs="?", help="of the drawing, .png or .svg")
    args = parser.parse_args()
    found = list(imports(modules()))
    if args.action == "draw":
        if args.file is None:
            parser.error("draw needs a FILE")
        draw(found, args.file)
        return 0
    lines = [*faults(found), *private_in_tests()]
    for line in lines:
        print(line)
    for kind in ("circle", "upward", "private", "no floor", "test"):
        print(f"{sum(line.startswith(kind) for line in lines)} {kind}")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
