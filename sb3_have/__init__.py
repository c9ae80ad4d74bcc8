"""Hierarchical adaptive value estimation (HAVE) for multi-modal agents, on Stable-Baselines3."""

from pathlib import Path

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()
