"""``scenecaptum study``: many scenes, cameras, metrics and designs."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from ..errors import SceneCaptumError
from ..studies import Study, StudyResult
from ._attribute import EXPLAIN
from ._files import OutputFormat, print_files, write_files

FORMATS = [
    OutputFormat[StudyResult](
        "values.csv", "the metric of each cell", lambda r, p: r.write_table(p, of="values")
    ),
    OutputFormat[StudyResult](
        "effects.csv", "the effect of each parameter in each cell", StudyResult.write_table
    ),
]
NUMBERS = ("measure", "unit", "value", "standard_error", "verdict", "seconds")
SAID: dict[str, Any] = {"notes": [], "cautions": [], "convergence": ""}  # none in cells of an older version
PATIENCE = "10s"  # for a Dask scheduler


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "study",
        help="many scenes, cameras, metrics and designs, on all cores or on a cluster",
        description="Compute the cells of a study, which a TOML or JSON file describes. Finished cells are kept: "
        "run the same command again to resume a study that was killed, or to add those that failed.",
        epilog="example: scenecaptum study rooms.toml --out rooms --workers 2",
    )
    parser.add_argument(
        "file",
        type=Path,
        help="TOML or JSON file with scenes, cameras, metrics, designs, methods and seeds, and with inputs, "
        "resolution, spp and max_depth of all cells",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the cells (default: the name of the file)"
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes on this machine (default: one for each core)"
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="threads of each worker; with 1, numbers are the same to the last bit on any number of workers "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="compute on the workers of this Dask scheduler, such as tcp://host:8786",
    )
    parser.add_argument(
        "--report",
        action="store_true",
        help="also write report/index.html: the summary over the rooms, figures, and a page for each cell with a "
        "picture",
    )
    parser.add_argument("--retry-failed", action="store_true", help="compute failed cells again")
    parser.add_argument(
        "--json", action="store_true", help="print the cells as JSON instead of a summary over the rooms"
    )
    parser.add_argument("--no-progress", action="store_true", help="write no progress to stderr")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if cells failed."""
    study = Study.from_file(options.file)
    options.out = options.out or Path(options.file.stem)
    if options.dask and options.workers:
        raise SceneCaptumError(
            "--workers has no effect with --dask, whose scheduler has the workers: remove it."
        )
    with _executor(options.dask) as executor:
        result = study.run(
            options.out,
            executor=executor,
            workers=options.workers,
            threads=options.threads,
            retry_failed=options.retry_failed,
            show_progress=not options.no_progress,
        )
    write_files(result, options.out, FORMATS)
    report = result.write_report(options.out / "report") if options.report else None
    if options.json:
        print(json.dumps(_numbers(result), indent=1, ensure_ascii=False))
    else:
        print(result)
        if any("relaxed" in (result.numbers(cell)["measure"] or "") for cell in result.cells):
            print(EXPLAIN)
        print(_summary(result))
        print_files(options.out, FORMATS)
        print(
            f"{options.out / 'study.json'}  what the study is; a file for each cell is in {options.out / 'cells'}"
        )
        if report is not None:
            print(f"{report}  summary, figures, and a page for each cell with a picture")
    return 1 if result.failures else 0


def _summary(result: StudyResult) -> str:
    """Return the effects over the rooms, or why there are none; what is said of all cells is printed with them."""
    try:
        summary = result.summary()
    except SceneCaptumError as error:
        return f"no summary: {error}"
    return f"\n{dataclasses.replace(summary, left_out=0, premises=(), cautions='')}"


def _numbers(result: StudyResult) -> dict[str, Any]:
    """Return the cells as plain values, without their rankings."""
    finished = [(cell, result.numbers(cell)) for cell in result.cells]
    return {
        "finished": [
            {
                **cell._asdict(),
                **{name: numbers[name] for name in NUMBERS},
                **{name: numbers.get(name, none) for name, none in SAID.items()},
            }
            for cell, numbers in finished
        ],
        "failed": [{**cell._asdict(), "error": error} for cell, error in result.failures.items()],
    }


@contextlib.contextmanager
def _executor(address: str | None) -> Iterator[Executor | None]:
    """Yield the executor of a Dask scheduler, or None without an address."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise SceneCaptumError("--dask needs Dask: pip install 'scenecaptum[dask]'") from error
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise SceneCaptumError(f"There is no Dask scheduler at {address}: {error}") from error
    with client:
        yield client.get_executor()
