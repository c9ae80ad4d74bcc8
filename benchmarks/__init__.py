"""Benchmark scripts. Their results are in benchmarks/results."""
