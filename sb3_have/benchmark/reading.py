"""Read the results of a benchmark: the CSV files of one or more folders, joined and checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

# Order of the methods in every table and figure; others follow in alphabetical order
METHODS = (
    *(
        "rgb",
        "event",
        "depth",
        "sac",
        "concat",
        "deepmdp",
        "gve",
        "gve-wide",
        "drq",
        "transfuser",
        "efnet",
        "tqc",
        "crossq",
    ),
    *("lve", "lve-paper", "have-paper", "have", "have-dropout"),
)

_STATISTICS = {"return_mean": float, "return_std": float, "distance_mean": float, "distance_std": float}
_EVALUATION = {"method": str, "seed": int, "weather": str, "step": int, **_STATISTICS, "episodes": int}


class Layout(NamedTuple):
    """The columns of a file with their types, and those that identify a row."""

    columns: dict[str, type]
    key: tuple[str, ...]


# What a results folder may contain, as ``<name>.csv``. ``drivers`` has untrained drivers, for comparison.
FILES = {
    "evaluations": Layout(_EVALUATION, ("method", "seed", "weather", "step")),
    "final": Layout(_EVALUATION, ("method", "seed", "weather", "step")),
    "episodes": Layout(
        {"method": str, "seed": int, "weather": str, "episode_seed": int}
        | {"return": float, "distance": float, "steps": int, "crashed": bool, "offroad": bool},
        ("method", "seed", "weather", "episode_seed"),
    ),
    "weights": Layout(
        {"method": str, "seed": int, "weather": str, "episode_seed": int, "t": int}
        | {"modality": str, "weight": float, "return_so_far": float},
        ("method", "seed", "weather", "episode_seed", "t", "modality"),
    ),
    "failures": Layout(
        {"method": str, "seed": int, "weather": str, "modality": str, "kind": str, "severity": int}
        | {**_STATISTICS, "episodes": int},
        ("method", "seed", "weather", "modality", "kind", "severity"),
    ),
    "runs": Layout(
        {"method": str, "seed": int, "steps": int, "parameters": int, "minutes": float}
        | {"machine": str, "versions": str, "settings": str},
        ("method", "seed", "steps"),
    ),
    "drivers": Layout({"driver": str, "weather": str, **_STATISTICS, "episodes": int}, ("driver", "weather")),
}


class ResultsError(ValueError):
    """A results file that cannot be read. The message names the file and, where it helps, the line."""


class Measure(NamedTuple):
    """A figure of merit of an episode; higher is better."""

    name: str
    short: str
    unit: str
    digits: int

    @property
    def label(self) -> str:
        """Name with unit, for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def short_label(self) -> str:
        """Abbreviation with unit, for a table."""
        return f"{self.short} [{self.unit}]" if self.unit else self.short

    def format(self, value: float) -> str:
        """Format a value with its unit, for a sentence."""
        return f"{value:.{self.digits}f}{f' {self.unit}' if self.unit else ''}"


RETURN, DISTANCE = Measure("return", "ER", "", 1), Measure("distance", "D", "m", 0)


