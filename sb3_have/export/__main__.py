"""
Export a trained model as safetensors or ONNX.

    python -m sb3_have.export runs/have-0/model.zip --format safetensors --out policy
    python -m sb3_have.export runs/have-0/model.zip --format onnx --out policy.onnx
    python -m sb3_have.export policy --format onnx

MODEL is a zip of SB3's ``model.save`` or a folder that ``--format safetensors`` wrote. Loading a zip unpickles it,
which can execute any code, so only load files that you trust. Loading a folder executes nothing.
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
from sb3_have.export.safetensors import export_safetensors, load_policy, read_config


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.export``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="zip of model.save (trusted!) or exported folder")
    parser.add_argument("--format", choices=["onnx", "safetensors"], required=True)
    parser.add_argument("--out", type=Path, help="file (onnx) or folder (safetensors); default: named after MODEL")
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="algorithm of a zip; default: found by its policy")
    args = parser.parse_args(arguments)
    source: Path = args.model
    out: Path = args.out or source.with_name(source.stem + (".onnx" if args.format == "onnx" else "_safetensors"))
    model: BaseAlgorithm | BasePolicy
    try:
        if not source.is_dir():
            model, frame_stack = load_zip(source, args.algo), None
        elif args.format == "onnx":
            model, frame_stack = load_policy(source, device="cpu"), read_config(source)["n_stack"]
        else:
            raise ValueError(f"{source} is a folder, only a zip can be exported as safetensors")
        if args.format == "onnx":
            export_onnx(model, out, frame_stack)
        else:
            export_safetensors(model, out)
    except (ImportError, OSError, ValueError) as error:
        sys.exit(f"{parser.prog}: {error}")
    size = sum(file.stat().st_size for file in (out.iterdir() if out.is_dir() else [out]))
    print(f"{out}: {size / 1e6:.2f} MB")


def load_zip(path: Path, algo: str | None = None) -> BaseAlgorithm:
    """
    Load a model that SB3 saved, on the CPU. This unpickles the file, which can execute any code.

    :param path: The zip
    :param algo: Name of the algorithm; by default that of the policy, and HAVESAC for your own policies
    """
    known = saved_algorithm(path, path)
    name = algo or known or "havesac"
    if known not in (None, name):
        raise ValueError(f"{path} was saved by {known}, not by {name}: leave out --algo")
    model = ALGORITHMS[name].load(path, device="cpu", buffer_size=1)
    # A zip does not say whether the model was trained under VecNormalize; SB3 and the Zoo save the statistics nearby
    for file in sorted([*path.parent.glob("*vecnormalize*.pkl"), *path.parent.glob("*/*vecnormalize*.pkl")]):
        print(f"{file}: if the model was trained under VecNormalize, {NORMALIZED}", file=sys.stderr)
    return model


if __name__ == "__main__":
    main()
