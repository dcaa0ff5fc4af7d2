"""Measurements of speed, memory and bytes: ``python -m benchmarks``, or ``make bench``."""
