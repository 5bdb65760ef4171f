"""Find a compiler that Dr.Jit can use, select Mitsuba's variant, and explain what is missing.

Dr.Jit compiles rendering kernels with LLVM (CPU) or CUDA (GPU). Dr.Jit 1.5 aborts the whole process on LLVM
16 and older, which many systems still have as their default, and it takes its choice when it is first
imported. So libraries are judged by the bytes of their files, never by loading them, and doubtful ones are
tried in another process.

Example
-------
>>> import scenecaptum as sc
>>> mi = sc.activate()
>>> scene = mi.load_dict(mi.cornell_box())
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from scenecaptum.errors import BackendError, near_misses

if TYPE_CHECKING:
    import torch

OLDEST_LLVM = 17
"""Dr.Jit 1.5 emits ``fminimum``, which LLVM 16 and older cannot compile: they abort the process."""

MEASURED_LLVM = range(19, 23)
"""Versions believed without a trial: 19 and 22 were measured to work."""

_ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
_LIBRARY_NAME = re.compile(r"libLLVM([-.]\d[\w.]*)?\.(so|dylib)[\d.]*")
_VERSION_MARKS = (re.compile(rb"libLLVM[-.](?:so\.)?(\d+)"), re.compile(rb"LLVM version (\d+)"))

# A 2×2 render tries ray tracing (Embree, OptiX) as well as compilation; `minimum` is what LLVM 16 trips over.
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


# --------------------------------------------------------------------------------------- LLVM: find and judge


@dataclass(frozen=True)
class LLVMLibrary:
    """An LLVM library and what its file says about it; ``problem`` is None for one that may be used."""

    path: Path
    version: int | None
    problem: str | None = None

    @property
    def measured(self) -> bool:
        """Whether this version is known to work, so that no trial is needed."""
        return self.version in MEASURED_LLVM


def llvm_libraries() -> list[LLVMLibrary]:
    """Return every LLVM library found on this machine, judged by its file alone, each real file once."""
    return [_inspect(path) for path in dict.fromkeys(map(_real, _library_files()))]


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _library_files() -> Iterator[Path]:
    """Yield the files that may be LLVM libraries, an explicitly chosen one first."""
    if explicit := os.environ.get(_ENVIRONMENT_VARIABLE):
        yield Path(explicit)
    for path in _linker_cache():
        if _LIBRARY_NAME.fullmatch(path.name):
            yield path
    for folder in _library_folders():
        yield from _libraries_in(folder)


def _libraries_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.glob("libLLVM*") if _LIBRARY_NAME.fullmatch(path.name))
    except OSError:  # a folder we may not read holds nothing that we could use
        return []


def _linker_cache() -> list[Path]:
    """Return the libraries that the dynamic linker knows (Linux; empty elsewhere)."""
    ldconfig = shutil.which("ldconfig") or "/sbin/ldconfig"  # a plain user's PATH often lacks /sbin
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
    """Return the folder where ``scripts/provide-llvm`` unpacks packages that it may not install."""
    return Path(sys.prefix, "lib", "llvm")


def _inspect(path: Path) -> LLVMLibrary:
    """Judge one file by its bytes."""
    try:
        version, foreign = _read_version(path), _is_foreign(path)
    except OSError as error:
        return LLVMLibrary(path, None, f"unreadable: {error.strerror or error}")
    if version is None:
        return LLVMLibrary(path, None, "not an LLVM library")
    if foreign:
        return LLVMLibrary(path, version, "built for another processor")
    if version < OLDEST_LLVM:
        return LLVMLibrary(path, version, f"too old, Dr.Jit aborts on it (needs {OLDEST_LLVM}+)")
    return LLVMLibrary(path, version)


@cache
def _read_version(path: Path) -> int | None:
    """Return the major version that the library's file states, without loading it; None if it states none."""
    with path.open("rb") as file:
        if not os.fstat(file.fileno()).st_size:  # an empty file cannot be mapped
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            for mark in _VERSION_MARKS:
                if match := mark.search(content):
                    return int(match[1])
    return None


def _is_foreign(path: Path) -> bool:
    """Whether an ELF library was built for another processor than this Python was."""
    ours = _elf_machine(Path(sys.executable)) if sys.executable else b""  # empty where Python is embedded
    theirs = _elf_machine(path)
    return bool(ours and theirs and ours != theirs)


def _elf_machine(path: Path) -> bytes:
    """Return word size, byte order and processor of an ELF file; empty for anything else."""
    with path.open("rb") as file:
        header = file.read(20)
    return header[4:6] + header[18:20] if header.startswith(b"\x7fELF") else b""


