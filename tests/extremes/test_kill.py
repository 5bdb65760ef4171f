"""kill -9 at random moments: a resumed job loses at most one render and ends with the same numbers."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneAttribution

KILLS, SEED = 20, 20261121
PASSES = 2 * 16  # as many renders as backward passes: a linear metric needs no more

# The job; it logs its start, and each render and backward pass that it begins.
JOB = """
import os, sys
from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.checkpoint import Checkpoint

folder, log, out = sys.argv[1:4]
log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

class LoggedCheckpoint(Checkpoint):
    def get_or_render(self, inputs, render, device=None):
        def logged():
            os.write(log, b"begun\\n")
            return render()
        return super().get_or_render(inputs, logged, device)

renderer = SceneRenderer("cornell-box", "reflectance", resolution=(32, 32), spp=16 * 512, max_depth=4)
method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
method.attribute(replicates=2, spp=2)  # warm-up: imports and compiles
os.write(log, b"started\\n")
method.attribute(seed=1, replicates=16, checkpoint=LoggedCheckpoint(folder)).save(out)
"""


def run(folder: Path, log: Path, out: Path, seconds: float | None = None) -> int | None:
    """Run the job, and kill it so many seconds after it started; return its status, None if it was killed."""
    command = [sys.executable, "-c", JOB, str(folder), str(log), str(out)]
    before = log.read_text().count("started") if log.exists() else 0
    process = subprocess.Popen(command)
    if seconds is not None:
        while process.poll() is None and not (log.exists() and log.read_text().count("started") > before):
            time.sleep(0.01)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
    status = process.wait()
    return None if status == -signal.SIGKILL else status


@pytest.mark.long
def test_kill_at_random_moments(tmp_path: Path) -> None:
    folder, log = tmp_path / "kept", tmp_path / "log"
    assert run(tmp_path / "uninterrupted", log, tmp_path / "whole.npz") == 0
    working = SceneAttribution.load(tmp_path / "whole.npz").info["seconds"]
    assert log.read_text().count("begun") == PASSES
    log.unlink()

    fractions = random.Random(shifted(SEED))
    killed, lost, done = 0, 0, 0
    while killed < KILLS:
        begun = log.read_text().count("begun") if log.exists() else 0
        # Kill it at a random moment of an eighth of the whole work, counted from its start.
        status = run(folder, log, tmp_path / "resumed.npz", fractions.random() * working / 8)
        kept = len(list(folder.glob("[!.]*.pass"))) if folder.exists() else 0
        begun = log.read_text().count("begun") - begun
        assert begun - (kept - done) <= 1
        lost += begun - (kept - done)
        done = kept
        if status is not None:
            # The job finished between two kills: the others meet a new one.
            assert status == 0
            for one in folder.iterdir():
                one.unlink()
            done = 0
            continue
        killed += 1
    assert run(folder, log, tmp_path / "resumed.npz") == 0
    whole, resumed = (SceneAttribution.load(tmp_path / f"{name}.npz") for name in ("whole", "resumed"))
    worst = max(
        float((resumed[name] - value).abs().max() / value.abs().max()) for name, value in whole.items()
    )
    usage = resumed.info["checkpoint"]
    print(
        f"\nkilled {killed} times, {lost} renders lost, {usage['reused']} of {usage['passes']} reused by the "
        f"last run; largest relative difference from an uninterrupted run: {worst:.1e}"
    )
    assert lost <= killed
    assert usage["reused"] == done
    assert worst < 1e-5
    assert torch.allclose(torch.tensor(resumed.metric_value), torch.tensor(whole.metric_value), rtol=1e-6)
    assert usage["passes"] == PASSES
