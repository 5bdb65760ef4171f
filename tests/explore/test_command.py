"""``scenecaptum explore`` as a process."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request

from .windows import PATIENCE


def test_ctrl_c_ends_the_server_and_its_work() -> None:
    words = "explore cornell-box --metric luminance --resolution 64x64 --spp 4096 --no-browser"
    command = [sys.executable, "-u", "-m", "scenecaptum.cli", *words.split()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+/", process.stdout.readline())
    assert address is not None
    with urllib.request.urlopen(f"{address[0]}events", timeout=PATIENCE) as events:
        while b"Rendering the start" not in events.readline():
            pass  # the work has begun
        process.send_signal(signal.SIGINT)
        output, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert "explore: ended" in output
    assert error == ""
