"""The folder of a study: a manifest, one file for each finished cell, one for each that failed.

Nothing is locked: a file appears under its name when it is complete (rename), so that folders may be shared.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..attr import SceneAttribution
from ..errors import SceneCaptumError
from ..files import atomic_write, remove_abandoned, write_error
from ._recipe import Recipe

FORMAT = "scenecaptum study 1"
MANIFEST = "study.json"
CELL, NUMBERS, ATTRIBUTION = ".zip", "cell.json", "attribution.npz"
FAILED = ".json"


@dataclass(frozen=True)
class StudyFolder:
    """The files of a study."""

    path: Path

    @classmethod
    def begin(cls, path: Path, manifest: Mapping[str, Any]) -> StudyFolder:
        """Create the folder, or open that of the same study; raise if it has another one."""
        folder = cls(path)
        try:
            folder.cells.mkdir(parents=True, exist_ok=True)
            remove_abandoned(folder.cells, CELL)
            if not folder.manifest_path.exists():
                folder._write_manifest(
                    json.dumps({"format": FORMAT, **manifest}, indent=1, ensure_ascii=False)
                )
        except OSError as error:
            raise write_error(path, error) from error
        found = folder.manifest()
        if found["study"] != manifest["study"]:
            raise SceneCaptumError(
                f"{path} has another study, begun {found['begun']}: use another folder, or the arguments of that "
                "study to resume it."
            )
        if found["versions"] != manifest["versions"]:
            changed = ", ".join(
                f"{name} {version} instead of {found['versions'].get(name)}"
                for name, version in manifest["versions"].items()
                if found["versions"].get(name) != version
            )
            raise SceneCaptumError(
                f"{path} was begun with other versions ({changed}), whose numbers differ: install these again, or "
                "use another folder."
            )
        return folder

    @classmethod
    @lru_cache(maxsize=8)  # the manifest of a large study takes longer to read than a small cell to compute
    def of_worker(cls, path: Path, study: str) -> StudyFolder:
        """Return the folder in a worker, which may be on another machine."""
        folder = cls(path)
        if not folder.manifest_path.is_file() or folder.manifest()["study"] != study:
            raise SceneCaptumError(
                f"The folder {path} of the study is not seen by this worker: use a folder that all machines share."
            )
        return folder

    def _write_manifest(self, text: str) -> None:
        """Write the manifest if there is none: of two studies that begin at once, the first one wins."""
        with tempfile.NamedTemporaryFile("w", dir=self.path, prefix=".", encoding="utf-8") as draft:
            draft.write(text + "\n")
            draft.flush()
            with contextlib.suppress(FileExistsError):
                os.link(
                    draft.name, self.manifest_path
                )  # which fails if the name exists, on shared folders too

    @property
    def cells(self) -> Path:
        """Has a file for each finished cell."""
        return self.path / "cells"

    @property
    def failures(self) -> Path:
        """Has a file for each failed cell."""
        return self.path / "failed"

    @property
    def manifest_path(self) -> Path:
        """What the study is."""
        return self.path / MANIFEST

    def manifest(self) -> dict[str, Any]:
        """Return what the study is: its axes, cells, versions and hash."""
        try:
            found: dict[str, Any] = json.loads(self.manifest_path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise SceneCaptumError(f"{self.path} is not the folder of a study: {error}.") from error
        if found.get("format") != FORMAT:
            raise SceneCaptumError(
                f"{self.manifest_path} has the format {found.get('format')!r}, but this version reads {FORMAT!r}."
            )
        return found

    def finished(self) -> set[str]:
        """Return the keys of the finished cells."""
        return _stems(self.cells, CELL)

    def failed(self) -> set[str]:
        """Return the keys of the failed cells."""
        return _stems(self.failures, FAILED) - self.finished()

    def cell_path(self, key: str) -> Path:
        """Return the path of a finished cell."""
        return self.cells / f"{key}{CELL}"

    def write(self, recipe: Recipe, numbers: Mapping[str, Any], attribution: SceneAttribution | None) -> None:
        """Write a finished cell, whole or not at all."""
        text = json.dumps({"cell": recipe.cell._asdict(), "key": recipe.key, **numbers}, ensure_ascii=False)
        with atomic_write(self.cell_path(recipe.key)) as partial, zipfile.ZipFile(partial, "w") as file:
            file.writestr(NUMBERS, text)
            if attribution is not None:
                buffer = io.BytesIO()
                attribution.save(buffer)
                file.writestr(ATTRIBUTION, buffer.getvalue())
        (self.failures / f"{recipe.key}{FAILED}").unlink(missing_ok=True)

    def write_failure(self, recipe: Recipe, error: str) -> None:
        """Write a failed cell with its error."""
        text = json.dumps({"cell": recipe.cell._asdict(), "key": recipe.key, "error": error})
        try:
            self.failures.mkdir(exist_ok=True)
        except OSError as problem:
            raise write_error(self.failures, problem) from problem
        with atomic_write(self.failures / f"{recipe.key}{FAILED}") as partial:
            partial.write_text(text + "\n", encoding="utf-8")

    def read(self, key: str) -> dict[str, Any]:
        """Return the numbers of a finished cell."""
        with self._opened(key) as file:
            found: dict[str, Any] = json.loads(file.read(NUMBERS))
        return found

    def read_failure(self, key: str) -> dict[str, Any]:
        """Return a failed cell and its error."""
        found: dict[str, Any] = json.loads((self.failures / f"{key}{FAILED}").read_text(encoding="utf-8"))
        return found

    def attribution(self, key: str) -> SceneAttribution:
        """Return the attribution of a finished cell."""
        with self._opened(key) as file:
            if ATTRIBUTION not in file.namelist():
                raise SceneCaptumError(
                    "This cell has a value only, of the method 'value': there is no attribution."
                )
            return SceneAttribution.load(io.BytesIO(file.read(ATTRIBUTION)))

    @contextlib.contextmanager
    def _opened(self, key: str) -> Iterator[zipfile.ZipFile]:
        path = self.cell_path(key)
        try:
            with zipfile.ZipFile(path) as file:
                yield file
        except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
            raise SceneCaptumError(
                f"{path} is not a finished cell, or it is damaged ({error}): delete it and run the study again."
            ) from error


def _stems(folder: Path, suffix: str) -> set[str]:
    """Return the names of the complete files of a folder, without their suffix; partial files begin with a dot."""
    if not folder.is_dir():
        return set()
    with os.scandir(folder) as entries:
        return {
            entry.name[: -len(suffix)]
            for entry in entries
            if entry.name.endswith(suffix) and not entry.name.startswith(".")
        }
