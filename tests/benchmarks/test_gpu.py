"""What a machine with a GPU is to show: each part for itself, and what it may lack in a small bundle."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import gpu, gpu_bundle  # noqa: E402


def test_a_part_that_crashes_or_hangs_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(words: list[str], stdout: object, timeout: float, **_: object) -> "subprocess.CompletedProcess[str]":
        part, result = words[3], Path(words[words.index("--result") + 1])
        if part == "compare":
            stdout.write("CUDA error: an illegal memory access\n")  # type: ignore[attr-defined]
            stdout.flush()  # type: ignore[attr-defined]
            return subprocess.CompletedProcess(words, -6)
        if part == "train-quick":
            raise subprocess.TimeoutExpired(words, timeout)
        result.write_text(json.dumps({"seen": part}))
        return subprocess.CompletedProcess(words, 0)

    monkeypatch.setattr(subprocess, "run", run)
    parts = ["environment", "compare", "train-quick", "render"]
    assert gpu.main(["--device", "cuda:0", "--minutes", "1", "--out", str(tmp_path), "--parts", *parts]) == 2
    found = json.loads((tmp_path / "gpu-cuda0.json").read_text())
    assert (found["environment"]["seen"], found["render"]["seen"]) == ("environment", "render")
    assert found["compare"]["failed"] == "exit code -6"
    assert found["compare"]["log"] == ["CUDA error: an illegal memory access"]
    assert "still running" in found["train-quick"]["failed"]
    assert "2 of 4 parts worked" in capsys.readouterr().out


@pytest.mark.slow
def test_all_parts_run_on_a_processor(person_folder: Path, tmp_path: Path) -> None:
    words = [
        "--device",
        "cpu",
        "--minutes",
        "1",
        "--size",
        "32",
        "--capture",
        str(person_folder),
        "--out",
        str(tmp_path),
    ]
    parts = [part for part in gpu.SHARES if part != "compiled"]  # takes minutes to compile
    assert (
        gpu.main([*words, "--out", str(tmp_path), "--parts", *parts, "--tests", "tests/kernels/test_sparse_rows.py"])
        == 0
    )
    found = json.loads((tmp_path / "gpu-cpu.json").read_text())
    assert found["tests"]["tests"] > 0
    assert max(found["compare"]["quick"]["loss_apart"]) == 0
    assert found["train-quick"]["steps"] > 0
    assert found["render"]["fast"]["median_s"] > 0


def test_a_bundle_holds_a_capture_and_as_many_wheels_as_fit(
    person_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fetch(name: str, version: str, folder: Path) -> Path:
        wheel = folder / f"{name}-{version}.whl"
        wheel.write_bytes(bytes(900_000 if name == "rich" else 1000))
        return wheel

    monkeypatch.setattr(gpu_bundle, "fetch", fetch)
    room = gpu_bundle.size_of(person_folder) + 500_000
    monkeypatch.setattr(gpu_bundle, "LIMIT", room)
    out = tmp_path / "bundle"
    for _ in range(2):  # the second overwrites the first
        assert gpu_bundle.bundle(out, person_folder, ROOT) < room
    assert (out / "capture" / "capture.json").is_file()
    names = {*(out / "requirements.txt").read_text().splitlines()}
    assert names == set(gpu_bundle.WHEELS) - {"rich"}
    assert len(list((out / "wheels").iterdir())) == len(names)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "photo").write_text("me")
    with pytest.raises(SystemExit, match="something else than a bundle"):
        gpu_bundle.bundle(tmp_path / "mine", person_folder, ROOT)
    assert (tmp_path / "mine" / "photo").exists()


def test_versions_are_those_that_the_constraints_have_for_the_gpus_python() -> None:
    text = 'av==17.1.0; python_version < "3.11"\nav==18.1.0; python_version >= "3.11"\n# x==1\nrich==15.0.0\n'
    assert gpu_bundle.pinned(text) == {"av": "18.1.0", "rich": "15.0.0"}
    assert gpu_bundle.pinned(text, (3, 10))["av"] == "17.1.0"
