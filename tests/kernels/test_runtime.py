import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from twofold.errors import TwofoldError
from twofold.kernels.runtime import compiled_methods


class Doubler:
    """Has a method to compile."""

    def double(self, x: float) -> float:
        return 2 * x


def test_methods_run_compiled_within_the_block_and_only_there(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda method, dynamic: lambda x: (method(x), dynamic))
    one, other = Doubler(), Doubler()
    with compiled_methods(one, ["double"]) as some:
        assert some
        assert one.double(2.0) == (4.0, True)
        assert other.double(2.0) == 4.0
    assert one.double(2.0) == 4.0
    with compiled_methods(one, []) as some:
        assert not some


def test_a_compiler_that_fails_is_told_in_one_sentence(monkeypatch):
    failure = type("InductorError", (RuntimeError,), {"__module__": "torch._inductor.exc"})
    monkeypatch.setattr(torch, "compile", lambda method, dynamic: method)
    one = Doubler()
    with (
        pytest.raises(TwofoldError, match=r"does not work here \(no C\+\+\); install") as error,
        compiled_methods(one, ["double"]),
    ):
        raise failure("no C++\nand much more")
    assert "\n" not in str(error.value)
    assert not vars(one)


def test_other_faults_pass_as_they_are(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda method, dynamic: method)
    with pytest.raises(RuntimeError, match="mine"), compiled_methods(Doubler(), ["double"]):
        raise RuntimeError("mine")


@pytest.mark.parametrize(("given", "before", "expected"), [
    (None, "", "PASSIVE"), ("ACTIVE", "", "ACTIVE"), (None, "import torch", None),
])  # fmt: skip
def test_waiting_threads_give_up_their_core_unless_told_otherwise_or_too_late(given, before, expected):
    code = f"import os\n{before}\nfrom twofold.kernels.runtime import tune_process\ntune_process()\n"
    code += "print(os.environ.get('OMP_WAIT_POLICY'))"
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(expected)


@pytest.mark.parametrize("part", ["common", "step", "rendering", "quality"])
def test_benchmarks_tell_waiting_threads_to_give_up_their_core_before_torch_is_there(part):
    code = f"""
import os, sys
class Watch:
    def find_spec(self, name, *_):
        if name == "torch":
            print(os.environ.get("OMP_WAIT_POLICY")); sys.stdout.flush(); os._exit(0)
sys.meta_path.insert(0, Watch())
import benchmarks.{part}
"""
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    root = Path(__file__).resolve().parents[2]
    environment["PYTHONPATH"] = os.pathsep.join([str(root), environment.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "PASSIVE"


def test_the_command_line_loads_torch_only_after_it_is_told_how_to_wait():
    code = "import sys, twofold.cli.main; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
