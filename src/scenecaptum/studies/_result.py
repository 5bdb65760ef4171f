"""What a study has found: its finished cells, read from the folder when they are asked for."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..attr import SceneAttribution
from ..errors import SceneCaptumError
from ..files import atomic_write
from ..visualization import DEFAULT_TOP, group_by_text, pluralize
from . import _extras as extras
from ._cell_effects import Group
from ._figures import plot_effect_by_room, plot_gallery, plot_rank_stability
from ._folder import StudyFolder
from ._notes import columns_of, count_of_cautions, notes_of
from ._recipe import AXES, Cell
from ._report import write_study_report
from ._summary import Summary, summarize_effects

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


class StudyResult:
    """The cells of a study's folder; none is in memory.

    Attributes
    ----------
    folder : Path
        The folder.
    cells : dict of Cell to str
        The finished cells, each with the name of its file, in the order of the study.
    failures : dict of Cell to str
        The failed cells, each with its error.
    missing : list of Cell
        The cells that have not been computed.
    """

    def __init__(self, folder: StudyFolder) -> None:
        self._files = folder
        self.folder = folder.path
        known = {key: Cell(*names) for key, names in folder.manifest()["cells"].items()}
        finished, failed = folder.finished(), folder.failed()
        self.cells = {cell: key for key, cell in known.items() if key in finished}
        self.failures = {
            cell: str(folder.read_failure(key)["error"]) for key, cell in known.items() if key in failed
        }
        self.missing = [cell for key, cell in known.items() if key not in finished and key not in failed]

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> StudyResult:
        """Read the folder of a study, also of one that still runs.

        Raises
        ------
        SceneCaptumError
            If it is not the folder of a study.
        """
        return cls(StudyFolder(Path(folder)))

    def __len__(self) -> int:
        return len(self.cells)

    def attribution(self, cell: Cell) -> SceneAttribution:
        """Return the attribution of a finished cell.

        Raises
        ------
        SceneCaptumError
            If the cell is not finished, or has a value only.
        """
        return self._files.attribution(self._key(cell))

    def numbers(self, cell: Cell) -> dict[str, Any]:
        """Return the numbers of a finished cell as plain values: its metric with its error, and its ranking.

        Raises
        ------
        SceneCaptumError
            If the cell is not finished.
        """
        return self._files.read(self._key(cell))

    def _key(self, cell: Cell) -> str:
        if cell not in self.cells:
            reason = self.failures.get(cell, "it has not been computed")
            raise SceneCaptumError(f"The cell {cell} is not finished: {reason}")
        key: str = self.cells[cell]
        return key

    def values(self) -> pandas.DataFrame:
        """Return a row for each cell of the study, also for the failed ones: the metric and its standard error.

        A glare rating with an absolute threshold has beside it the ``relative_rating``, with a threshold of 5
        times the mean luminance. ``caution`` is what puts a value in doubt, such as the noise of its picture, and
        ``convergence`` whether the effects add up, of a method that checks it; both are empty in a cell that an
        older version has stored.

        Raises
        ------
        SceneCaptumError
            If pandas is not installed: ``pip install 'scenecaptum[studies]'``.
        """
        finished = [
            {
                **cell._asdict(),
                "status": "finished",
                **_without_rows(numbers),
                **columns_of(numbers),
                "error": "",
            }
            for cell, numbers in ((cell, self.numbers(cell)) for cell in self.cells)
        ]
        failed = [
            {**cell._asdict(), "status": "failed", "error": error} for cell, error in self.failures.items()
        ]
        missing = [{**cell._asdict(), "status": "missing", "error": ""} for cell in self.missing]
        columns = [
            *Cell._fields,
            "status",
            "measure",
            "unit",
            "value",
            "standard_error",
            "verdict",
            "relative_rating",
            "caution",
            "convergence",
            "seconds",
        ]
        frame = extras.pandas().DataFrame([*finished, *failed, *missing], columns=[*columns, "error"])
        return frame.sort_values([*Cell._fields], ignore_index=True)

    def effects(self) -> pandas.DataFrame:
        """Return a tidy table, a row for each parameter of each finished cell, with effects and standard errors.

        ``caution`` says what puts a row in doubt, as in ``SceneAttribution.to_dataframe``.

        Raises
        ------
        SceneCaptumError
            If pandas is not installed.
        """
        columns = [
            "rank",
            "name",
            "label",
            "kind",
            "effect",
            "effect_error",
            "saliency",
            "saliency_error",
            "unit",
            "caution",
        ]
        frame = extras.pandas().DataFrame(list(self._rows()), columns=[*Cell._fields, *columns])
        return frame.sort_values([*Cell._fields, "rank"], ignore_index=True)

    def _rows(self) -> Iterator[dict[str, Any]]:
        for cell in self.cells:
            numbers = self.numbers(cell)
            for row in numbers["rows"]:
                yield {**cell._asdict(), **row, "unit": numbers["unit"]}

    def write_table(self, path: str | os.PathLike[str], *, of: str = "effects") -> None:
        """Write a table as CSV or Parquet, by the ending of the path.

        Parameters
        ----------
        path
            The file to write, atomically: ``.csv`` or ``.parquet``.
        of
            ``"effects"`` or ``"values"``.

        Raises
        ------
        SceneCaptumError
            If the file cannot be written, its ending is another one, or pandas or pyarrow is not installed.
        """
        if of not in ("effects", "values"):
            raise SceneCaptumError(f'of must be "effects" or "values", not {of!r}.')
        frame, ending = getattr(self, of)(), Path(path).suffix
        if ending not in (".csv", ".parquet"):
            raise SceneCaptumError(f"A table is written as .csv or .parquet, not as {path}.")
        with atomic_write(path) as partial:
            if ending == ".csv":
                frame.to_csv(partial, index=False)
                return
            try:
                frame.to_parquet(partial, index=False)
            except ImportError as error:
                raise SceneCaptumError("Parquet needs pyarrow: pip install 'scenecaptum[studies]'") from error

    def summary(
        self,
        group: Group = "kind",
        *,
        metric: str | None = None,
        design: str | None = None,
        method: str | None = None,
    ) -> Summary:
        """Return the mean effect of each group of parameters over the rooms, and how it varies between them.

        Example
        -------
        >>> walls = {"walls": "*wall*.reflectance.*", "floor": ["*floor*", "*rug*"]}
        >>> print(result.summary(walls))  # doctest: +SKIP

        The effect of a group in a cell is the sum over its members; its error accounts for their covariance;
        that of a sum of Shapley values is the sum of their errors, an upper limit. Rooms are a sample of the rooms
        that the study stands for, the cameras of a room a sample of its views, and seeds repeat the noise.

        Parameters
        ----------
        group
            ``"kind"``: reflectances, roughnesses, …, or the groups of a method with ``groups=``. A mapping from a
            group's name to a glob, or several, over names or labels of parameters; groups may overlap, and a room
            without such parameters does not count. None: each parameter alone, by name.
        metric, design, method
            Names of the study, to summarize only their cells.

        Returns
        -------
        Summary
            A row for each metric, design, method and group, with intervals.

        Raises
        ------
        SceneCaptumError
            If a pattern matches nothing, a name is unknown, no cell has an attribution, or statsmodels is not
            installed: ``pip install 'scenecaptum[studies]'``.
        """
        return summarize_effects(self, group, metric=metric, design=design, method=method)

    def plot_effects(
        self,
        of: str | None = None,
        group: Group = "kind",
        top: int | None = DEFAULT_TOP,
        *,
        ax: Axes | None = None,
        **names: str | None,
    ) -> Figure:
        """Draw the effect ``of`` one of the groups by room, by default of the one with the largest mean effect.

        ``group`` is as for ``summary``; ``top``, ``ax`` and the ``names`` of metric, design and method are as for
        `studies.plot_effect_by_room`.
        """
        return plot_effect_by_room(self.summary(group, **names), of, top, ax=ax)

    def plot_stability(self, group: Group = "kind", *, ax: Axes | None = None, **names: str | None) -> Figure:
        """Draw how alike cells rank the groups of ``group``, as `studies.plot_rank_stability` does.

        ``ax`` and the ``names`` of metric, design and method are as there.
        """
        return plot_rank_stability(self, group, ax=ax, **names)

    def plot_gallery(
        self,
        top: int | None = DEFAULT_TOP,
        *,
        figure: Figure | SubFigure | None = None,
        shared: bool = False,
        **names: str | None,
    ) -> Figure:
        """Draw the maps of ``top`` rooms from each camera, as `studies.plot_gallery` does.

        ``figure``, ``shared`` and the ``names`` of metric, design and method are as there.
        """
        return plot_gallery(self, top, figure=figure, shared=shared, **names)

    def write_report(
        self,
        path: str | os.PathLike[str],
        group: Group = "kind",
        *,
        pages: bool = True,
        show_progress: bool = False,
    ) -> Path:
        """Write the study as pages for a browser: an index, and a page for each cell in ``cells/`` beside it.

        The index is one self-contained file with the summary, the figures, and a table of all cells to sort and
        filter, with the errors of those that failed.

        Parameters
        ----------
        path
            A folder, or the index itself, a name that ends in ``.html``.
        group
            As for ``summary``.
        pages
            Whether to write the pages of the cells. Without, the index links those that are there.
        show_progress
            Show a progress bar of the pages.

        Returns
        -------
        Path
            The index.

        Raises
        ------
        SceneCaptumError
            If a file cannot be written, or statsmodels is not installed: ``pip install 'scenecaptum[studies]'``.
        """
        return write_study_report(self, path, group, pages=pages, show_progress=show_progress)

    def __str__(self) -> str:
        counts = [f"{pluralize(len(self.cells), 'cell')} finished"]
        counts += [f"{len(self.failures)} failed"] if self.failures else []
        counts += [f"{len(self.missing)} missing"] if self.missing else []
        axes = [
            f"{pluralize(len(names), axis)}"
            for axis in AXES
            if len(names := {getattr(cell, axis) for cell in self.cells}) > 1
        ]
        failed = group_by_text((str(cell), error) for cell, error in self.failures.items())
        errors = [f"failed: {_first(cells)}: {error}" for error, cells in failed.items()]
        over = f" ({', '.join(axes)})" if axes else ""
        cautions = [count] if (count := count_of_cautions(self, self.cells)) else []
        notes = notes_of(self, self.cells)
        return "\n".join([f"{', '.join(counts)} in {self.folder}{over}", *errors, *cautions, *notes])

    __repr__ = __str__


def _first(cells: Sequence[str]) -> str:
    """Return the first of some cells, and how many more there are."""
    return cells[0] if len(cells) == 1 else f"{cells[0]} and {pluralize(len(cells) - 1, 'more cell')}"


def _without_rows(numbers: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in numbers.items() if name not in ("rows", "cell", "key")}
