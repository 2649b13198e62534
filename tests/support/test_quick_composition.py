"""What is kept of a composition changes nothing of the next one."""

import subprocess
import sys

import pytest
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf
from support import quick_composition
from support.running import REPOSITORY

from nerf_lightning.config.compose import compose_config
from nerf_lightning.messages.errors import InputError

LOADED = quick_composition.loaded
PICKED = ("model=fast_small", "scene=npz", "encoder.num_levels=3", "+callbacks.more.a=[1, 2]", "~callbacks.monitor")
ALONE = """
import sys
from omegaconf import OmegaConf
from nerf_lightning.config.compose import compose_config
asked = compose_config("train", sys.argv[1:])
print(OmegaConf.to_yaml(asked.config), asked.choices, sep="")
"""


def test_a_config_is_what_hydra_composes_alone():
    alone = subprocess.run([sys.executable, "-c", ALONE, *PICKED], capture_output=True, text=True, cwd=REPOSITORY)
    for _ in range(2):
        asked = compose_config("train", PICKED)
        assert f"{OmegaConf.to_yaml(asked.config)}{asked.choices}\n" == alone.stdout, alone.stderr
        asked.config.encoder.num_levels = 7  # of one's own


def test_other_values_and_mistakes_are_seen_each_time():
    for lr in (1.0, 2.0):
        assert compose_config("train", ["model=nerf_tiny", f"optimizer.lr={lr}"]).config.optimizer.lr == lr
    for wrong in ("model=nobody", "encoder.nothing=3", "+encoder@nowhere.at.all=frequency"):
        for _ in range(2):
            with pytest.raises((InputError, ConfigCompositionException)):
                compose_config("train", ["model=nerf_tiny", wrong, "nothing=3"])


def test_folders_of_others_are_read_anew(tmp_path):
    (tmp_path / "experiment").mkdir()
    for steps in (3, 4):
        content = f"# @package _global_\ntrainer:\n  max_steps: {steps}\n"
        (tmp_path / "experiment" / "mine.yaml").write_text(content)
        config = compose_config("train", [f"hydra.searchpath=['file://{tmp_path}']", "experiment=mine"]).config
        assert config.trainer.max_steps == steps