@dataclass(frozen=True)
class Results:
    """
    The results of a benchmark.

    :param folders: Where they were read from
    :param frames: Data frames by the names of :data:`FILES`, empty for files that do not exist
    :param planned: Method and seed of the runs in the grids; empty if the grids are not known
    """

    folders: tuple[Path, ...]
    frames: dict[str, pd.DataFrame]
    planned: frozenset[tuple[str, int]] = frozenset()

    def __getitem__(self, name: str) -> pd.DataFrame:
        return self.frames[name]

    @property
    def runs(self) -> frozenset[tuple[str, int]]:
        """Method and seed of all runs, of all files and of the grids."""
        frames = [frame for frame in self.frames.values() if "method" in frame]
        known = {(str(method), int(seed)) for frame in frames for method, seed in frame[["method", "seed"]].to_numpy()}
        return self.planned | known

    @property
    def methods(self) -> list[str]:
        """Methods of all files and of the grids, in the order of :data:`METHODS`."""
        return ordered({method for method, _ in self.runs})

    def expected_seeds(self, method: str) -> list[int]:
        """Return the seeds of a method in the grids, or all existing seeds if no grid lists the method."""
        return sorted({seed for name, seed in self.planned if name == method} or {seed for _, seed in self.runs})

    @property
    def weathers(self) -> list[str]:
        """Weathers in the order of the final evaluation, or of the earlier ones if no run is finished."""
        frame = self["final"] if len(self["final"]) else self["evaluations"]
        return list(dict.fromkeys(frame["weather"]))

    @property
    def measures(self) -> list[Measure]:
        """Measures that every evaluation has: an environment may have no distance."""
        frames = [self[name] for name in ("final", "evaluations")]
        return [m for m in (RETURN, DISTANCE) if all(frame[f"{m.name}_mean"].notna().all() for frame in frames)]

    @property
    def finished(self) -> pd.DataFrame:
        """Rows of ``final`` of the runs that were evaluated in every weather, each at its last such step."""
        final, weathers = self["final"], self.weathers
        if final.empty:
            return final
        counts = final.groupby(["method", "seed", "step"])["weather"].transform("nunique")
        complete = final[counts == len(weathers)]
        return complete[complete["step"] == complete.groupby(["method", "seed"])["step"].transform("max")]

    def finished_seeds(self, method: str) -> list[int]:
        """Return the seeds of the finished runs of a method."""
        finished = self.finished
        return sorted({int(seed) for seed in finished.loc[finished["method"] == method, "seed"]})

    def scored(self) -> list[str]:
        """Return the methods with a finished run, in order."""
        return ordered(set(self.finished["method"]))

    def scores(self, method: str, measure: Measure) -> NDArray[np.float64]:
        """Return the means over the final episodes of the finished runs (n_seeds, n_weathers)."""
        return self._by_seed(self.finished, method, measure)

    def shared_steps(self) -> list[int]:
        """Return the training steps at which every finished run was evaluated in every weather."""
        runs = self.finished[["method", "seed"]].drop_duplicates()
        rows = self["evaluations"].merge(runs, on=["method", "seed"])
        counts = rows.groupby("step").size()
        return sorted(int(step) for step in counts.index[counts == len(runs) * len(self.weathers)])

    def areas(self, method: str, measure: Measure) -> NDArray[np.float64]:
        """Return the means over the evaluations at :meth:`shared_steps` of the finished runs (n_seeds, n_weathers)."""
        rows = self["evaluations"]
        rows = rows[rows["seed"].isin(self.finished_seeds(method)) & rows["step"].isin(self.shared_steps())]
        return self._by_seed(rows, method, measure)

    def _by_seed(self, rows: pd.DataFrame, method: str, measure: Measure) -> NDArray[np.float64]:
        rows = rows[rows["method"] == method]
        table = rows.pivot_table(index="seed", columns="weather", values=f"{measure.name}_mean")
        return table.reindex(columns=self.weathers).to_numpy(float)


def ordered(methods: Iterable[str]) -> list[str]:
    """Sort methods in the order of :data:`METHODS`."""
    place = {method: number for number, method in enumerate(METHODS)}
    return sorted(methods, key=lambda method: (place.get(method, len(place)), method))


