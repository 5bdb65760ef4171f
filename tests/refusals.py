"""The message of a refusal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from scenecaptum import SceneCaptumError


def message(call: Callable[[], Any]) -> str:
    """Return the message of the error that a call raises."""
    with pytest.raises(SceneCaptumError) as caught:
        call()
    return str(caught.value)
