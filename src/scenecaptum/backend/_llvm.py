"""Find and check the LLVM libraries of this machine, and select one for Dr.Jit.

Dr.Jit 1.5 aborts the process with LLVM 16 and older, still the default of many systems, and it loads LLVM when
it is first imported. Libraries are therefore checked by the bytes of their files, without loading them, and
untested versions are tried in another process.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ..errors import BackendError

OLDEST_LLVM = 17
"""Dr.Jit 1.5 emits ``fminimum``, which LLVM 16 and older cannot compile: they abort the process."""

MEASURED_LLVM = range(19, 23)
"""Versions used without a trial: 19 and 22 were measured to work."""

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""The environment variable that selects Dr.Jit's LLVM library."""

_LIBRARY_NAME = re.compile(r"libLLVM([-.]\d[\w.]*)?\.(so|dylib)[\d.]*")
_VERSION_MARKS = (re.compile(rb"libLLVM[-.](?:so\.)?(\d+)"), re.compile(rb"LLVM version (\d+)"))

# A 2×2 render tests ray tracing (Embree, OptiX) as well as compilation; LLVM 16 fails on `minimum`.
_TRIAL = """
import sys
if sys.argv[1].startswith("cuda"):
    import torch
    torch.zeros(1, device="cuda")
import mitsuba as mi
mi.set_variant(sys.argv[1])
import drjit as dr
film = {"type": "hdrfilm", "width": 2, "height": 2}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "path"}, "lamp": {"type": "constant"},
    "sensor": {"type": "perspective", "film": film},
})
brightness = dr.mean(dr.minimum(mi.render(scene, spp=1).array, 2))
assert abs(brightness[0] - 1) < 1e-3, f"a white sky rendered as {brightness[0]}"
"""


# --------------------------------------------------------------------------------------- find and check


@dataclass(frozen=True)
class LLVMLibrary:
    """An LLVM library, its version and its problem, None for a usable one."""

    path: Path
    version: int | None
    problem: str | None = None

    @property
    def measured(self) -> bool:
        """Whether this version is known to work, so that no trial is needed."""
        return self.version in MEASURED_LLVM


def llvm_libraries() -> list[LLVMLibrary]:
    """Return every LLVM library on this machine, checked by its file alone, each real file once."""
    return [_inspect(path) for path in dict.fromkeys(map(_real, _library_files()))]


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _library_files() -> Iterator[Path]:
    """Yield the files that may be LLVM libraries, the one in ``DRJIT_LIBLLVM_PATH`` first."""
    if explicit := os.environ.get(PATH_VARIABLE):
        yield Path(explicit)
    for path in _linker_cache():
        if _LIBRARY_NAME.fullmatch(path.name):
            yield path
    for folder in _library_folders():
        yield from _libraries_in(folder)


def _libraries_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.glob("libLLVM*") if _LIBRARY_NAME.fullmatch(path.name))
    except OSError:  # an unreadable folder has no usable library
        return []


def _linker_cache() -> list[Path]:
    """Return the libraries in the dynamic linker's cache (Linux; empty elsewhere)."""
    ldconfig = shutil.which("ldconfig") or "/sbin/ldconfig"  # often not in the PATH of ordinary users
    if not os.access(ldconfig, os.X_OK) or not sys.platform.startswith("linux"):
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, errors="replace", check=False)
    return [Path(line.split("=>", 1)[1].strip()) for line in listing.stdout.splitlines() if "=>" in line]


def _library_folders() -> Iterator[Path]:
    """Yield the folders in which distributions, Homebrew, conda and ``scripts/provide-llvm`` put LLVM."""
    root = Path("/")
    for pattern in (
        "usr/lib/llvm-*/lib",
        "usr/lib/*-linux-gnu*",
        "usr/lib64",
        "usr/lib64/llvm*/lib*",
        "opt/homebrew/opt/llvm*/lib",
        "usr/local/opt/llvm*/lib",
    ):
        yield from sorted(root.glob(pattern))
    if conda := os.environ.get("CONDA_PREFIX"):
        yield Path(conda, "lib")
    yield Path(sys.prefix, "lib")
    yield from (folder for folder in sorted(_unpacked().rglob("*")) if folder.is_dir())


def _unpacked() -> Path:
    """Return the folder into which ``scripts/provide-llvm`` unpacks packages that it may not install."""
    return Path(sys.prefix, "lib", "llvm")


def _inspect(path: Path) -> LLVMLibrary:
    """Check one file by its bytes."""
    try:
        version, wrong_architecture = _read_version(path), _has_wrong_architecture(path)
    except OSError as error:
        return LLVMLibrary(path, None, f"unreadable: {error.strerror or error}")
    if version is None:
        return LLVMLibrary(path, None, "not an LLVM library")
    if wrong_architecture:
        return LLVMLibrary(path, version, "built for another processor")
    if version < OLDEST_LLVM:
        return LLVMLibrary(path, version, f"too old, Dr.Jit aborts on it (needs {OLDEST_LLVM}+)")
    return LLVMLibrary(path, version)


