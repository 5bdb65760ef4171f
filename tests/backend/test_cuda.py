"""Results on a GPU are those on the CPU within their errors; all other tests render on the CPU (``conftest``)."""

import json
import os
import subprocess
import sys
from math import hypot
from pathlib import Path

import pytest
from backend.on_device import CASES
from chance import allowed
from seeds import shifted

SCRIPT = Path(__file__).with_name("on_device.py")
REPLICATES = 8


def answers(variant, seed, visible):
    environment = {name: value for name, value in os.environ.items() if name != "CUDA_VISIBLE_DEVICES"}
    if not visible:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    command = [sys.executable, SCRIPT, variant, str(seed)]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


@pytest.fixture(scope="module")
def results():
    """The answers of a GPU and of the CPU, with different seeds."""
    if not any(map(os.path.exists, ("/dev/nvidiactl", "/dev/dxg"))):
        pytest.skip("no NVIDIA driver: the CUDA variant is not tried")
    return (
        answers("cuda_ad_rgb", shifted(), visible=True),
        answers("llvm_ad_rgb", shifted(1), visible=False),
    )


@pytest.mark.parametrize("case", CASES)
def test_a_gpu_and_the_cpu_agree(results, case):
    on_gpu, on_cpu = (answer[case] for answer in results)
    assert isinstance(on_gpu, dict), on_gpu
    assert isinstance(on_cpu, dict), on_cpu
    assert on_gpu.keys() == on_cpu.keys()
    for name, (value, error) in on_gpu.items():
        expected, its_error = on_cpu[name]
        distance = abs(value - expected) / (hypot(error, its_error) or 1e-12 * (1 + abs(expected)))
        assert distance < allowed(REPLICATES, len(on_gpu)), (
            f"{name}: {value} ± {error}, {expected} ± {its_error}"
        )