# --------------------------------------------------------------------------------------- LLVM: choose and try


def choose_llvm(libraries: list[LLVMLibrary] | None = None) -> LLVMLibrary | None:
    """Return the library that Dr.Jit should use, or None if there is none.

    A usable ``DRJIT_LIBLLVM_PATH`` wins. Otherwise the newest of the measured versions is taken; only where
    none of those exists are unmeasured ones tried, newest first, each in a process of its own.
    """
    libraries = llvm_libraries() if libraries is None else libraries
    explicit = os.environ.get(_ENVIRONMENT_VARIABLE)
    chosen_by_user = _real(Path(explicit)) if explicit else None

    def preference(library: LLVMLibrary) -> tuple[bool, bool, int]:
        return library.path == chosen_by_user, library.measured, library.version or 0

    usable = sorted((one for one in libraries if one.problem is None), key=preference, reverse=True)
    return next((one for one in usable if one.measured or trial_failure("llvm_ad_rgb", one) is None), None)


@cache
def trial_failure(variant: str, library: LLVMLibrary | None = None) -> str | None:
    """Render four pixels in a throw-away process; return what went wrong, or None if they came out right.

    Parameters
    ----------
    variant
        The Mitsuba variant to render with.
    library
        The LLVM library to render with; Dr.Jit's own choice if omitted.
    """
    environment = dict(os.environ)
    if library is not None:
        environment[_ENVIRONMENT_VARIABLE] = str(library.path)
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
    return None if result.returncode == 0 else _last_words(result)


def _last_words(result: subprocess.CompletedProcess[str]) -> str:
    """Return the line of a failed process's output that says why it failed."""
    lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
    abort = next((line for line in lines if line.startswith("LLVM ERROR")), None)
    return abort or (lines[-1] if lines else f"the process ended with status {result.returncode}")


def _siblings(path: Path) -> dict[str, Path]:
    """Return the libraries unpacked beside one that ``scripts/provide-llvm`` unpacked, by file name."""
    folder = _unpacked()
    if not path.is_relative_to(_real(folder)):
        return {}
    return {one.name: one for one in folder.rglob("*.so*") if one.is_file()}


def _load_dependencies(path: Path, siblings: dict[str, Path]) -> None:
    """Load an unpacked library after those it needs, which the dynamic linker would not find by itself.

    The linker's complaint names the one that is missing, so exactly the needed ones are loaded, in order.
    """
    while True:
        try:
            # Not RTLD_GLOBAL: names match loaded libraries anyway, and symbols must not leak.
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


def _prepare_llvm() -> LLVMLibrary | None:
    """Point Dr.Jit, and every process started from this one, at the library to use."""
    library = choose_llvm()
    if library is not None:
        if siblings := _siblings(library.path):
            _load_dependencies(library.path, siblings)
        os.environ[_ENVIRONMENT_VARIABLE] = str(library.path)
    return library


# --------------------------------------------------------------------------------------- the fix


