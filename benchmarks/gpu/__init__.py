"""Measures and proves training on CUDA in a few minutes, on a machine without a network; ``run.sh`` runs all of it."""
