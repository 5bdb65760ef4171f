"""Check and time studies on real processes.

``equal`` computes 24 cells on 1, 2 and 4 workers, on Dask and on Ray, and compares every number. ``kill`` kills a
worker, the scheduler or the client of studies at random moments with SIGKILL, runs them again, and compares the
final tables with that of a study that nobody disturbed. ``efficiency`` compares two workers with one worker that
is bound to one core, in turns. ``overhead`` measures the time that a study of very many very small cells takes
beside the computation of these, and the memory of the client. ``intervals`` counts how often the intervals of
summaries hold the truth in simulated studies, which takes no renders.

    python benchmarks/studies.py equal
    python benchmarks/studies.py kill [--times 20]
    python benchmarks/studies.py efficiency [--turns 3]
    python benchmarks/studies.py overhead [--cells 10000]
    python benchmarks/studies.py intervals [--studies 6000]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenecaptum.studies import Study, StudyResult
from scenecaptum.studies._random_effects import Observation, combine
from scenecaptum.visualization import pluralize

WITHOUT_MEANING = ("seconds", "host")
SMALL = {"resolution": (32, 18), "spp": 8, "max_depth": 4}


def small_study(seeds: int = 3) -> Study:
    """Return 8 cells for each seed: two scenes, two metrics, values and gradients."""
    return Study(
        ["office", "cornell-box"],
        metrics=["luminance", "ugr"],
        methods=["gradient", "value"],
        seeds=range(seeds),
        **SMALL,
    )


def long_study() -> Study:
    """Return 24 cells that take a few tenths of a second each."""
    return Study(["office", "cornell-box"], seeds=range(12), resolution=(64, 36), spp=32, max_depth=4)


def differences(a: StudyResult, b: StudyResult) -> list[str]:
    """Return where the results of two studies differ in any bit."""
    found = [f"only one has {cell}" for cell in set(a.cells) ^ set(b.cells)]
    for cell in set(a.cells) & set(b.cells):
        one, other = (
            {name: value for name, value in result.numbers(cell).items() if name not in WITHOUT_MEANING}
            for result in (a, b)
        )
        if one != other:
            found.append(f"numbers of {cell}")
        if cell.method == "value":
            continue
        x, y = a.attribution(cell), b.attribution(cell)
        same = [torch.equal(x[name], y[name]) for name in x]
        same += [torch.equal(x.standard_error[name], y.standard_error[name]) for name in x]
        if not all(same) or not torch.equal(x.image, y.image):
            found.append(f"tensors of {cell}")
    return found


@contextlib.contextmanager
def dask_executor(workers: int = 2) -> Iterator[Executor]:
    """Yield the executor of a Dask cluster of separate processes."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client.get_executor()


def ray_executor() -> Executor | None:
    """Return Ray's executor, or None where Ray is not installed."""
    from scenecaptum.executors import RayExecutor

    try:
        import ray  # noqa: F401
    except ImportError:
        return None
    return RayExecutor(num_cpus=2, include_dashboard=False, log_to_driver=False)


def equal(options: argparse.Namespace) -> int:
    """Compare the numbers of all executors."""
    with tempfile.TemporaryDirectory() as folder:
        results: dict[str, StudyResult] = {}
        for workers in (1, 2, 4):
            results[f"{workers} workers"] = small_study().run(Path(folder, str(workers)), workers=workers)
        with dask_executor() as executor:
            results["Dask"] = small_study().run(Path(folder, "dask"), executor=executor)
        executor = ray_executor()
        if executor is None:
            print("Ray: skipped, it is not installed")
        else:
            with executor:
                results["Ray"] = small_study().run(Path(folder, "ray"), executor=executor)
        first = results["1 workers"]
        wrong = 0
        for name, result in results.items():
            found = differences(first, result)
            wrong += len(found)
            print(
                f"{name}: {len(result)} cells, {len(result.failures)} failed, {len(found)} differ from 1 worker"
            )
    return int(wrong > 0)


# What is killed. The client of a study runs in a process of its own, from ``run_long_study``.
CLIENT = "import sys; sys.path.insert(0, {here!r}); import studies; studies.run_long_study(*sys.argv[1:])"


