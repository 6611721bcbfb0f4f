"""What the benchmarks share: the machine's description, a capture to run on, timing, results as JSON."""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from twofold.capture.folder import read_capture
from twofold.capture.types import Capture
from twofold.studio.generate import StudioConfig, make_studio

try:
    from twofold.provenance import commit
except ModuleNotFoundError:  # an older commit that is measured with these files

    def commit() -> str | None:
        """Nothing is known."""
        return None


RESULTS = Path(__file__).parent / "results"


def machine() -> dict[str, object]:
    """Processor, cores, GPU, versions."""
    name = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii").splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
        flags = next(line for line in lines if line.startswith("flags"))
    except (OSError, StopIteration):
        flags = ""
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "avx512": "avx512f" in flags,
        "amx_bf16": "amx_bf16" in flags,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "load_before": os.getloadavg()[0],
    }


def studio_capture(size: int, frames: int = 10, cameras: int = 2, seed: int = 0) -> Capture:
    """A synthetic capture, kept in the temporary folder between benchmarks."""
    folder = Path("/tmp") / f"twofold-benchmark-{size}-{frames}-{cameras}-{seed}"
    if not folder.exists():
        make_studio(StudioConfig(seed=seed, size=size, frames=frames, cameras=cameras), folder)
    return read_capture(folder)


def timed(work: Callable[[], object], repeats: int, warm: int = 1) -> dict[str, float]:
    """Median and best seconds of some calls after warm-up."""
    seconds = []
    for call in range(repeats + warm):
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if call >= warm:
            seconds.append(time.perf_counter() - start)
    return {"median_s": statistics.median(seconds), "best_s": min(seconds), "repeats": repeats}


def peak_memory_gb() -> float:
    """Largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def store(name: str, result: dict[str, object]) -> None:
    """Writes benchmarks/results/NAME.json, with the machine and the commit (or that of the result), and prints it."""
    RESULTS.mkdir(exist_ok=True)
    text = json.dumps({"machine": machine(), "commit": commit(), **result}, indent=2)
    (RESULTS / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    print(text)
