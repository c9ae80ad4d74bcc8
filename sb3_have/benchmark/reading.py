"""Results of a benchmark as its runs wrote them: CSV files of one or more folders, joined and checked line by line."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

METHODS = (
    *("rgb", "event", "depth", "sac", "deepmdp", "gve", "gve-wide", "drq", "transfuser", "efnet", "tqc", "crossq"),
    *("lve", "lve-paper", "have-paper", "have", "have-dropout"),
)
"""Order of the methods in every table and figure; others follow in alphabetical order."""

_MOMENTS = ("return_mean", "return_std", "distance_mean", "distance_std")
_STATISTICS: dict[str, type] = {**dict.fromkeys(_MOMENTS, float), "episodes": int}
_EVALUATION = {"method": str, "seed": int, "weather": str, "step": int, **_STATISTICS}


class Layout(NamedTuple):
    """Columns of a file with their types, and those that tell its rows apart."""

    columns: dict[str, type]
    key: tuple[str, ...]


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
        {"method": str, "seed": int, "weather": str, "modality": str, "kind": str, "severity": int, **_STATISTICS},
        ("method", "seed", "weather", "modality", "kind", "severity"),
    ),
    "runs": Layout(
        {"method": str, "seed": int, "steps": int, "parameters": int, "minutes": float}
        | {"machine": str, "versions": str, "settings": str},
        ("method", "seed", "steps"),
    ),
    "drivers": Layout({"driver": str, "weather": str, **_STATISTICS}, ("driver", "weather")),
}
"""What a results folder may hold, as ``<name>.csv``. ``drivers`` has drivers that did not learn, to compare with."""


class ResultsError(ValueError):
    """A results file that cannot be read; the message names the file, the line and the remedy."""


class Measure(NamedTuple):
    """A figure of merit of an episode: higher is better."""

    name: str
    short: str
    unit: str
    digits: int

    @property
    def label(self) -> str:
        """With its unit, for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


RETURN, DISTANCE = Measure("return", "ER", "", 1), Measure("distance", "D", "m", 0)


