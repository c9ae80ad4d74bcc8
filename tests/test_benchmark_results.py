"""Results of a benchmark: complete at any moment, and never of mixed settings."""

from pathlib import Path
from typing import Any

import pytest
from tiny_grid import contents, make_grid

from sb3_have.benchmark import results as results_module
from sb3_have.benchmark.grid import GridError
from sb3_have.benchmark.reading import read_results
from sb3_have.benchmark.results import difference, is_finished, merge
from sb3_have.benchmark.stages import collect, run_job
from sb3_have.checkpoint import files


def test_results_of_other_settings_are_refused(tmp_path: Path) -> None:
    runs, results = tmp_path / "runs", tmp_path / "results"
    job = make_grid(tmp_path).jobs()[0]
    assert run_job(job, runs)
    merge(results, job, collect(job, runs / job.name))
    for changes, message in [
        ({"config": {"gamma": 0.5}}, "gamma is new"),
        ({"config": {"batch_size": 5}}, "batch_size: 4, now 5"),
        ({"config": {"env_kwargs": {"weather": "slow"}}}, "env_kwargs.weather: 'fast', now 'slow'"),
        ({"steps": 40}, "steps: 30, now 40"),
        ({"final_episodes": 4}, "final_episodes: 3, now 4"),
        ({"weathers": ["slow"]}, "weathers: ['fast', 'slow'], now ['slow']"),
    ]:
        other = make_grid(tmp_path, **changes).jobs()[0]  # type: ignore[arg-type]
        with pytest.raises(GridError, match="contains gve-0 with other settings") as error:
            is_finished(results, other)
        assert f"({message})" in str(error.value)
    assert not is_finished(results, make_grid(tmp_path, config={"gamma": 0.5}).jobs()[1]), "another run"
    changed = make_grid(tmp_path, config={"gamma": 0.5}).jobs()[0]
    with pytest.raises(ValueError, match="other settings"):
        run_job(changed, runs)


def test_difference_of_settings() -> None:
    assert difference({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == "a.c: 2, now 3"
    assert difference({"a": 1, "b": 2}, {"b": 2, "c": 3}) == "a: 1, not given now; c is new"
    assert difference({"a": [1]}, {"a": [1]}) == ""


def test_merge_that_is_cut_off_leaves_no_finished_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = tmp_path / "results"
    first, second, *_ = make_grid(tmp_path, failures={"kinds": ["black"]}).jobs()
    tables = {}
    for job in (first, second):
        assert run_job(job, tmp_path)
        tables[job.name] = collect(job, tmp_path / job.name)
    merge(results, first, tables[first.name])
    before = contents(results)
    whole = files.write_atomically

    for cut in range(6):
        written: list[Path] = []

        def write(path: Path, how: Any, cut: int = cut, written: list[Path] = written) -> None:
            if len(written) == cut:
                how(path.with_name(f"{path.name}.partial"))
                raise OSError("no space left")
            written.append(path)
            whole(path, how)

        monkeypatch.setattr(results_module, "write_atomically", write)
        with pytest.raises(OSError, match="no space"):
            merge(results, second, tables[second.name])
        assert is_finished(results, first) and not is_finished(results, second)
        after = {name: text for name, text in contents(results).items() if not name.endswith(".partial")}
        assert all(after[name].startswith(before[name]) for name in before), "earlier rows are complete"
    monkeypatch.setattr(results_module, "write_atomically", whole)
    merge(results, second, tables[second.name])
    assert is_finished(results, second)
    assert not read_results([results])["final"].duplicated().any()