@cache
def _read_version(path: Path) -> int | None:
    """Return the major version stated in the library's file, without loading it; None if there is none."""
    with path.open("rb") as file:
        if not os.fstat(file.fileno()).st_size:  # an empty file cannot be mapped
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            for mark in _VERSION_MARKS:
                if match := mark.search(content):
                    return int(match[1])
    return None


def _has_wrong_architecture(path: Path) -> bool:
    """Whether an ELF library was built for another processor than this Python was."""
    ours = _elf_machine(Path(sys.executable)) if sys.executable else b""  # empty where Python is embedded
    theirs = _elf_machine(path)
    return bool(ours and theirs and ours != theirs)


def _elf_machine(path: Path) -> bytes:
    """Return word size, byte order and machine of an ELF file; empty for any other file."""
    with path.open("rb") as file:
        header = file.read(20)
    return header[4:6] + header[18:20] if header.startswith(b"\x7fELF") else b""


# --------------------------------------------------------------------------------------- select and try


def choose_llvm(libraries: list[LLVMLibrary] | None = None) -> LLVMLibrary | None:
    """Return the library that Dr.Jit should use, or None if there is none.

    A usable ``DRJIT_LIBLLVM_PATH`` has priority. Otherwise it is the newest of the measured versions. Only if
    there is none, unmeasured versions are tried, newest first, each in its own process.
    """
    libraries = llvm_libraries() if libraries is None else libraries
    explicit = os.environ.get(PATH_VARIABLE)
    chosen_by_user = _real(Path(explicit)) if explicit else None

    def preference(library: LLVMLibrary) -> tuple[bool, bool, int]:
        return library.path == chosen_by_user, library.measured, library.version or 0

    usable = sorted((lib for lib in libraries if lib.problem is None), key=preference, reverse=True)
    return next((lib for lib in usable if lib.measured or trial_failure("llvm_ad_rgb", lib) is None), None)


@cache
def trial_failure(variant: str, library: LLVMLibrary | None = None) -> str | None:
    """Render four pixels in a subprocess; return an error message, or None on success.

    Without a ``library`` it uses Dr.Jit's default.
    """
    environment = dict(os.environ)
    if library is not None:
        environment[PATH_VARIABLE] = str(library.path)
        if folders := {str(sibling.parent) for sibling in _siblings(library.path).values()}:
            inherited = environment.get("LD_LIBRARY_PATH")
            environment["LD_LIBRARY_PATH"] = os.pathsep.join([*sorted(folders), *filter(None, [inherited])])
    try:
        result = subprocess.run(
            [sys.executable, "-c", _TRIAL, variant],
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=180,  # compiling OptiX kernels for the first time takes minutes on some drivers
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return None if result.returncode == 0 else _error_line(result)


def _error_line(result: subprocess.CompletedProcess[str]) -> str:
    """Return the line of a failed process's output with the reason."""
    lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
    abort = next((line for line in lines if line.startswith("LLVM ERROR")), None)
    return abort or (lines[-1] if lines else f"the process ended with status {result.returncode}")


def _siblings(path: Path) -> dict[str, Path]:
    """Return the libraries that ``scripts/provide-llvm`` unpacked together with ``path``, by file name."""
    folder = _unpacked()
    if not path.is_relative_to(_real(folder)):
        return {}
    return {file.name: file for file in folder.rglob("*.so*") if file.is_file()}


def _load_dependencies(path: Path, siblings: dict[str, Path]) -> None:
    """Load an unpacked library after its dependencies, which the dynamic linker would not find by itself.

    The linker's error names the missing library, so exactly the required ones are loaded, in order.
    """
    while True:
        try:
            # Not RTLD_GLOBAL: dependencies are matched by name anyway, and symbols must not leak.
            ctypes.CDLL(str(path))
        except OSError as error:
            missing = siblings.pop(str(error).split(":", 1)[0], None)
            if missing is None:
                raise BackendError(
                    f"{path} cannot be loaded: {error}. Run scripts/provide-llvm again."
                ) from None
            _load_dependencies(missing, siblings)
        else:
            return


def prepare_llvm() -> LLVMLibrary | None:
    """Select the library for Dr.Jit in this process and its subprocesses; None if there is none."""
    library = choose_llvm()
    if library is not None:
        if siblings := _siblings(library.path):
            _load_dependencies(library.path, siblings)
        os.environ[PATH_VARIABLE] = str(library.path)
    return library