def run_long_study(folder: str, where: str) -> None:
    """Run the study of ``kill`` on two processes or on the Dask scheduler at an address."""
    if where == "workers":
        long_study().run(folder, workers=2)
        return
    from distributed import Client

    with Client(where, timeout="20s") as client:
        long_study().run(folder, executor=client.get_executor())


def start_client(folder: Path, where: str) -> subprocess.Popen[bytes]:
    here = str(Path(__file__).parent)
    # ``-c`` has no file that spawned workers would import again.
    command = [sys.executable, "-c", CLIENT.format(here=here), str(folder), where]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def children_of(process: int) -> list[int]:
    """Return the workers among the children of a process: those that were spawned to compute."""
    found = []
    for line in Path(f"/proc/{process}/task/{process}/children").read_text().split():
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{line}/cmdline").read_bytes():
                found.append(int(line))
    return found


def cluster(folder: Path) -> tuple[subprocess.Popen[bytes], list[subprocess.Popen[bytes]], str]:
    """Start a Dask scheduler and two workers; return them and the scheduler's address."""
    file = folder / f"scheduler-{time.time_ns()}.json"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--port", "0", "--no-dashboard", "--host", "127.0.0.1", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *options], **quiet)
    while not file.exists():
        time.sleep(0.1)
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file)]
    command += ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--death-timeout", "30"]
    workers = [subprocess.Popen(command, **quiet) for _ in range(2)]
    import json

    return scheduler, workers, json.loads(file.read_text())["address"]


def wait_or_kill(client: subprocess.Popen[bytes], moment: float, kill: Callable[[], None]) -> None:
    """Kill at a moment after the start of a client, if it still runs, and wait for the client to end."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        client.wait(moment)
        return
    kill()
    client.wait(300)


def kill_once(kind: str, folder: Path, moment: float, rng: random.Random) -> str:
    """Start a study, kill one of its processes at a moment, and run it again until it is complete."""
    results = folder / "results"
    if kind.startswith("Dask"):
        scheduler, workers, address = cluster(folder)
        client = start_client(results, address)
        target = {"Dask worker": workers[0], "Dask scheduler": scheduler, "Dask client": client}[kind]
        wait_or_kill(client, moment, target.kill)
        for process in (scheduler, *workers):
            process.kill()
            process.wait()
    else:
        client = start_client(results, "workers")

        def kill() -> None:
            spawned = children_of(client.pid)
            victim = client.pid if kind == "client" or not spawned else rng.choice(spawned)
            os.kill(victim, signal.SIGKILL)

        wait_or_kill(client, moment, kill)
    before = len(StudyResult.load(results)) if (results / "study.json").exists() else 0
    result = long_study().run(results, workers=2, retry_failed=True)
    return f"{before} of {len(result)} cells were there"


def kill(options: argparse.Namespace) -> int:
    """Kill processes of studies at random moments."""
    rng = random.Random(options.seed)
    kinds = ["worker", "client", "Dask worker", "Dask scheduler", "Dask client"]
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        undisturbed = long_study().run(Path(folder, "undisturbed"), workers=2)
        whole = time.perf_counter() - start
        for number in range(options.times):
            kind, place = kinds[number % len(kinds)], Path(folder, str(number))
            place.mkdir()
            moment = rng.uniform(0.2, 1.0) * whole
            told = kill_once(kind, place, moment, rng)
            found = differences(undisturbed, StudyResult.load(place / "results"))
            wrong += len(found)
            print(f"{number}: {kind} killed after {moment:.1f} s: {told}; {len(found)} differ", flush=True)
            shutil.rmtree(place)
    print(f"{options.times} kills, {wrong} cells differ from those of the undisturbed study")
    return int(wrong > 0)


def efficiency(options: argparse.Namespace) -> int:
    """Time two workers on two cores beside one worker on one core."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(-1, options.turns):  # the first one compiles kernels
            seconds = {}
            for workers in (1, 2):
                os.sched_setaffinity(0, cores[:workers])
                study = Study(
                    ["office", "cornell-box"], seeds=range(24), resolution=(64, 36), spp=64, max_depth=4
                )
                start = time.perf_counter()
                study.run(Path(folder, f"{turn} {workers}"), workers=workers)
                seconds[workers] = time.perf_counter() - start
            os.sched_setaffinity(0, cores)
            if turn < 0:
                continue
            ratios.append(seconds[1] / seconds[2] / 2)
            print(
                f"1 worker {seconds[1]:.1f} s, 2 workers {seconds[2]:.1f} s: {ratios[-1]:.2f} of ideal",
                flush=True,
            )
    print(f"median {sorted(ratios)[len(ratios) // 2]:.2f} of ideal, start of the processes included")
    return 0


