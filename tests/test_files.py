"""Files that are complete or absent."""

from pathlib import Path

import pytest

from sb3_have.checkpoint.files import write_atomically


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_a_file_that_could_not_be_written_leaves_nothing(error: BaseException, tmp_path: Path) -> None:
    def write_half(path: Path) -> None:
        path.write_text("ha")
        raise error

    (tmp_path / "rows.csv").write_text("before")
    for name in ("rows.csv", "new.csv"):
        with pytest.raises(type(error)):
            write_atomically(tmp_path / name, write_half)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"rows.csv": "before"}