def _fix() -> str:
    """Return the one command that provides LLVM on this platform."""
    if os.environ.get("CONDA_PREFIX"):
        return "conda install -c conda-forge libllvm19"
    if sys.platform == "darwin":
        return "brew install llvm"
    system = _os_release()
    sudo = "" if _is_root() else "sudo "
    for names, command in (
        ({"debian", "ubuntu"}, "apt-get install libllvm19"),
        ({"fedora", "rhel", "centos"}, "dnf install llvm-libs"),
        ({"arch"}, "pacman -S llvm-libs"),
    ):
        if names & system:
            return sudo + command
    return f"install LLVM 19 with your package manager, or set {_ENVIRONMENT_VARIABLE} to its shared library"


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _os_release() -> set[str]:
    """Return the names this Linux distribution goes by, its ancestors' included."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return set()
    return {release.get("ID", ""), *release.get("ID_LIKE", "").split()}


def _no_llvm_message(libraries: list[LLVMLibrary]) -> str:
    found = "\n".join(f"  {_llvm_name(one)}, {one.path}: {_verdict(one)}" for one in libraries)
    return (
        f"Rendering on the CPU needs an LLVM library, version {OLDEST_LLVM} or newer "
        f"(best {MEASURED_LLVM[0]} to {MEASURED_LLVM[-1]}). "
        + (f"Found only:\n{found}" if found else "Found none.")
        + f"\nFix: {_fix()}"
    )


def _llvm_name(library: LLVMLibrary) -> str:
    return "LLVM" if library.version is None else f"LLVM {library.version}"


def _verdict(library: LLVMLibrary) -> str:
    """Return what is known about a library, running nothing that has not been run already."""
    if library.problem is not None:
        return library.problem
    if library.measured:
        return "usable"
    failure = trial_failure("llvm_ad_rgb", library)
    return "usable, as a trial showed" if failure is None else f"fails: {failure}"


# --------------------------------------------------------------------------------------- activate


def activate(variant: str | None = None) -> ModuleType:
    """Make Mitsuba ready for differentiable rendering and return the ``mitsuba`` module.

    Call it before importing ``mitsuba`` or ``drjit`` yourself; calling it again costs nothing. If it is
    the first to import Mitsuba, it quietens the log to errors; ``mi.set_log_level`` turns it up again.

    Parameters
    ----------
    variant
        A differentiable Mitsuba variant such as ``"llvm_ad_rgb"`` or ``"cuda_ad_rgb"``. If omitted, a
        differentiable variant that is already active stays; otherwise it is ``cuda_ad_rgb`` where a trial
        render on a CUDA device succeeds, else ``llvm_ad_rgb``. Scenes belong to the variant they were loaded
        under, so load them again after a change.

    Raises
    ------
    BackendError
        If no usable LLVM or CUDA exists, or the variant is unknown or cannot be differentiated.

    Example
    -------
    >>> mi = activate()
    >>> mi.variant()
    'llvm_ad_rgb'
    """
    wanted = variant or _active_variant() or default_variant()
    if "drjit" not in sys.modules and _prepare_llvm() is None and not wanted.startswith("cuda"):
        raise BackendError(_no_llvm_message(llvm_libraries()))
    first = "mitsuba" not in sys.modules
    mi = _import_mitsuba()
    if first:
        mi.set_log_level(mi.LogLevel.Error)  # its warnings would break progress bars and reports apart
    _check_variant(wanted, mi.variants(), asked=variant is not None)
    _check_compiler(wanted)
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    return mi


def device() -> torch.device:
    """Return the torch device on which the active variant's images and gradients live."""
    import torch  # this module must stay importable without torch

    variant: str = activate().variant()
    return torch.device("cuda" if variant.startswith("cuda") else "cpu")


def default_variant() -> str:
    """Return ``cuda_ad_rgb`` where that really renders (tried once per process), else ``llvm_ad_rgb``."""
    return "cuda_ad_rgb" if _cuda_problem() is None else "llvm_ad_rgb"


def _cuda_problem() -> str | None:
    """Return why CUDA cannot be used, or None; without an NVIDIA driver this is a look at two files."""
    if not any(map(os.path.exists, ("/dev/nvidiactl", "/dev/dxg"))):  # Linux, and Linux under Windows
        return "no NVIDIA driver"
    return trial_failure("cuda_ad_rgb")


def _active_variant() -> str | None:
    mi = sys.modules.get("mitsuba")
    variant: str | None = mi.variant() if mi is not None else None
    return variant


def _import_mitsuba() -> ModuleType:
    try:
        import mitsuba  # its import fixes the choice of LLVM, so it comes last
    except ImportError as error:
        raise BackendError(
            f"Mitsuba cannot be imported: {error}. Fix: pip install 'mitsuba>=3.9,<3.10'"
        ) from error
    module: ModuleType = mitsuba
    return module


def _check_variant(wanted: str, known: list[str], *, asked: bool) -> None:
    """Raise unless the variant exists and has derivatives."""
    differentiable = [name for name in known if "_ad_" in name]
    if wanted not in known:
        hint = near_misses(wanted, differentiable)
        raise BackendError(
            f"Unknown Mitsuba variant {wanted!r}.{hint} Differentiable variants: {', '.join(differentiable)}."
        )
    if wanted not in differentiable:
        cause = "" if asked else f" It was set by mi.set_variant({wanted!r}): remove that line."
        raise BackendError(
            f"Mitsuba's variant {wanted!r} cannot be differentiated; one with '_ad_' in its name is needed."
            f"{cause} Fix: call scenecaptum.activate({default_variant()!r})."
        )


