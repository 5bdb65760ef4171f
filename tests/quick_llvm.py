"""An LLVM that compiles the kernels of tests in half of the time."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_suffix(".c")


def use_quick_llvm(folder: Path) -> str:
    """Let Dr.Jit, in this process and those it starts, compile with little optimization; say what it uses.

    The library and its kernels are stored in ``folder``: kernels are found again by their program alone, and
    ordinary ones must not be taken for these.
    """
    from scenecaptum.backend import choose_llvm

    compiler, llvm = shutil.which("cc"), choose_llvm()
    if not sys.platform.startswith("linux") or compiler is None or llvm is None:
        return "as installed"
    library = folder / f"libLLVM-quick.so.{llvm.version}"
    options = ["-shared", "-fPIC", "-Wl,--no-as-needed", f'-DLLVM_LIBRARY="{llvm.path}"']
    unfinished = library.with_suffix(f".{os.getpid()}")
    command = [compiler, *options, "-o", str(unfinished), str(SOURCE), str(llvm.path), "-ldl"]
    try:
        subprocess.run(command, capture_output=True, check=True)
        ctypes.CDLL(str(unfinished))
    except (
        OSError,
        subprocess.CalledProcessError,
    ):  # no headers, or an LLVM that is found only by its full path
        return "as installed"
    unfinished.replace(library)
    os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
    os.environ["DRJIT_CACHE_DIR"] = str(folder)
    return "with little optimization"
