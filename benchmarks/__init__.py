"""Measurements of speed, each beside the reference form; `python -m benchmarks` runs all and stores JSON."""
