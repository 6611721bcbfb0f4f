"""Every benchmark with one thread and with all, one after the other; results go to benchmarks/results/."""

import argparse
import os
import subprocess
import sys

PARTS = ("step", "rendering", "quality", "evaluating")


def main() -> None:
    """Runs them in processes of their own, so that each starts with fresh memory and threads."""
    argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__).parse_args()
    for threads in sorted({1, os.cpu_count() or 1}):
        for name in PARTS:
            command = [sys.executable, "-m", f"benchmarks.{name}", "--threads", str(threads)]
            print("$", " ".join(command), flush=True)
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