def _check_compiler(variant: str) -> None:
    """Raise where Dr.Jit, as it was imported, would abort or fail on this variant."""
    import drjit as dr  # importing it loads LLVM

    if variant.startswith("cuda"):
        if not dr.has_backend(dr.JitBackend.CUDA):
            raise BackendError(
                f"{variant} needs CUDA, and Dr.Jit found none. Fix: scenecaptum.activate('llvm_ad_rgb')"
            )
        return
    version = dr.detail.llvm_version()[0] if dr.has_backend(dr.JitBackend.LLVM) else None
    if version is not None and version >= OLDEST_LLVM:
        return
    library = choose_llvm()
    if library is None:
        raise BackendError(_no_llvm_message(llvm_libraries()))
    loaded = f"LLVM {version}, which it cannot compile with" if version else "no LLVM that it could load"
    raise BackendError(
        f"Dr.Jit was imported with {loaded}, and this cannot be changed any more. Fix: call "
        f"scenecaptum.activate() before importing mitsuba or drjit, or start Python with "
        f"{_ENVIRONMENT_VARIABLE}={library.path}"
    )


# --------------------------------------------------------------------------------------- diagnose


@dataclass(frozen=True)
class Diagnosis:
    """What this machine has for rendering, as a table that prints itself, the verdict, and the fix if any."""

    rows: tuple[tuple[str, str], ...]
    ok: bool
    fix: str | None

    def __str__(self) -> str:
        width = max(len(name) for name, _ in self.rows)
        table = "\n".join(f"{name:<{width}}  {finding}" for name, finding in self.rows)
        verdict = (
            "All is well: scenes can be rendered and differentiated."
            if self.ok
            else "Rendering will not work."
        )
        return f"{table}\n\n{verdict}" + (f"\nFix: {self.fix}" if self.fix else "")


def diagnose() -> Diagnosis:
    """Look at everything rendering needs and try it in another process, so that nothing can break this one.

    Example
    -------
    >>> print(diagnose())  # doctest: +SKIP
    Python    3.11.7
    torch     2.13.0
    Mitsuba   3.9.1
    Dr.Jit    1.5.0
    LLVM 19   usable, chosen: /usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
    LLVM 15   too old, Dr.Jit aborts on it (needs 17+): /usr/lib/x86_64-linux-gnu/libLLVM-15.so.1
    CUDA      not used: no NVIDIA driver
    Variant   llvm_ad_rgb
    Renderer  a test image came out right
    Cores     4
    """
    libraries = llvm_libraries()
    chosen, variant, cuda = choose_llvm(libraries), default_variant(), _cuda_problem()
    packages = {name: _installed(package) for name, package in _PACKAGES.items()}
    fix = _first_fix(packages, usable=chosen is not None or cuda is None)
    failure = _render_failure(chosen, cuda, tried=fix is None)
    rows = (
        ("Python", platform.python_version()),
        *((name, version or "not installed") for name, version in packages.items()),
        *_llvm_rows(libraries, chosen),
        ("CUDA", "usable" if cuda is None else f"not used: {cuda}"),
        ("Variant", variant),
        ("Renderer", failure or "a test image came out right"),
        ("Cores", str(_cores())),
    )
    return Diagnosis(rows, ok=failure is None, fix=fix)


def _render_failure(chosen: LLVMLibrary | None, cuda: str | None, *, tried: bool) -> str | None:
    if not tried:
        return "not tried"
    # CUDA was tried already, to know its problem.
    return None if cuda is None else trial_failure("llvm_ad_rgb", chosen)


_PACKAGES = {"torch": "torch", "Mitsuba": "mitsuba", "Dr.Jit": "drjit"}


def _installed(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _first_fix(packages: dict[str, str | None], *, usable: bool) -> str | None:
    """Return the command to run first, or None when everything needed is there."""
    missing = [_PACKAGES[name] for name, version in packages.items() if version is None]
    if missing:
        return f"{Path(sys.executable).name} -m pip install {' '.join(missing)}"
    return None if usable else _fix()


def _llvm_rows(libraries: list[LLVMLibrary], chosen: LLVMLibrary | None) -> list[tuple[str, str]]:
    """Return one row per library, the chosen one first; unmeasured ones are not tried needlessly."""
    if not libraries:
        return [("LLVM", "none found")]
    rows = []
    for library in sorted(libraries, key=lambda one: (one == chosen, one.version or 0), reverse=True):
        needless = (
            library.problem is None and not library.measured and chosen is not None and library != chosen
        )
        verdict = "untried" if needless else _verdict(library)
        rows.append((_llvm_name(library), f"{verdict}{', chosen' * (library == chosen)}: {library.path}"))
    return rows


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def main() -> int:
    """Print the diagnosis and return the exit status: 0 when scenes can be rendered, else 1."""
    diagnosis = diagnose()
    print(diagnosis)
    return 0 if diagnosis.ok else 1


if __name__ == "__main__":
    sys.exit(main())
