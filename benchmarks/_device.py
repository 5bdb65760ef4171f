"""What a benchmark asks of its device, a CPU or a GPU: a variant, a clock, and memory."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import torch

from scenecaptum import SceneCaptumError, activate
from scenecaptum.backend import device


def add_variant(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--variant``."""
    parser.add_argument("--variant", help="llvm_ad_rgb or cuda_ad_rgb; by default what activate() chooses")


def activate_variant(parser: argparse.ArgumentParser, name: str | None) -> str:
    """Activate the variant of the option and return its name; end the script if that is impossible."""
    try:
        variant: str = activate(name).variant()
    except SceneCaptumError as error:
        parser.error(str(error))
    if not variant.endswith("_ad_rgb"):
        parser.error(f"{variant} does not render in RGB, as a SceneRenderer does.")
    return variant


def is_gpu() -> bool:
    """Whether the active variant renders on a GPU."""
    return device().type == "cuda"


def device_name() -> str:
    """Return the GPU's name, or the number of cores that this process may use."""
    if is_gpu():
        return torch.cuda.get_device_name()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{cores} cores"


def synchronize() -> None:
    """Wait until the device has finished."""
    import drjit as dr

    dr.sync_thread()
    if is_gpu():
        torch.cuda.synchronize()


def clock() -> float:
    """Return elapsed seconds after the device has finished."""
    synchronize()
    return time.perf_counter()


def memory() -> float:
    """Return the bytes in use: this process's, or what Dr.Jit and torch hold on the GPU; NaN if unknown.

    On a GPU this starts a new peak.
    """
    if not is_gpu():
        return _status("VmRSS")
    import drjit as dr

    synchronize()
    dr.detail.malloc_clear_statistics()  # lowers the peak to what is allocated now
    torch.cuda.reset_peak_memory_stats()
    return peak_memory()


def peak_memory() -> float:
    """Return the greatest number of bytes so far; NaN if unknown.

    On a GPU it is an upper bound, the sum of Dr.Jit's and torch's peaks. Both count freed memory that they keep.
    """
    if not is_gpu():
        return _status("VmHWM")
    import drjit as dr

    peak: int = dr.detail.malloc_watermark(dr.JitBackend.CUDA) + torch.cuda.max_memory_reserved()
    return peak or float("nan")


def _status(key: str) -> float:
    """Return a number of bytes from this process's status (Linux); NaN elsewhere."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    except OSError:
        return float("nan")
    return 1024 * int(lines[key].split()[0])
