"""What a run loads before its first step: nothing heavy that it does not need, the rest without a pause."""

import subprocess
import sys

import pytest

from nerf_lightning.cli import prepare
from nerf_lightning.cli.process import announce_start
from nerf_lightning.config.scene_overrides import UnknownScene


def test_a_config_is_composed_without_torch():
    code = (
        "import sys, types; sys.argv = ['nerf', 'train', 'model=fast']\n"
        "from nerf_lightning.cli.main import main\n"
        "heavy = ('torch', 'lightning', 'numba', 'rich')\n"
        "train = sys.modules['nerf_lightning.commands.train'] = types.ModuleType('train')\n"
        "train.run = lambda config: print(config.seed, [name for name in heavy if name in sys.modules])\n"
        "main()"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "0 []"


# What Lightning brings along of these is Lightning's; nothing of ours may ask for them before there is work for them.
FOR_LATER = ("matplotlib", "scipy", "numba", "llvmlite", "imageio", "sympy", "triton", "torchvision")


@pytest.mark.exhaustive
def test_training_imports_nothing_heavy_beside_lightnings_own():
    code = (
        "import sys, lightning.pytorch\n"
        "known = set(sys.modules)\n"
        "import nerf_lightning.commands.train\n"
        "added = {name.partition('.')[0] for name in set(sys.modules) - known}\n"
        f"print(sorted(added.intersection({FOR_LATER})))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("terminal", "arguments", "lines"),
    [(True, ["seed=1", "-m"], 1), (False, ["seed=1"], 0), (True, ["--cfg", "job"], 0)],
)
def test_a_terminal_is_told_at_once_that_a_command_starts(monkeypatch, capsys, terminal, arguments, lines):
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    announce_start("train", arguments)
    assert capsys.readouterr().err.splitlines() == ["starting nerf train; loading PyTorch takes a few seconds"] * lines


@pytest.fixture(autouse=True)
def _unknown(monkeypatch):
    def unknown(arguments):
        raise UnknownScene("nobody knows it")

    monkeypatch.setattr(prepare, "_eval", unknown)


def test_a_page_goes_without_photographs_and_says_so(caplog):
    typed = ["ckpt=a", "what=page"]
    assert prepare._export(typed) == ["photographs=false", *typed]
    assert caplog.messages == ["what=page does not use photographs: nobody knows it"]
    assert prepare._export(["ckpt=a", "what=cameras"]) == ["ckpt=a", "what=cameras"]
    assert prepare._export(["ckpt=a"]) == ["photographs=false", "ckpt=a"]
    assert prepare._export(["ckpt=a", "what=my_own"])[0] == "photographs=false"