@dataclass(frozen=True)
class Results:
    """What is known of a benchmark.

    :param folders: it was read from
    :param frames: by the names of :data:`FILES`; empty ones for files that are not there
    :param planned: method and seed of the runs that the grids ask for, empty if the grids are not known
    """

    folders: tuple[Path, ...]
    frames: dict[str, pd.DataFrame]
    planned: frozenset[tuple[str, int]] = frozenset()

    def __getitem__(self, name: str) -> pd.DataFrame:
        return self.frames[name]

    @property
    def methods(self) -> list[str]:
        """Of all files and of the grids, in the order of :data:`METHODS`."""
        planned = {method for method, _ in self.planned}
        return ordered(planned.union(*(frame["method"] for frame in self._of_methods())))

    @property
    def seeds(self) -> list[int]:
        """Of all files and of the grids."""
        planned = {seed for _, seed in self.planned}
        return sorted(planned.union(*(map(int, frame["seed"]) for frame in self._of_methods())))

    def expected_seeds(self, method: str) -> list[int]:
        """What the grids ask for; of a method in none of them, every seed that there is."""
        planned = sorted(seed for name, seed in self.planned if name == method)
        return planned or self.seeds

    @property
    def weathers(self) -> list[str]:
        """Of the final evaluations, in the order in which they were driven; of the earlier ones before there is one."""
        frame = self["final"] if len(self["final"]) else self["evaluations"]
        return list(dict.fromkeys(frame["weather"]))

    @property
    def measures(self) -> list[Measure]:
        """Those that every evaluation tells: an environment may have no distance."""
        frames = [self[name] for name in ("final", "evaluations")]
        return [m for m in (RETURN, DISTANCE) if all(frame[f"{m.name}_mean"].notna().all() for frame in frames)]

    @property
    def finished(self) -> pd.DataFrame:
        """``final`` of the finished runs, those evaluated in every weather; of each, at its last such step."""
        final, weathers = self["final"], self.weathers
        if final.empty:
            return final
        counts = final.groupby(["method", "seed", "step"])["weather"].transform("nunique")
        complete = final[counts == len(weathers)]
        return complete[complete["step"] == complete.groupby(["method", "seed"])["step"].transform("max")]

    def finished_seeds(self, method: str) -> list[int]:
        """Seeds whose runs are finished."""
        finished = self.finished
        return sorted({int(seed) for seed in finished.loc[finished["method"] == method, "seed"]})

    def scores(self, method: str, measure: Measure) -> NDArray[np.float64]:
        """Means over the episodes of the finished runs (n_seeds, n_weathers)."""
        rows = self.finished[self.finished["method"] == method]
        table = rows.pivot(index="seed", columns="weather", values=f"{measure.name}_mean")
        return table.reindex(columns=self.weathers).to_numpy(float)

    def shared_steps(self) -> list[int]:
        """Steps at which every finished run was evaluated in every weather while training."""
        runs = self.finished[["method", "seed"]].drop_duplicates()
        rows = self["evaluations"].merge(runs, on=["method", "seed"])
        counts = rows.groupby("step").size()
        return sorted(int(step) for step in counts.index[counts == len(runs) * len(self.weathers)])

    def areas(self, method: str, measure: Measure) -> NDArray[np.float64]:
        """Means over the evaluations at :meth:`shared_steps` of the finished runs (n_seeds, n_weathers)."""
        rows = self["evaluations"]
        rows = rows[(rows["method"] == method) & rows["seed"].isin(self.finished_seeds(method))]
        rows = rows[rows["step"].isin(self.shared_steps())]
        table = rows.pivot_table(index="seed", columns="weather", values=f"{measure.name}_mean")
        return table.reindex(columns=self.weathers).to_numpy(float)

    def scored(self) -> list[str]:
        """Methods with a finished run, in order."""
        return ordered(set(self.finished["method"]))

    def _of_methods(self) -> list[pd.DataFrame]:
        return [frame for frame in self.frames.values() if "method" in frame]


def ordered(methods: Iterable[str]) -> list[str]:
    """Methods in the order of :data:`METHODS`."""
    place = {method: number for number, method in enumerate(METHODS)}
    return sorted(methods, key=lambda method: (place.get(method, len(place)), method))


def read_results(folders: Sequence[Path], grids: Sequence[Path] | None = None) -> Results:
    """Read and join results folders.

    :param folders: of grids with the same settings; no run may be in two of them
    :param grids: YAML files that say which runs there are to be; default: ``../../grids/<folder>.yml`` of each folder
        where it exists, as for ``benchmarks/results/core`` and ``benchmarks/grids/core.yml``
    :raises ResultsError: if a folder has no results, or a file is broken: see :func:`read_csv`
    """
    parts: dict[str, list[pd.DataFrame]] = {name: [] for name in FILES}
    for folder in folders:
        if not any((folder / f"{name}.csv").exists() for name in ("final", "evaluations")):
            raise ResultsError(f"{folder} has neither final.csv nor evaluations.csv: give the folder of a benchmark")
        for name in FILES:
            if (path := folder / f"{name}.csv").exists():
                parts[name].append(read_csv(path))
    frames = {}
    for name, layout in FILES.items():
        # an empty frame takes part only where there is no other: its columns have no types
        filled = [part for part in parts[name] if len(part)]
        frame = pd.concat(filled) if filled else pd.DataFrame(columns=[*layout.columns])
        _refuse_twins(frame, layout)
        if name == "runs":
            _check_settings(frame)
        frames[name] = frame.reset_index(drop=True)
    files = [path for path in map(grid_of, folders) if path.exists()] if grids is None else grids
    return Results(tuple(folders), frames, frozenset(run for path in files for run in _planned(path)))


def grid_of(folder: Path) -> Path:
    """Where the grid of a results folder is looked for."""
    return folder.resolve().parent.parent / "grids" / f"{folder.resolve().name}.yml"


