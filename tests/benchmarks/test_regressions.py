"""What counts as a regression, and that the stored baseline has what the command compares."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import regressions

STORED = json.loads(regressions.BASELINE.read_text(encoding="utf-8"))


def test_the_baseline_is_no_regression_of_itself() -> None:
    assert set(STORED["metrics"]) == set(regressions.METRICS)
    assert all(0 < ratio < 3 for ratio in STORED["ratios"].values())
    assert regressions.regressions(STORED, STORED["ratios"], STORED["metrics"]) == []


@pytest.mark.parametrize("name", regressions.METRICS)
def test_metrics_may_change_a_little_for_the_worse_and_much_for_the_better(name: str) -> None:
    allowed, value = regressions.METRICS[name], STORED["metrics"][name]
    for change, worse in ((0.9 * allowed, 0), (1.1 * allowed, 1), (-9 * allowed, 0)):
        metrics = STORED["metrics"] | {name: value + change}
        assert len(regressions.regressions(STORED, STORED["ratios"], metrics)) == worse


def test_the_exit_code_counts_regressions_and_a_demo_is_read(tmp_path: Path, monkeypatch, capsys) -> None:
    slower = dict.fromkeys(STORED["ratios"], 99.0)
    monkeypatch.setattr(regressions, "measured", lambda: slower)
    file = tmp_path / "metrics.json"
    nested: dict[str, dict[str, float]] = {}
    for name, value in STORED["metrics"].items():
        outer, inner = name.split(".")
        nested.setdefault(outer, {})[inner] = value
    file.write_text(json.dumps(nested), encoding="utf-8")
    assert regressions.main(["--metrics", str(file)]) == len(slower)
    assert "slow twin" in capsys.readouterr().out
    monkeypatch.setattr(regressions, "measured", lambda: STORED["ratios"])
    assert regressions.main([]) == 0