def resident() -> float:
    """Return the memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def overhead(options: argparse.Namespace) -> int:
    """Measure the time beside the computation, and the client's memory."""
    with tempfile.TemporaryDirectory() as folder:
        for count in (options.cells // 10, options.cells):
            study = Study(
                ["cornell-box"],
                methods=[{"method": "value", "replicates": 2, "spp": 2}],
                seeds=range(count),
                resolution=(4, 4),
                max_depth=2,
            )
            place, before, start = Path(folder, str(count)), resident(), time.perf_counter()
            result = study.run(place, workers=2)
            wall, memory = time.perf_counter() - start, resident()
            computed = sum(result.numbers(cell)["seconds"] for cell in result.cells)
            beside = (2 * wall - computed) / count
            print(
                f"{len(result)} cells: {wall:.1f} s on 2 workers, {1000 * computed / count:.1f} ms of computation "
                f"and {1000 * beside:.1f} ms beside it each; client {before:.0f} MiB, then {memory:.0f} MiB",
                flush=True,
            )
    return 0


# Standard deviation between rooms, that of the noise in each room, and the number of cameras.
SIMULATED = (
    (1.0, (0.3,) * 6, 3),
    (1.0, (1.0,) * 4, 1),
    (0.1, (0.1, 0.2, 0.5, 1.0, 1.0, 2.0), 1),
    (0.5, (0.1, 0.2, 0.5, 1.0, 1.0, 2.0), 1),
    (0.5, (0.1, 1.0, 1.0), 1),
    (0.2, (0.05, 0.1, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0), 1),
)


def intervals(options: argparse.Namespace) -> int:
    """Count the simulated studies whose intervals hold the mean of all rooms, and a new room."""
    generator = np.random.default_rng(options.seed)
    for between, noise, cameras in SIMULATED:
        held, rooms = [], len(noise)
        for _ in range(options.studies):
            room = between * generator.standard_normal(rooms + 1)
            view = between / 2 * generator.standard_normal((rooms + 1, cameras))
            truth = 1 + room[:, None] + view
            effects = truth[:rooms] + np.array(noise)[:, None] * generator.standard_normal((rooms, cameras))
            found = combine(
                [
                    Observation(str(i), str(j), effects[i, j], noise[i], 7)
                    for i in range(rooms)
                    for j in range(cameras)
                ]
            )
            new = truth[rooms].mean()
            held.append([found.low <= 1 <= found.high, found.new_low <= new <= found.new_high])
        shares = np.mean(held, 0)
        of_mean, of_new = (
            f"{100 * share:.1f} ± {100 * np.sqrt(share * (1 - share) / options.studies):.1f} %"
            for share in shares
        )
        print(
            f"{rooms} rooms that differ by {between}, {pluralize(cameras, 'camera')}, noise "
            f"{', '.join(map(str, dict.fromkeys(noise)))}: {of_mean} of the 95 % intervals hold the mean, "
            f"{of_new} a new room",
            flush=True,
        )
    return 0


SECTIONS = {
    "equal": equal,
    "kill": kill,
    "efficiency": efficiency,
    "overhead": overhead,
    "intervals": intervals,
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", choices=SECTIONS)
    parser.add_argument("--times", type=int, default=20, help="of kill (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of kill and intervals (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=3, help="of efficiency (default: %(default)s)")
    parser.add_argument("--studies", type=int, default=6000, help="of intervals (default: %(default)s)")
    parser.add_argument("--cells", type=int, default=10_000, help="of overhead (default: %(default)s)")
    options = parser.parse_args(arguments)
    return SECTIONS[options.section](options)


if __name__ == "__main__":
    raise SystemExit(main())
