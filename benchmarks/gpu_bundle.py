"""Collects what a machine with a GPU, but without a network, needs for `python -m benchmarks.gpu`: below 50 MB.

The machine is expected to have Python 3.12, PyTorch with CUDA, and the common packages (NumPy, SciPy, numba,
matplotlib, Pillow). The wheels of smaller ones go into the bundle, in the versions of `constraints.txt`, and a capture.

    python -m benchmarks.gpu_bundle gpu-bundle [--capture FOLDER]

There, in a copy of this repository:

    python -m pip install --no-index --no-deps --find-links gpu-bundle/wheels -r gpu-bundle/requirements.txt
    PYTHONPATH=src python -m benchmarks.gpu --minutes 8
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

LIMIT = 50_000_000
"""Bytes of the whole bundle."""
WHEELS = (
    "tyro", "docstring-parser", "typeguard", "typing-extensions", "rich", "markdown-it-py", "mdurl", "pygments",
    "jaxtyping", "wadler-lindig", "safetensors", "jinja2", "markupsafe", "beartype", "pytest", "pluggy", "iniconfig",
    "hypothesis", "sortedcontainers", "tensorboard", "protobuf", "absl-py", "packaging",
    "scikit-image", "lazy-loader", "tifffile", "imageio", "av",
)  # fmt: skip
"""From the most needed to what can be done without: a wheel that would break the limit is left out."""
PLATFORMS = tuple(f"manylinux{version}_x86_64" for version in ("_2_28", "_2_27", "_2_17", "2014", "2010", "1"))


def pinned(constraints: str, python: tuple[int, int] = (3, 12)) -> dict[str, str]:
    """The versions that `constraints.txt` has for a Python, by name.

    >>> pinned('av==17.1.0; python_version < "3.11"\\nav==18.1.0; python_version >= "3.11"\\nrich==15.0.0')
    {'av': '18.1.0', 'rich': '15.0.0'}
    """
    versions: dict[str, str] = {}
    for line in constraints.splitlines():
        found = re.match(r'([\w.-]+)==([\w.]+)(?:\s*;\s*python_version\s*(<|>=)\s*"(\d+)\.(\d+)")?', line)
        if found:
            bound = (int(found[4]), int(found[5])) if found[3] else python
            if (python < bound) == (found[3] == "<"):
                versions[found[1]] = found[2]
    return versions


def fetch(name: str, version: str, folder: Path) -> Path:
    """The wheel of a package for Python 3.12 on Linux, fetched by pip."""
    platforms = [word for platform in PLATFORMS for word in ("--platform", platform)]
    before = set(folder.iterdir())
    subprocess.run(
        [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:", "--python-version",
         "3.12", "--implementation", "cp", *platforms, "--dest", str(folder), f"{name}=={version}"],
        check=True,
    )  # fmt: skip
    (wheel,) = set(folder.iterdir()) - before
    return wheel


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def bundle(out: Path, capture: Path | None, root: Path) -> int:
    """Fills the folder, which is made anew; returns its bytes."""
    if out.exists() and not (out / "requirements.txt").exists():
        raise SystemExit(f"{out} holds something else than a bundle; choose another folder.")
    shutil.rmtree(out, ignore_errors=True)
    (out / "wheels").mkdir(parents=True)
    (out / "requirements.txt").write_text("", encoding="utf-8")
    if capture is None:
        from twofold.studio.generate import StudioConfig, make_studio

        make_studio(StudioConfig(size=256, frames=50, cameras=4), out / "capture")
        shutil.rmtree(out / "capture" / "meshes")  # surfaces are not what is measured, and take 80 MB
    else:
        if not (capture / "capture.json").is_file():
            raise SystemExit(f"{capture} is no capture folder; make one with `twofold prepare` or `twofold import`.")
        shutil.copytree(capture, out / "capture", ignore=shutil.ignore_patterns("check", "meshes"))
    versions = pinned((root / "constraints.txt").read_text(encoding="utf-8"))
    room = LIMIT - size_of(out) - 10_000
    if room < 0:
        raise SystemExit(f"The capture takes {size_of(out) / 1e6:.0f} MB, more than the {LIMIT / 1e6:.0f} of a bundle.")
    chosen: list[str] = []
    with tempfile.TemporaryDirectory() as temporary:
        for name in WHEELS:
            wheel = fetch(name, versions[name], Path(temporary))
            if wheel.stat().st_size > room:
                print(f"{wheel.name} is left out: it takes {wheel.stat().st_size / 1e6:.0f} MB.")
                continue
            room -= wheel.stat().st_size
            shutil.copyfile(wheel, out / "wheels" / wheel.name)
            chosen.append(name)  # without a version: what the machine has already stays
    (out / "requirements.txt").write_text("\n".join(chosen) + "\n", encoding="utf-8")
    return size_of(out)


def main(words: list[str] | None = None) -> None:
    """Makes the bundle and says what to do with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--capture", type=Path)
    given = parser.parse_args(words)
    size = bundle(given.out, given.capture, Path(__file__).resolve().parents[1])
    print(f"{given.out} has {size / 1e6:.1f} MB. Take it along with this repository; there:")
    print(
        f"  python -m pip install --no-index --no-deps --find-links {given.out}/wheels -r {given.out}/requirements.txt"
    )
    print("  PYTHONPATH=src python -m benchmarks.gpu --minutes 8")


if __name__ == "__main__":
    main()
