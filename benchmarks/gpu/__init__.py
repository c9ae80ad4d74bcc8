"""Checks and measurements of training on CUDA, in a few minutes and without a network; ``run.sh`` runs all of them."""
