"""Ray as an executor, in processes of its own."""

from __future__ import annotations

import pytest

from scenecaptum.executors import RayExecutor


@pytest.mark.long
def test_tasks_run_in_processes_of_ray_and_raise_here() -> None:
    pytest.importorskip("ray", reason="Ray is not installed, or has no wheel for this Python")
    import os

    with RayExecutor(num_cpus=2, include_dashboard=False, log_to_driver=False) as executor:
        assert executor.submit(pow, 2, 5).result() == 32
        assert list(executor.map(divmod, [7, 9], [2, 4])) == [(3, 1), (2, 1)]
        assert executor.submit(os.getpid).result() != os.getpid()
        failed = executor.submit(int, "no number")
        with pytest.raises(ValueError, match="no number"):
            failed.result()
