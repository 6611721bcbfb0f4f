"""Another of BlazePose's landmark models, from a file that the user has; nothing is downloaded.

MediaPipe's wheel holds the middle one ("full"). All of them have the same inputs and outputs, so a file of the user's
takes its place in a folder of resources of its own.
"""

import contextlib
import importlib
import os
import subprocess
import sys
import zipfile
from collections.abc import Generator
from pathlib import Path
from types import ModuleType, SimpleNamespace

from twofold.errors import TwofoldError
from twofold.files import plain_errors
from twofold.inputs import is_there, require_file, shown_path

_LARGEST = 200_000_000
"""Bytes; the largest model that there is has 28 million."""
_IN_A_TASK = "pose_landmarks_detector.tflite"
_MAGIC, _OUTPUTS = b"TFL3", (b"ld_3d", b"world_3d")
_LANDMARKS = Path("mediapipe/modules/pose_landmark/pose_landmark_full.tflite")
_DETECTOR = Path("mediapipe/modules/pose_detection/pose_detection.tflite")
_SECONDS = 120
"""For which a model may be tried."""
_WHENCE = "pose_landmark_heavy.tflite of npm's @mediapipe/pose (`npm pack @mediapipe/pose`) is one"


def read_landmark_model(path: Path) -> bytes:
    """The model in a file: a .tflite, or the one in a .task bundle. It is tried, which takes some seconds.

    Raises:
        TwofoldError: it is missing, or holds no landmark model of BlazePose that runs.
    """
    if not is_there(path):
        raise TwofoldError(f"The landmark model {shown_path(path)} does not exist; correct the path ({_WHENCE}).")
    require_file(path)
    wrong = TwofoldError(f"{path} is no landmark model of BlazePose, as .tflite or .task; {_WHENCE}.")
    with plain_errors(path):
        if path.stat().st_size > _LARGEST:
            raise wrong
        content = path.read_bytes()
        if zipfile.is_zipfile(path):
            content = _unpacked(path, wrong)
    if content[4:8] != _MAGIC or any(name not in content for name in _OUTPUTS):
        raise wrong
    if not _runs(content):
        raise TwofoldError(f"MediaPipe cannot run the landmark model {path}, it may be damaged; get it again.")
    return content


def _runs(model: bytes) -> bool:
    """Whether a process of its own ends well with this model: a damaged one can end a process without a word."""
    program = (
        "import sys, numpy\n"
        "from twofold.prepare.detect.blazepose import mediapipe_estimator\n"
        "found = mediapipe_estimator(model=sys.stdin.buffer.read())\n"
        "found(numpy.zeros((64, 64, 3), numpy.uint8), 0.0)\n"
        "found.close()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    try:
        tried = subprocess.run(
            [sys.executable, "-c", program], input=model, env=environment, timeout=_SECONDS, check=False,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False
    return tried.returncode == 0


def _unpacked(path: Path, wrong: TwofoldError) -> bytes:
    try:
        with zipfile.ZipFile(path) as bundle:
            if bundle.getinfo(_IN_A_TASK).file_size > _LARGEST:
                raise wrong
            return bundle.read(_IN_A_TASK)
    except (KeyError, zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise wrong from error


@contextlib.contextmanager
def in_place_of_full(mediapipe: ModuleType, model: bytes, scratch: Path) -> Generator[None]:
    """Meanwhile a graph that is made takes this model for its "full" one.

    Args:
        mediapipe: the package.
        model: from `read_landmark_model`.
        scratch: an empty folder, which has to stay while the graph is made.
    """
    package = Path(str(mediapipe.__file__)).parent.parent
    for place in (_LANDMARKS, _DETECTOR):
        (scratch / place).parent.mkdir(parents=True)
    (scratch / _LANDMARKS).write_bytes(model)
    (scratch / _DETECTOR).write_bytes((package / _DETECTOR).read_bytes())
    # The graph's constructor names the package's folder; there is no other way to give it another one.
    names = vars(importlib.import_module("mediapipe.python.solution_base"))
    usual = names["resource_util"]
    names["resource_util"] = SimpleNamespace(set_resource_dir=lambda folder: usual.set_resource_dir(str(scratch)))
    try:
        yield
    finally:
        names["resource_util"] = usual
        usual.set_resource_dir(str(package))
