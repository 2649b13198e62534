"""What is kept of a composition changes nothing of the next one."""

import subprocess
import sys

from omegaconf import OmegaConf
from support.running import REPOSITORY

from nerf_lightning.config.compose import compose_config

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
