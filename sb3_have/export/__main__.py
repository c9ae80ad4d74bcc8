"""Export a trained model as safetensors or ONNX.

    python -m sb3_have.export runs/have-0/model.zip --format safetensors --out policy
    python -m sb3_have.export runs/have-0/model.zip --format onnx --out policy.onnx
    python -m sb3_have.export policy --format onnx

MODEL is a zip of SB3's ``model.save``, or a folder of ``--format safetensors``. Loading a zip keeps SB3's semantics: it
unpickles the file and so executes what that holds, so give only one that you trust. Loading a folder executes nothing.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_have.algorithms import ALGORITHMS, saved_algorithm
from sb3_have.export.config import NORMALIZED
from sb3_have.export.onnx import export_onnx
from sb3_have.export.safetensors import CONFIG_FILE, export_safetensors, load_policy, read_config


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.export``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="zip of model.save (trusted!), or exported folder")
    parser.add_argument("--format", choices=["onnx", "safetensors"], required=True)
    parser.add_argument("--out", type=Path, help="file (onnx) or folder (safetensors); default: named after MODEL")
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="of a zip; default: by its policy")
    args = parser.parse_args(arguments)
    source: Path = args.model
    out: Path = args.out or source.with_name(source.stem + (".onnx" if args.format == "onnx" else "_safetensors"))
    try:
        frame_stack = None
        model: BaseAlgorithm | BasePolicy
        if (source / CONFIG_FILE).is_file():
            if args.format == "safetensors":
                raise ValueError(f"{source} has been exported as safetensors already; copy the folder.")
            model, frame_stack = load_policy(source, device="cpu"), read_config(source).get("n_stack")
        else:
            model = load_zip(source, args.algo)
            for file in statistics_beside(source):
                print(f"{file} suggests that it was trained under VecNormalize: {NORMALIZED}.", file=sys.stderr)
        if args.format == "onnx":
            export_onnx(model, out, frame_stack)
        else:
            export_safetensors(model, out)
    except (ImportError, OSError, ValueError) as error:
        sys.exit(f"{parser.prog}: {error}")
    size = sum(file.stat().st_size for file in out.iterdir()) if out.is_dir() else out.stat().st_size
    print(f"{out}: {size / 1e6:.2f} MB")


def load_zip(path: Path, algo: str | None = None) -> BaseAlgorithm:
    """
    A model saved by SB3, on the CPU. This unpickles the file: it executes what that holds.

    :param path: of the zip
    :param algo: name of the algorithm; by default that of the policy, and HAVESAC for a policy of a user's own
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is something else
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, nor a folder with {CONFIG_FILE}")
    found = saved_algorithm(path, path)
    if algo is not None and found not in (None, algo):
        raise ValueError(f"{path}: its policy is of {found}, not of {algo}: leave out --algo")
    try:
        return ALGORITHMS[algo or found or "havesac"].load(path, device="cpu", buffer_size=1)
    except Exception as error:  # whatever pickle makes of a damaged file
        raise ValueError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from error


def statistics_beside(path: Path) -> list[Path]:
    """Files of VecNormalize's statistics that were saved with a zip: by SB3 beside it, by the Zoo in a folder there."""
    return sorted(file for where in ("", "*/") for file in path.parent.glob(f"{where}*vecnormalize*.pkl"))


if __name__ == "__main__":
    main()
