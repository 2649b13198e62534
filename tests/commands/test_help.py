"""`nerf help` and `nerf COMMAND --help`: answered without torch, Lightning and Hydra."""

import subprocess
import sys

import pytest
from support.running import said

HEAVY = "('torch', 'hydra', 'omegaconf', 'numpy', 'lightning')"


def test_explanations_import_nothing_heavy():
    asked = ("--help", "train --help", "help scene=colmap", "help optimizer.lr", "completion candidates ''")
    code = (
        f"import shlex, sys; from nerf_lightning.cli.main import main\n"
        f"for words in {asked}: sys.argv = ['nerf', *shlex.split(words)]; main()\n"
        f"print([m for m in {HEAVY} if m in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"


def test_the_help_of_a_setting_or_a_part_tells_values_meanings_and_what_they_take(nerf):
    result = nerf("help", "data.sample_budget")
    assert result.code == 0
    assert result.out.startswith("data.sample_budget=65536\n")
    assert "The target number of visible samples per step" in " ".join(result.out.split())
    assert "Takes int | null." in result.out
    assert "model=fast_large 262144" in " ".join(result.out.split())
    result = nerf("train", "--help", "scene=colmap")
    assert result.out == nerf("help", "scene=colmap").out == nerf("help", "train", "scene=colmap").out
    assert "A COLMAP reconstruction" in result.out
    assert "scene.images=null\n" in result.out
    assert "scene.masks_keep=white\n" in result.out
    assert "Takes 'white' | 'black'." in result.out
    assert "what.depth=" in nerf("help", "what.depth").out
    assert nerf("help", "export").out == nerf("export", "--help").out
    assert "scene (default the run's)" in nerf("eval", "--help").out
    told = " ".join(nerf("help", "scene.near").out.split())
    assert "in the capture's units; null: from the capture." in told
    assert "With scene=auto, scene=blender" in told


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("fog", "\n  * Fog disappears last"),
        ("foggy", "\n  * Fog disappears last"),
        ("crash", "Training stopped, crashed, or was killed"),
        ("ssh", "ssh -L 8080:127.0.0.1:8080 MACHINE"),
        ("film", "nerf render  "),
        ("blurry", "Blurred"),
        ("gray", "The picture is gray"),
        ("gpu", "\n  trainer=gpu  "),
        ("learning rate", "  optimizer.lr  "),
        ("batch size", "  data.batch_rays  "),
        ("out of memory", "prints before training how much memory"),
    ],
)
def test_words_that_name_nothing_are_looked_for_in_meanings_and_symptoms(nerf, words, found):
    assert found in nerf("help", *words.split()).out


def test_a_setting_that_training_lacks_is_told_for_each_command(nerf):
    told = nerf("help", "ckpt").out
    assert "nerf eval: ckpt=(required)\n    The run folder or checkpoint to evaluate." in told
    assert "nerf render: ckpt=(required)\n    The run folder or checkpoint to render, or several" in told


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["help", "trainer.max_stpes"], "Did you mean trainer.max_steps?"),
        (["help", "model=fats"], "Did you mean model=fast?"),
        (["render", "--help", "pth"], "Did you mean path?"),
        (["helpp"], "Did you mean help?"),
        (["help", "add", "a", "lens"], "Nothing in the help has all these words: add a lens. Use fewer"),
        (["render", "--help", "optimizer"], "nerf render has no setting or group optimizer."),
    ],
)
def test_whatever_is_mistyped_or_not_there_is_told(nerf, words, hint):
    said(nerf(*words), hint)
