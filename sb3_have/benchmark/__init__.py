"""
Compare methods: train a grid of methods x seeds, and report tables and figures of the results.

What a single run needs does not belong here::

    python -m sb3_have.benchmark run benchmarks/grids/core.yml
    python -m sb3_have.benchmark report benchmarks/results/core
"""
