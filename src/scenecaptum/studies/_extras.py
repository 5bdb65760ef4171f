"""The libraries of the extra ``studies``, imported when they are first needed."""

from __future__ import annotations

import importlib
from typing import Any

from ..errors import SceneCaptumError


def pandas() -> Any:
    """Return pandas; raise if it is not installed."""
    return _imported("pandas", "pandas", "Tables of a study")


def meta_analysis() -> Any:
    """Return the module of statsmodels that combines effects; raise if it is not installed."""
    return _imported("statsmodels.stats.meta_analysis", "statsmodels", "Summaries of a study")


def student_t() -> Any:
    """Return SciPy's distribution, which takes fractional degrees of freedom; raise if it is not installed."""
    return _imported("scipy.stats", "scipy", "Summaries of a study").t


def _imported(module: str, library: str, purpose: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise SceneCaptumError(f"{purpose} need {library}: pip install 'scenecaptum[studies]'") from error