def read_results(folders: Sequence[Path], grids: Sequence[Path] | None = None) -> Results:
    """
    Read and join results folders.

    :param folders: Folders of grids with the same settings; no run may be in two of them
    :param grids: Grid files, for the runs that are still missing; default: ``../../grids/<folder>.yml`` of each folder
        if it exists, as for ``benchmarks/results/core`` and ``benchmarks/grids/core.yml``
    :raises ResultsError: If a folder has no results, a row occurs twice, or a file is broken: see :func:`read_csv`
    """
    frames = {}
    for folder in folders:
        if not any((folder / f"{name}.csv").exists() for name in ("final", "evaluations")):
            raise ResultsError(f"{folder} has neither final.csv nor evaluations.csv: pass the folder of a benchmark")
    for name, layout in FILES.items():
        parts = [read_csv(path) for folder in folders if (path := folder / f"{name}.csv").exists()]
        # Only frames with rows: the columns of an empty one have no types
        filled = [part for part in parts if len(part)]
        frame = pd.concat(filled) if filled else pd.DataFrame(columns=[*layout.columns])
        if len(repeated := frame[frame.duplicated([*layout.key], keep=False)]):
            row = repeated.iloc[0]
            lines = repeated.index[(repeated[[*layout.key]] == row[[*layout.key]]).all(axis=1)]
            raise ResultsError(
                f"the same row twice, in {lines[0]} and {lines[1]}: "
                f"{', '.join(f'{key} {row[key]}' for key in layout.key)}; remove one of them"
            )
        frames[name] = frame.reset_index(drop=True)
    files = [path for path in map(grid_of, folders) if path.exists()] if grids is None else grids
    return Results(tuple(folders), frames, frozenset(run for path in files for run in _planned(path)))


def grid_of(folder: Path) -> Path:
    """Return where to look for the grid of a results folder."""
    return folder.resolve().parent.parent / "grids" / f"{folder.resolve().name}.yml"


def method_name(method: str) -> str:
    """Return the name of an entry of a grid's ``methods``: itself, or the name of its file without the ending."""
    return Path(method).stem if method.endswith((".yml", ".yaml")) else method


def _planned(path: Path) -> list[tuple[str, int]]:
    """Read method and seed of each run of a grid, without pydantic, which a report does not need otherwise."""
    grid = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [(method_name(method), seed) for method in grid["methods"] for seed in grid["seeds"]]


def read_csv(path: Path) -> pd.DataFrame:
    """
    Read one of :data:`FILES`.

    :param path: The name decides the layout
    :return: Its rows; the index is ``<path>, line <number>``
    :raises ResultsError: If the file was cut off, columns are missing, unknown or repeated, or a value is missing or
        has the wrong type
    """
    layout = FILES[path.stem]
    if not path.read_bytes().endswith(b"\n"):
        raise ResultsError(f"{path} is empty, or its last line was cut off; remove it, or that line")
    try:
        frame = pd.read_csv(path, dtype=str, keep_default_na=False, header=None, skip_blank_lines=False)
    except pd.errors.ParserError as error:
        raise ResultsError(f"{path}: {error}") from None
    header, frame = list(frame.iloc[0]), frame.iloc[1:]
    if sorted(map(str, header)) != sorted(layout.columns):
        raise ResultsError(
            f"{path}: expected the columns {', '.join(layout.columns)}, got {', '.join(map(str, header))}"
        )
    frame.columns = pd.Index(header)
    frame.index = pd.Index([f"{path}, line {number + 2}" for number in range(len(frame))])
    for name, kind in layout.columns.items():
        frame = frame.assign(**{name: _converted(frame[name], kind)})
    return frame[[*layout.columns]]


def _converted(column: pd.Series[Any], kind: type) -> pd.Series[Any]:
    """Convert a column of text to numbers (truth values to 0 and 1), or keep it as text."""
    values: pd.Series[Any] = column
    if kind is str:
        bad = np.asarray(column.isna() | (column.str.strip() == ""))
    else:
        numbers = column.replace({"True": "1", "False": "0"}) if kind is bool else column
        values = pd.to_numeric(numbers, errors="coerce").astype(float)
        bad = ~np.isfinite(values.to_numpy(float))
        if kind is int:
            bad |= (values % 1 != 0).to_numpy(bool)
        elif kind is bool or str(column.name).startswith("distance"):
            # An environment may have no distance, crashes or road
            bad &= ~column.isin(["", "nan"]).to_numpy(bool)
    if bad.any():
        place = int(bad.argmax())
        raise ResultsError(
            f"{column.index[place]}: {column.name}: expected {kind.__name__}, got {column.iloc[place]!r}"
        )
    return values.astype(int) if kind is int else values
