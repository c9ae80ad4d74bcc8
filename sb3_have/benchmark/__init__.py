"""
Compare methods: train a grid of methods x seeds on one machine or a cluster, and report tables and figures of the
results. Whatever one run needs by itself belongs elsewhere::

    python -m sb3_have.benchmark run benchmarks/grids/core.yml
    python -m sb3_have.benchmark report benchmarks/results/core
"""
