"""Report what this machine has for rendering, what is missing, and the command that installs it."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ._llvm import (
    MEASURED_LLVM,
    OLDEST_LLVM,
    PATH_VARIABLE,
    LLVMLibrary,
    choose_llvm,
    llvm_libraries,
    trial_failure,
)

# --------------------------------------------------------------------------------------- variants


def default_variant() -> str:
    """Return ``cuda_ad_rgb`` if a test render with it succeeds (once per process), else ``llvm_ad_rgb``."""
    return "cuda_ad_rgb" if _cuda_problem() is None else "llvm_ad_rgb"


def _cuda_problem() -> str | None:
    """Return why CUDA cannot be used, or None. Without an NVIDIA driver this only checks for two files."""
    if not any(map(os.path.exists, ("/dev/nvidiactl", "/dev/dxg"))):  # Linux, and Linux under Windows
        return "no NVIDIA driver"
    return trial_failure("cuda_ad_rgb")


# --------------------------------------------------------------------------------------- LLVM


def no_llvm_message() -> str:
    """Return a message with the LLVM libraries found, none of them usable, and the fix."""
    found = "\n".join(f"  {_llvm_name(lib)}, {lib.path}: {_verdict(lib)}" for lib in llvm_libraries())
    return (
        f"Rendering on the CPU needs an LLVM library, version {OLDEST_LLVM} or newer "
        f"(recommended: {MEASURED_LLVM[0]} to {MEASURED_LLVM[-1]}). "
        + (f"Found only:\n{found}" if found else "Found none.")
        + f"\nFix: {_fix()}"
    )


def _llvm_name(library: LLVMLibrary) -> str:
    return "LLVM" if library.version is None else f"LLVM {library.version}"


def _verdict(library: LLVMLibrary) -> str:
    """Return whether a library is usable; an unmeasured version is tried, once per process."""
    if library.problem is not None:
        return library.problem
    if library.measured:
        return "usable"
    failure = trial_failure("llvm_ad_rgb", library)
    return "usable (test render succeeded)" if failure is None else f"fails: {failure}"


def _fix() -> str:
    """Return the command that installs LLVM on this platform, or else instructions."""
    if os.environ.get("CONDA_PREFIX"):
        return "conda install -c conda-forge libllvm19"
    if sys.platform == "darwin":
        return "brew install llvm"
    system = _os_release()
    sudo = "" if _is_root() else "sudo "
    if system & {"debian", "ubuntu"}:
        return _apt_fix(sudo)
    if system & {"fedora", "rhel", "centos"}:
        return f"{sudo}dnf install llvm-libs"
    if system & {"arch"}:
        return f"{sudo}pacman -S llvm-libs"
    return f"install LLVM 19 with your package manager, or set {PATH_VARIABLE} to its shared library"


def _apt_fix(sudo: str) -> str:
    if package := _apt_package():
        return f"{sudo}apt-get install {package}"
    # Package lists that were never fetched (containers) look like those of a system without the package.
    return (
        f"{sudo}apt-get update && {sudo}apt-get install libllvm19. If apt knows no such package: "
        f"conda install -c conda-forge libllvm19, and set {PATH_VARIABLE} to its shared library"
    )


def _apt_package() -> str | None:
    """Return the best LLVM package in apt's lists, preferably of a measured version; None if there is none."""
    unmeasured = range(MEASURED_LLVM[0] - 1, OLDEST_LLVM - 1, -1)
    names = [f"libllvm{version}" for version in (*MEASURED_LLVM, *unmeasured)]
    try:
        shown = subprocess.run(
            ["apt-cache", "show", *names], capture_output=True, text=True, errors="replace", check=False
        )
    except OSError:  # no apt
        return None
    known = re.findall(r"^Package: (\S+)$", shown.stdout, re.MULTILINE)
    return next((name for name in names if name in known), None)


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _os_release() -> set[str]:
    """Return the ids of this Linux distribution and of those it derives from."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return set()
    return {release.get("ID", ""), *release.get("ID_LIKE", "").split()}


# --------------------------------------------------------------------------------------- diagnosis


@dataclass(frozen=True)
class Diagnosis:
    """What this machine has for rendering; prints as a table with a verdict, and the fix if there is one."""

    rows: tuple[tuple[str, str], ...]
    ok: bool  # scenes can be rendered
    fix: str | None
    broken: tuple[str, ...] = ()  # what does not work although scenes can be rendered

    def __str__(self) -> str:
        width = max(len(name) for name, _ in self.rows)
        table = "\n".join(f"{name:<{width}}  {finding}" for name, finding in self.rows)
        return f"{table}\n\n{self._verdict}" + (f"\nFix: {self.fix}" if self.fix else "")

    @property
    def _verdict(self) -> str:
        if not self.ok:
            return "Rendering will not work."
        if not self.broken:
            return "All is well: scenes can be rendered and differentiated."
        return f"Scenes can be rendered and differentiated. What does not work: {', '.join(self.broken)}."


def diagnose() -> Diagnosis:
    """Check everything that rendering needs, with a test render in another process to protect this one.

    Example
    -------
    >>> print(diagnose())  # doctest: +SKIP
    Python       3.11.7
    torch        2.13.0
    Mitsuba      3.9.1
    Dr.Jit       1.5.0
    torchvision  not installed (optional, for torchvision's models)
    captum       0.9.0
    LLVM 19      usable, chosen: /usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
    LLVM 15      too old, Dr.Jit aborts on it (needs 17+): /usr/lib/x86_64-linux-gnu/libLLVM-15.so.1
    CUDA         not used: no NVIDIA driver
    Variant      llvm_ad_rgb
    Renderer     test render succeeded
    Cores        4
    """
    libraries = llvm_libraries()
    chosen, variant, cuda = choose_llvm(libraries), default_variant(), _cuda_problem()
    packages = {name: _installed(package) for name, package in _PACKAGES.items()}
    failures = {package: _import_failure(package) for package in _OPTIONAL}
    broken = [package for package, reason in failures.items() if reason is not None]
    fix = _first_fix(packages, usable=chosen is not None or cuda is None)
    if fix is not None:
        failure: str | None = "not tried"
    else:  # CUDA was already tried, in ``_cuda_problem``
        failure = None if cuda is None else trial_failure("llvm_ad_rgb", chosen)
    rows = (
        ("Python", platform.python_version()),
        *((name, version or "not installed") for name, version in packages.items()),
        *((package, _optional(package, failures[package])) for package in _OPTIONAL),
        *_llvm_rows(libraries, chosen),
        ("CUDA", "usable" if cuda is None else f"not used: {cuda}"),
        ("Variant", variant),
        ("Renderer", failure or "test render succeeded"),
        ("Cores", str(_cores())),
    )
    if fix is None and broken:
        fix = _reinstallation(broken[0], packages["torch"])
    return Diagnosis(rows, ok=failure is None, fix=fix, broken=tuple(_OPTIONAL[one] for one in broken))


_PACKAGES = {"torch": "torch", "Mitsuba": "mitsuba", "Dr.Jit": "drjit"}


_OPTIONAL = {"torchvision": "torchvision's models", "captum": "comparisons with Captum's own classes"}


def _optional(package: str, failure: str | None) -> str:
    """Return the version of a package that some features need, and whether it can be imported."""
    version = _installed(package)
    if version is None:
        return f"not installed (optional, for {_OPTIONAL[package]})"
    return version if failure is None else f"{version}, cannot be imported: {failure}"


def _import_failure(package: str) -> str | None:
    """Return why an installed package cannot be imported, or None."""
    if _installed(package) is None:
        return None
    try:
        importlib.import_module(package)
    except Exception as error:  # a build for another torch raises anything
        return str(error).partition("\n")[0] or type(error).__name__
    return None


def _reinstallation(package: str, torch: str | None) -> str:
    """Return how to install a package again, torchvision in the build of the installed torch.

    It is a command, but for a build that is not on PyPI: its index is not known here.
    """
    pip = f"{Path(sys.executable).name} -m pip"
    if package != "torchvision" or torch is None:
        return f"{pip} install --force-reinstall --no-deps {package}"
    build = torch.partition("+")[2]  # such as cpu or cu128; none for wheels of PyPI
    removal = f"{pip} uninstall -y torchvision"
    if not build:
        return f"{removal} && {pip} install torch=={torch} torchvision"
    return (
        f"install torchvision and torch {torch} from the same index: pytorch.org/get-started shows the command "
        f"for {build}. Before it: {removal}"
    )


def _installed(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _first_fix(packages: dict[str, str | None], *, usable: bool) -> str | None:
    """Return the first command to run, or None if nothing is missing."""
    missing = [_PACKAGES[name] for name, version in packages.items() if version is None]
    if missing:
        return f"{Path(sys.executable).name} -m pip install {' '.join(missing)}"
    return None if usable else _fix()


def _llvm_rows(libraries: list[LLVMLibrary], chosen: LLVMLibrary | None) -> list[tuple[str, str]]:
    """Return one row per library, the chosen one first; others of unmeasured versions are not tried."""
    if not libraries:
        return [("LLVM", "none found")]
    rows = []
    for library in sorted(libraries, key=lambda lib: (lib == chosen, lib.version or 0), reverse=True):
        skip_trial = (
            library.problem is None and not library.measured and chosen is not None and library != chosen
        )
        verdict = "not tried" if skip_trial else _verdict(library)
        rows.append((_llvm_name(library), f"{verdict}{', chosen' * (library == chosen)}: {library.path}"))
    return rows


def _cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
