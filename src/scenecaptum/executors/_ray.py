"""Ray as an executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from ..errors import SceneCaptumError


class RayExecutor(Executor):
    """A ``concurrent.futures.Executor`` whose tasks run on Ray, each on one core.

    Example
    -------
    >>> with RayExecutor(address="auto") as executor:  # doctest: +SKIP
    ...     study.run("results", executor=executor)

    Parameters
    ----------
    options
        As for ``ray.init``, if Ray is not connected yet; it is then disconnected on ``shutdown``.

    Raises
    ------
    SceneCaptumError
        If Ray is not installed: ``pip install 'scenecaptum[ray]'``.
    """

    def __init__(self, **options: Any) -> None:
        try:
            import ray
        except ImportError as error:
            raise SceneCaptumError("RayExecutor needs Ray: pip install 'scenecaptum[ray]'") from error
        self._ray, self._owns_connection = ray, not ray.is_initialized()
        if self._owns_connection:
            ray.init(**options)
        self._call = ray.remote(num_cpus=1, max_retries=3)(_call)

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future result of ``function`` with ``args`` and ``kwargs`` in a process of Ray."""
        future: Future[Any] = self._call.remote(function, args, kwargs).future()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Disconnect from Ray if this executor has done so; ``wait`` and ``cancel_futures`` have no effect."""
        if self._owns_connection:
            self._ray.shutdown()


def _call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return function(*args, **kwargs)