def _planned(path: Path) -> list[tuple[str, int]]:
    """Method and seed of each run of a grid."""
    try:
        grid = yaml.safe_load(path.read_text(encoding="utf-8"))
        names = [str(name) for name in grid["methods"]]
        names = [Path(name).stem if name.endswith((".yml", ".yaml")) else name for name in names]
        return [(name, int(seed)) for name in names for seed in grid["seeds"]]
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"{path} is no grid with methods and seeds: {error!r}") from None


def read_csv(path: Path) -> pd.DataFrame:
    """Read one of :data:`FILES`.

    :param path: whose name decides the layout
    :return: its rows; the index is ``<path>, line <number>``
    :raises ResultsError: if the file is empty, a column is missing, unknown or there twice, a line has more or fewer
        fields than the header, or a value is not of its column's type
    """
    layout = FILES[path.stem]
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        header = next(reader, None)
        if not header:
            raise ResultsError(f"{path} is empty: expected the columns {', '.join(layout.columns)}; remove it")
        wrong = {"missing": set(layout.columns) - set(header), "unknown": set(header) - set(layout.columns)}
        if told := "; ".join(f"{kind}: {', '.join(sorted(names))}" for kind, names in wrong.items() if names):
            raise ResultsError(f"{path}, line 1: wrong columns ({told}); expected {', '.join(layout.columns)}")
        if len(header) > len(set(header)):
            raise ResultsError(f"{path}, line 1: a column is there twice: {', '.join(header)}")
        rows, lines = [], []
        for row in reader:
            line = f"{path}, line {reader.line_num}"
            if len(row) != len(header):
                raise ResultsError(f"{line}: expected {len(header)} fields, got {len(row)}: was it cut short?")
            rows.append(row)
            lines.append(line)
    frame = pd.DataFrame(rows, index=lines, columns=header, dtype=str)
    for name, kind in layout.columns.items():
        frame[name] = _converted(frame[name], kind)
    return frame[[*layout.columns]]


def _converted(column: pd.Series[Any], kind: type) -> pd.Series[Any]:
    """A column of text as numbers, truth values or text."""
    expected = {str: "a name", int: "a whole number", float: "a number", bool: "True or False"}[kind]
    values, bad = column, np.asarray(column.str.strip() == "")
    if kind is not str:
        numbers = column.replace({"True": "1", "False": "0"}) if kind is bool else column
        values = pd.to_numeric(numbers.str.strip(), errors="coerce").astype(float)
        bad = ~np.isfinite(values.to_numpy(float))
        if kind is int:
            bad |= (values % 1 != 0).to_numpy(bool)
        elif kind is bool or str(column.name).startswith("distance"):
            # an environment that does not tell leaves NaN
            bad &= ~column.str.lower().isin(["", "nan"]).to_numpy(bool)
    if bad.any():
        place = int(bad.argmax())
        raise ResultsError(f"{column.index[place]}: {column.name}: expected {expected}, got {column.iloc[place]!r}")
    return values.astype(int) if kind is int else values


def _refuse_twins(frame: pd.DataFrame, layout: Layout) -> None:
    twins = frame.duplicated([*layout.key], keep=False)
    if twins.any():
        key = frame.loc[twins, [*layout.key]].iloc[0]
        lines = frame.index[(frame[[*layout.key]] == key).all(axis=1)]
        what = ", ".join(f"{name} {value}" for name, value in key.items())
        raise ResultsError(
            f"the same row twice, at {lines[0]} and {lines[1]}: {what}; "
            "remove one of them, or report the folders separately"
        )


def _check_settings(runs: pd.DataFrame) -> None:
    for line, text in zip(runs.index, runs["settings"].astype(str), strict=True):
        try:
            settings = json.loads(text)
        except json.JSONDecodeError as error:
            raise ResultsError(f"{line}: settings: expected JSON, got {text[:40]!r}: {error}") from None
        if not isinstance(settings, dict):
            raise ResultsError(f"{line}: settings: expected them by name, got {text[:40]!r}")
