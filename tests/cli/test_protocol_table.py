"""The table of `evaluate --protocol all`."""

import pytest

from twofold.cli.protocol_table import networks_asked_for, print_protocols
from twofold.errors import TwofoldError
from twofold.metrics.protocols import METRICS, SETTINGS, UNVERIFIED


def test_weights_need_the_protocols_that_use_them(tmp_path):
    assert networks_asked_for("default", None, False) is None
    for weights, unverified in ((tmp_path, False), (None, True)):
        with pytest.raises(TwofoldError, match="need --protocol all"):
            networks_asked_for("default", weights, unverified)
    with pytest.raises(TwofoldError, match="is not a folder"):
        networks_asked_for("all", tmp_path / "nowhere", False)
    assert networks_asked_for("all", tmp_path, False).folder == tmp_path


def test_table_has_a_row_a_setting_and_marks_unverified_weights(capsys):
    names = [f"{name}_{metric}" for name in SETTINGS for metric in METRICS]
    values = dict.fromkeys([*names, "fid", "ms_ssim", "gradient_error"], 12.5) | {"kid_x1000": "n/a (put X in Y)"}
    told = {name: "as it is" + (UNVERIFIED if "lpips" in name else "") for name in values}
    print_protocols("novel_pose_protocols", values | {"protocol": told})
    captured = capsys.readouterr()
    printed = captured.out + captured.err
    assert all(name in printed for name in SETTINGS)
    assert printed.count("12.5*") == len(SETTINGS)
    assert "n/a (put X in Y)" in printed
    assert "not the published ones" in printed
