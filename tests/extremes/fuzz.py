"""Corrupts everything that the library reads, and counts the outcomes.

Each input is made from valid input by a random generator seeded with the seed, the kind and its number, and is
tried in a worker process, which is restarted when it dies or hangs. A good outcome is success or one
``SceneCaptumError``; on the command line exit status 2 and one clear line. Where ``strace`` is installed, every
file that is opened is checked too.

    python tests/extremes/fuzz.py [--count 2100] [--seed 0] [--kind xml --only 17]
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from extremes import spoil

HANG = 30.0  # seconds
STARTING = 120.0
INPUTS_PER_WORKER = 150
MEMORY = 16 * 2**30  # a worker that asks for more gets an error
GOOD = ("succeeded", "refused")
BAD = ("error", "crash", "hang", "strayed")
MARK = "/scenecaptum-fuzz"


@dataclass(frozen=True)
class Outcome:
    """The outcome of one input: ``word`` is one of GOOD or BAD, ``detail`` the message."""

    kind: str
    index: int
    word: str
    detail: str = ""


# --- The worker: takes inputs from stdin, one JSON line each, and answers each with a line ----------


def work() -> None:
    """Try the inputs that stdin names, until it ends."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what Mitsuba prints must not be mistaken for an answer
    import torch

    from scenecaptum import activate

    torch.set_num_threads(1)
    mi = activate()
    with tempfile.TemporaryDirectory(prefix="scenecaptum-fuzz-") as scratch:
        files = Path(scratch, "files")
        files.mkdir()
        spoiler = spoil.Spoiler(mi, files)
        print("ready", file=answers)
        for line in sys.stdin:
            seed, kind, index = json.loads(line)
            folder = Path(scratch, "case")
            folder.mkdir()
            os.chdir(folder)
            word, detail = _try(spoiler, seed, kind, index, folder)
            os.chdir(scratch)
            shutil.rmtree(folder)
            print(json.dumps([word, detail]), file=answers)


def _try(spoiler: Any, seed: int, kind: str, index: int, folder: Path) -> tuple[str, str]:
    from scenecaptum import SceneCaptumError

    run = spoiler.case(kind, random.Random(f"{seed}/{kind}/{index}"), folder)
    before = _files(folder)
    _mark("begin", kind, index)
    try:
        word, detail = "succeeded", run() or ""
    except SceneCaptumError as error:
        said = str(error)
        word, detail = (
            ("refused", said) if said and "\n" not in said else ("error", f"not one line: {said!r}")
        )
    except BaseException as error:
        word, detail = "error", f"{type(error).__name__}: {error}"
    _mark("end", kind, index)
    own = spoiler.may_write
    strayed = {
        path for path in _files(folder) - before if path.split("/")[0] not in own and not {"", "."} & own
    }
    return ("strayed", f"wrote {sorted(strayed)}") if strayed else (word, detail)


def _files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.name != "__pycache__"}


def _mark(*words: object) -> None:
    """Leave a mark in strace's record: the attempt to open a file that does not exist."""
    with contextlib.suppress(OSError):
        os.open("/".join(map(str, (MARK, *words))), os.O_RDONLY)


# --- The warden: keeps a worker alive and asks it --------------------------------------------------


class Warden:
    """Passes inputs to a worker process, and replaces it when it dies, hangs or has tried many."""

    def __init__(self, traces: Path, *, is_tracing: bool = True) -> None:
        self._traces = traces
        self._tracer = shutil.which("strace") if is_tracing else None
        self._worker: subprocess.Popen[bytes] | None = None
        self._served = self._started = 0

    def ask(self, seed: int, kind: str, index: int) -> Outcome:
        """Try one input."""
        if self._worker is None or self._served == INPUTS_PER_WORKER:
            self._replace()
        worker = self._worker
        assert worker is not None
        assert worker.stdin is not None
        self._served += 1
        worker.stdin.write(json.dumps([seed, kind, index]).encode() + b"\n")
        worker.stdin.flush()
        try:
            word, detail = json.loads(self._answer(HANG))
        except TimeoutError:
            word, detail = "hang", f"no answer in {HANG:.0f} s"
            self.stop()
        except EOFError:
            word, detail = "crash", self._last_words()
            self.stop()
        return Outcome(kind, index, word, detail)

    def stop(self) -> None:
        """End the worker."""
        if self._worker is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._worker.pid, signal.SIGKILL)
            self._worker.communicate()
            self._worker = None

    def strayed(self) -> Iterator[Outcome]:
        """Return the inputs that opened a file which they do not name."""
        for trace in sorted(self._traces.glob("*.trace")):
            yield from _strayed(trace.read_text(errors="replace").splitlines())

    def _replace(self) -> None:
        self.stop()
        self._started += 1
        self._served = 0
        command = [sys.executable, str(Path(__file__).resolve()), "--work"]
        if self._tracer is not None:
            watch = ["-f", "-qq", "-s", "512", "--seccomp-bpf", "-e", "trace=open,openat,creat"]
            command = [self._tracer, *watch, "-o", str(self._traces / f"{self._started}.trace"), *command]
        self._stderr = self._traces / f"{self._started}.stderr"
        self._worker = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr.open("wb"),
            start_new_session=True,
        )
        try:
            self._answer(STARTING)
        except EOFError:
            raise RuntimeError(f"the worker did not start: {self._last_words()}") from None

    def _answer(self, seconds: float) -> bytes:
        assert self._worker is not None
        assert self._worker.stdout is not None
        line, until = b"", time.monotonic() + seconds
        while not line.endswith(b"\n"):
            if not select.select([self._worker.stdout], [], [], max(0.0, until - time.monotonic()))[0]:
                raise TimeoutError
            piece = os.read(self._worker.stdout.fileno(), 65536)
            if not piece:
                raise EOFError
            line += piece
        return line

    def _last_words(self) -> str:
        assert self._worker is not None
        status = self._worker.wait()
        return f"exit status {status}: {self._stderr.read_text(errors='replace')[-300:].strip()}"


