"""Measurements of speed, each beside the reference form; `python -m benchmarks` runs all and stores JSON."""

from twofold.kernels.runtime import wait_passively

# Before any part of this package imports torch: beside a second busy process, a step takes ten times as long otherwise.
wait_passively()
