"""Studies that several tests look at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from seeds import seeds
from study_metrics import aborts, brightness, broken

from scenecaptum.studies import Study, StudyResult

TINY: dict[str, Any] = {"resolution": (8, 8), "spp": 4, "max_depth": 2}
VALUE = {"method": "value", "replicates": 2}


def value_study(*scenes: Any, **options: Any) -> Study:
    """Return a study of values, whose cells take a few milliseconds."""
    return Study(**{"scenes": scenes or ["cornell-box"], "methods": {"value": VALUE}, **TINY, **options})


@pytest.fixture
def thread() -> Iterator[Executor]:
    """An executor in this process, which is quicker than others to start."""
    with ThreadPoolExecutor(1) as executor:
        yield executor


@pytest.fixture
def run(mi: Any, thread: Executor) -> Callable[..., StudyResult]:
    """Run a study in this process."""

    def run_here(study: Study, folder: Path, **options: Any) -> StudyResult:
        return study.run(folder, **{"executor": thread, "threads": None, **options})

    return run_here


@pytest.fixture(scope="session")
def in_processes(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    """A study on two processes; one of its metrics raises, and one ends the process."""
    study = Study(
        ["cornell-box"],
        cameras={"front": 0, "left": {"turn": -15}},
        metrics={"own": brightness, "broken": broken, "aborts": aborts},
        cells=[
            *(
                ("cornell-box", camera, "own", "as it is", "gradient", seeds(1)[0])
                for camera in ("front", "left")
            ),
            ("cornell-box", "front", "broken", "as it is", "gradient", seeds(1)[0]),
            ("cornell-box", "front", "aborts", "as it is", "gradient", seeds(1)[0]),
            ("cornell-box", "front", "own", "as it is", "gradient", seeds(1, 2)[0]),
        ],
        inputs="reflectance",
        **TINY,
    )
    return study.run(tmp_path_factory.mktemp("processes"), workers=2)
