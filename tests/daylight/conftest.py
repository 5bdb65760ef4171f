"""What several files of this folder share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def radiance() -> Path:
    """Folder of Radiance's bin and lib."""
    pyradiance = pytest.importorskip(
        "pyradiance", reason="Radiance is not here: pip install 'scenecaptum[test]' brings pyradiance==1.3.1"
    )
    return Path(pyradiance.__path__[0])
