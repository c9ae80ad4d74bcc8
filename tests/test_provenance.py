"""The machine and the versions of a measurement."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import gymnasium
import pytest

import sb3_have
from sb3_have.benchmark import provenance
from sb3_have.benchmark.provenance import commit_of, machine


def test_versions_name_what_results_depend_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "COMMIT", "0123456789")
    versions = machine()["versions"]
    assert versions.startswith(f"sb3_have {sb3_have.__version__} (0123456789), Python 3.")
    names = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "highway-env", "numpy", "opencv")
    assert all(re.search(rf", {name} \d[^,]*", versions) for name in names)
    assert f"gymnasium {gymnasium.__version__}," in versions
    monkeypatch.setattr(provenance, "COMMIT", None)  # as from a wheel
    assert machine()["versions"].startswith(f"sb3_have {sb3_have.__version__}, Python")


def test_commit_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*args: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main"]
        done = subprocess.run(["git", "-C", str(tmp_path), *who, *args], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    assert commit_of(tmp_path) is None
    git("init")
    assert commit_of(tmp_path) is None  # without a commit
    (tmp_path / "file").write_text("a")
    git("add", "file")
    git("commit", "-m", "first")
    commit = commit_of(tmp_path)
    assert commit and git("rev-parse", "HEAD").startswith(commit)
    (tmp_path / "file").write_text("b")
    assert commit_of(tmp_path) == f"{commit}-dirty"
    monkeypatch.setenv("PATH", str(tmp_path))  # a machine without git
    assert commit_of(tmp_path) is None
