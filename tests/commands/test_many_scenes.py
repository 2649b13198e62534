"""One model for many scenes, from its training to scenes that it has never seen."""

import json

import pytest
import torch
from support.made_once import made_once
from support.resumed import in_process
from support.running import FAST, said, start

PICTURES = ("scene.resolution=16", "scene.num_train=7", "scene.num_val=1", "scene.num_test=1")
MANY = ("scene=many", "scene.variants=1-2", "scene.unseen=201", *PICTURES)
SMALL = (
    "model=view_transformer_tiny", "model.width=8", "model.heads=2", "model.sampler.num_samples=6",
    "model.image_features=4", "model.image_width=4", "model.image_blocks=0", "data.views_per_step=2",
    "data.crop_steps=0", "trainer.precision=32-true", "trainer.num_threads=1",
)  # fmt: skip
FAST_MANY = [*(setting for setting in FAST if not setting.startswith(("model=", "data.crop"))), *MANY, *SMALL]
