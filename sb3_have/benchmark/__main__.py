"""``python -m sb3_have.benchmark run GRID.yml`` and ``... report FOLDER``; both have ``--help``."""

from __future__ import annotations

import sys
from importlib import import_module

COMMANDS = {"run": "sb3_have.benchmark.runner", "report": "sb3_have.benchmark.report"}


def main(arguments: list[str] | None = None) -> int:
    """Call a command, whose module alone is imported: a report does without Ray and pydantic."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] not in COMMANDS:
        print(f"usage: python -m sb3_have.benchmark {{{','.join(COMMANDS)}}} ...\n{__doc__}", file=sys.stderr)
        return 0 if arguments in (["-h"], ["--help"]) else 2
    try:
        command = import_module(COMMANDS[arguments[0]])
    except ModuleNotFoundError as error:
        if error.name != "pydantic":
            raise
        raise SystemExit('a benchmark needs pydantic and Ray: pip install "sb3_have[benchmark]"') from None
    return command.main(arguments[1:]) or 0


if __name__ == "__main__":
    sys.exit(main())
