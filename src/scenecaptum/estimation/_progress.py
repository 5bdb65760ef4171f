"""Progress bar of an attribution, in units of time."""

from __future__ import annotations

from types import TracebackType
from typing import Any, TypeVar

from tqdm import tqdm

# Relative to a render: a backward pass traces every path twice and scatters derivatives.
BACKWARD_COST = 3

B = TypeVar("B", bound="ProgressBar")


class ProgressBar:
    """A bar on stderr with tqdm's options, which closes at the end of its context."""

    def __init__(self, **options: Any) -> None:
        self._bar = tqdm(**options)

    def __enter__(self: B) -> B:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()


class Progress(ProgressBar):
    """A bar for renders and backward passes, weighted by their cost, so that the time left is a prediction.

    It says when kernels are being compiled: the first pass of each kind takes longer than the others.
    """

    def __init__(self, name: str, *, show: bool) -> None:
        super().__init__(
            total=0,
            disable=not show,
            desc=name,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed} elapsed, {remaining} left{postfix}",
        )
        self._bar.set_postfix_str("compiling", refresh=False)

    def expect(self, replicates: int) -> None:
        """Add the render and the backward pass of each of so many replicates."""
        self._bar.total += (1 + BACKWARD_COST) * replicates
        self._bar.refresh()

    def rendered(self) -> None:
        """Count a render."""
        self._bar.update(1)

    def differentiated(self) -> None:
        """Count a backward pass, after which all kernels are compiled."""
        self._bar.set_postfix_str("", refresh=False)
        self._bar.update(BACKWARD_COST)
