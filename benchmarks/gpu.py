"""Everything that a machine with a GPU has to show, within some minutes and without a network.

Each part runs in a process of its own, under a time limit, so that a fault of one (a kernel that breaks the GPU's
context, say) leaves the others to be measured. `make gpu-bundle` collects what such a machine may lack.

    python -m benchmarks.gpu --minutes 8 [--device cuda] [--capture FOLDER] [--out FOLDER] [--parts compare train-quick]

With `--device cpu` the same code runs on a processor.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

SHARES = {
    "environment": 0.02, "compare": 0.12, "train-quick": 0.2, "train-fast": 0.2, "render": 0.12, "compiled": 0.14,
    "tests": 0.2,
}  # fmt: skip
"""The parts in their order, and which share of the time each may take."""
RESULTS = Path(__file__).parent / "results"


def run_part(name: str, seconds: float, arguments: argparse.Namespace, folder: Path) -> dict[str, object]:
    """One part in a process of its own; what went wrong stands in the result."""
    result, log = folder / f"{name}.json", folder / f"{name}.log"
    words = [sys.executable, "-m", "benchmarks.gpu_parts", name, "--device", arguments.device]
    words += ["--seconds", f"{seconds:.0f}", "--result", str(result), "--folder", str(folder)]
    words += ["--size", str(arguments.size), "--capture", str(arguments.capture or ""), "--tests", *arguments.tests]
    begun = time.monotonic()
    with log.open("w", encoding="utf-8") as lines:
        try:
            # A part ends by itself in its time; loading, posing and storing come on top.
            limit = 1.5 * seconds + 120
            ended = subprocess.run(words, stdout=lines, stderr=subprocess.STDOUT, timeout=limit, check=False)
            how = f"exit code {ended.returncode}"
        except subprocess.TimeoutExpired:
            how = f"still running after {1.5 * seconds + 120:.0f} seconds"
    found = json.loads(result.read_text(encoding="utf-8")) if result.exists() else {}
    if not found:
        found = {"failed": how, "log": log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:]}
    return {**found, "wall_s": round(time.monotonic() - begun, 1)}


def main(words: list[str] | None = None) -> int:
    """Runs the parts and writes their results; the exit code is how many failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--capture", type=Path, help="by default gpu-bundle/capture, or a synthetic one is made")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--size", type=int, default=512, help="rows and columns of rendered images")
    parser.add_argument("--parts", nargs="+", choices=list(SHARES), default=list(SHARES))
    parser.add_argument("--tests", nargs="+", default=["tests"], help="where the tests of the device are looked for")
    arguments = parser.parse_args(words)
    arguments.out.mkdir(parents=True, exist_ok=True)
    bundled = Path("gpu-bundle/capture")
    if arguments.capture is None and bundled.is_dir():
        arguments.capture = bundled
    work = arguments.out / "gpu-work"
    work.mkdir(exist_ok=True)
    name = f"gpu-{arguments.device.replace(':', '')}"
    seconds = 60 * arguments.minutes / sum(SHARES[part] for part in arguments.parts)
    results: dict[str, object] = {"what": "all parts on one device", "device": arguments.device}
    failed = 0
    for part in arguments.parts:
        found = run_part(part, SHARES[part] * seconds, arguments, work)
        failed += "failed" in found
        results[part] = found
        # Written after each part: whatever ends the machine's time, what has been measured is there.
        (arguments.out / f"{name}.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
        print(part, json.dumps(found), flush=True)
    print(f"{len(arguments.parts) - failed} of {len(arguments.parts)} parts worked; see {arguments.out / name}.json")
    return failed


if __name__ == "__main__":
    sys.exit(main())
