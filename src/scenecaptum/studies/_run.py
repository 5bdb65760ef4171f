"""Computing cells on an executor: a few ahead, so that memory does not grow with their number."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import TypeAlias

from ..errors import SceneCaptumError
from ..executors import Workers
from ._recipe import Recipe
from ._worker import Outcome

Submit: TypeAlias = Callable[[Executor, Recipe], "Future[Outcome]"]

AHEAD = 2  # cells for each worker, so that none waits for the next one
UNKNOWN_WORKERS = 256  # cells at a time on an executor that does not say how many workers it has
MAX_DEATHS = 3  # of the process that computes a cell alone
DIED = f"The process that computed this cell died {MAX_DEATHS} times: it crashed, or ran out of memory."


def on_executor(recipes: Iterable[Recipe], executor: Executor, submit: Submit) -> Iterator[Outcome]:
    """Yield the outcomes of cells as they finish on an executor of the user, which restarts its own workers."""
    for recipe, outcome in _finished(iter(recipes), executor, submit, UNKNOWN_WORKERS):
        if isinstance(outcome, BaseException):
            reason = ": ".join(filter(None, [type(outcome).__name__, str(outcome)]))
            raise SceneCaptumError(
                f"The executor {type(executor).__name__} has ended ({reason}): finished cells are kept; run the "
                f"study again with a new one to go on. It was computing {recipe.cell}."
            ) from outcome
        yield outcome


def on_workers(recipes: Iterable[Recipe], workers: Workers, submit: Submit) -> Iterator[Outcome]:
    """Yield the outcomes of cells as they finish on the processes of this machine.

    If a process dies, the pool is started again. One of the cells under way has killed it, or someone else has:
    each is computed again alone, and fails only if its process dies again and again.
    """
    waiting, deaths = iter(recipes), Counter[str]()
    while True:
        lost: deque[Recipe] = deque()
        for recipe, outcome in _finished(waiting, workers.pool, submit, AHEAD * workers.count):
            if isinstance(outcome, BaseException):
                lost.append(recipe)
            else:
                yield outcome
        if not lost:
            return
        while lost:
            workers.restart()
            yield from _alone(lost, workers, submit, deaths)


def _alone(lost: deque[Recipe], workers: Workers, submit: Submit, deaths: Counter[str]) -> Iterator[Outcome]:
    """Compute cells one at a time until a process dies again; its cell fails or goes to the end of the queue."""
    while lost:
        recipe = lost.popleft()
        ((_, outcome),) = _finished(iter([recipe]), workers.pool, submit, 1)
        if not isinstance(outcome, BaseException):
            yield outcome
            continue
        deaths[recipe.key] += 1
        if deaths[recipe.key] < MAX_DEATHS:
            lost.append(recipe)
        else:
            yield Outcome(recipe.key, 0.0, DIED)
            if not lost:
                workers.restart()  # for the cells that have not begun
        return


def _finished(
    recipes: Iterator[Recipe], executor: Executor, submit: Submit, window: int
) -> Iterator[tuple[Recipe, Outcome | BaseException]]:
    """Yield cells with their outcomes, or with the exception of an executor that has ended.

    It submits no more cells after that, but yields all that are under way. If it is closed, those that have not
    begun are canceled.
    """
    running: dict[Future[Outcome], Recipe] = {}
    ended = False
    try:
        while True:
            while not ended and len(running) < window and (recipe := next(recipes, None)) is not None:
                try:
                    running[submit(executor, recipe)] = recipe
                except (BrokenExecutor, RuntimeError) as error:  # RuntimeError: it was shut down
                    ended = True
                    yield recipe, error
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                recipe = running.pop(future)
                try:
                    yield recipe, future.result()
                except (BrokenExecutor, CancelledError) as error:
                    ended = True
                    yield recipe, error
                except Exception as error:  # of the executor: the cell catches its own
                    yield recipe, Outcome(recipe.key, 0.0, f"{type(error).__name__}: {error}")
    finally:
        for future in running:
            future.cancel()
