"""Evaluating a data set's worth of images: time beyond rendering, and memory.

Each image is read from its files, compared and forgotten as in `twofold evaluate`; the rendering is one that was made
before, so that nothing but the measuring is timed.

python -m benchmarks.evaluating [--images 500] [--size 512] [--threads 2]
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace
from unittest import mock

import torch

from benchmarks.common import store, studio_capture
from twofold import evaluation
from twofold.capture.types import Capture, Frame
from twofold.kernels.runtime import tune_process
from twofold.metrics.protocols import Networks
from twofold.outputs.views import RenderedImage
from twofold.reproduce.measuring import measure_image


def rendering_like(frame: Frame) -> RenderedImage:
    """An image that differs from the true one as much as an avatar does: by noise of about 26 dB on the person."""
    truth, mask = frame.composited(torch.zeros(3)), frame.mask()
    noise = 0.05 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(frame.frame_index))
    color = (truth + noise * mask[..., None]).clamp(0, 1)
    return RenderedImage(color, mask, mask, color, color, color)


def peak_mb() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def repeated(capture: Capture, images: int) -> Capture:
    """The capture with its held-out images over and over; each is read from its files each time."""
    frames = capture.splits["novel_view"] + capture.splits["novel_pose"]
    return replace(capture, splits={"train": capture.train, "novel_pose": (frames * images)[:images]})


def main() -> None:
    """Measures and stores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    tune_process()
    capture = studio_capture(arguments.size)
    made = {(f.camera_name, f.frame_index): rendering_like(f) for f in repeated(capture, 20).splits["novel_pose"]}

    def stored(avatar: object, of: Capture, frame: Frame, refined: bool) -> RenderedImage:
        return made[frame.camera_name, frame.frame_index]

    nobody = mock.Mock(camera_response=None)
    seconds: dict[str, float] = {}
    with mock.patch.object(evaluation, "render_frame", stored):
        some = repeated(capture, max(arguments.images // 10, 1))
        evaluation.measure_split(nobody, some, "novel_pose")
        few = peak_mb()
        whole = repeated(capture, arguments.images)
        wall, processor = time.perf_counter(), time.process_time()
        means = evaluation.measure_split(nobody, whole, "novel_pose")
        seconds |= {"wall": time.perf_counter() - wall, "processor": time.process_time() - processor}
        many = peak_mb()
    processor = time.process_time()
    frames = some.splits["novel_pose"]
    for frame in frames:
        measure_image(made[frame.camera_name, frame.frame_index], some, frame, Networks())
    more = (time.process_time() - processor) / len(frames)
    result = {
        "what": "measuring images that are rendered already: reading, PSNR, SSIM and overlap as `twofold evaluate`",
        "images": arguments.images, "size": arguments.size, "threads": arguments.threads, "seconds": seconds,
        "seconds_an_image": seconds["processor"] / arguments.images,
        "seconds_an_image_of_reproduce": more,
        "peak_memory_mb": {f"{len(frames)} images": few, f"{arguments.images} images": many,
                           "reproduce": peak_mb()},
        "psnr": means["psnr"],
    }  # fmt: skip
    print(result)
    store(f"evaluating-cpu-{arguments.threads}threads", result)


if __name__ == "__main__":
    main()
