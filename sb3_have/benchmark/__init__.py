"""Methods side by side: a grid of training runs on one machine or a cluster, and tables and figures of its results.

python -m sb3_have.benchmark run benchmarks/grids/core.yml
python -m sb3_have.benchmark report benchmarks/results/core
"""