# What Python, the kernel compiler and matplotlib's fonts open.
OWN_READS = (
    sys.prefix,
    sys.base_prefix,
    *filter(None, sys.path),
    "/usr",
    "/lib",
    "/etc/ld.so.cache",
    "/etc/localtime",
)
OWN_READS += ("/proc", "/sys", "/dev", "/var/cache/fontconfig")
OPENED = re.compile(r'open(?:at)?\((?:AT_FDCWD, )?"([^"]*)", ([A-Z_|0-9a-z]+).*= (-?\d+)')


def _strayed(lines: Iterable[str]) -> Iterator[Outcome]:
    case: tuple[str, int] | None = None
    own = (*OWN_READS, *spoil.own_folders())
    for line in lines:
        found = OPENED.search(line)
        if found is None:
            continue
        path, flags, status = found.groups()
        if path.startswith(MARK):
            _, moment, kind, index = path.removeprefix(MARK).split("/")
            case = (kind, int(index)) if moment == "begin" else None
        elif case and int(status) >= 0 and path.startswith("/") and "/case" not in path:
            writes = re.search("O_WRONLY|O_RDWR|O_CREAT", flags)
            if writes and not path.startswith((*spoil.own_folders(), "/dev/")):
                yield Outcome(*case, "strayed", f"wrote {path}")
            elif not writes and not path.startswith(own) and not spoil.is_named(path):
                yield Outcome(*case, "strayed", f"read {path}")


# --- The whole ------------------------------------------------------------------------------------


def fuzz(
    count: int,
    seed: int = 0,
    kinds: Iterable[str] = spoil.KINDS,
    *,
    is_tracing: bool = True,
    progress: bool = False,
) -> list[Outcome]:
    """Try about ``count`` inputs, spread over the kinds, and return the outcome of each."""
    shares = {kind: spoil.KINDS[kind] for kind in kinds}
    plan = [
        (kind, index)
        for kind, share in shares.items()
        for index in range(max(1, round(count * share / sum(shares.values()))))
    ]
    return attempt(plan, seed, is_tracing=is_tracing, progress=progress)


def attempt(
    plan: Iterable[tuple[str, int]], seed: int = 0, *, is_tracing: bool = True, progress: bool = False
) -> list[Outcome]:
    """Try the inputs of these kinds and numbers; ``is_tracing`` checks which files they open (with strace)."""
    with tempfile.TemporaryDirectory(prefix="scenecaptum-traces-") as traces:
        warden = Warden(Path(traces), is_tracing=is_tracing)
        outcomes = {}
        try:
            for kind, index in plan:
                outcome = outcomes[kind, index] = warden.ask(seed, kind, index)
                if progress and outcome.word in BAD:
                    print(f"{kind} {index}: {outcome.word}: {outcome.detail[:400]}", flush=True)
        finally:
            warden.stop()
        for stray in warden.strayed():
            outcomes[stray.kind, stray.index] = stray
            if progress:
                print(f"{stray.kind} {stray.index}: {stray.word}: {stray.detail}", flush=True)
        return list(outcomes.values())


def table(outcomes: Iterable[Outcome]) -> str:
    """Lay out the counts: a row for each kind, a column for each outcome."""
    counts = collections.Counter((one.kind, one.word) for one in outcomes)
    words = [*GOOD, *BAD]
    rows = [["kind", "inputs", *words]]
    for kind in dict.fromkeys(kind for kind, _ in counts):
        numbers = [counts[kind, word] for word in words]
        rows.append([kind, str(sum(numbers)), *map(str, numbers)])
    totals = [sum(int(row[column]) for row in rows[1:]) for column in range(1, len(rows[0]))]
    rows.append(["all", *map(str, totals)])
    return "\n".join(f"{row[0]:10s}" + "".join(f"{cell:>11s}" for cell in row[1:]) for row in rows)


def main() -> int:
    """Fuzz, print the table, and return 1 if any outcome is bad."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=2100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(spoil.KINDS))
    parser.add_argument("--only", type=int, help="the number of a single input")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work()
        return 0
    kinds = options.kind or list(spoil.KINDS)
    if options.only is not None:
        outcomes = attempt([(kind, options.only) for kind in kinds], options.seed)
        print("\n".join(f"{one.kind} {one.index}: {one.word}: {one.detail}" for one in outcomes))
    else:
        outcomes = fuzz(options.count, options.seed, kinds, progress=True)
        print(table(outcomes))
    return int(any(one.word in BAD for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
