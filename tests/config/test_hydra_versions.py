"""What Hydra 1.4 is told of classes; 1.3 knows no such list."""

import pytest
import torch
from hydra.errors import InstantiationException

from nerf_lightning.checkpoints.trusted_classes import names_of
from nerf_lightning.config.hydra_versions import IS_1_3, instantiate

ENCODER = {"_target_": "nerf_lightning.nerf.encoders.frequency.FrequencyEncoder", "num_frequencies": 2}
LINEAR = {"_target_": "torch.nn.Linear", "in_features": 1, "out_features": 2}  # defined in another module


@pytest.mark.skipif(IS_1_3, reason="Hydra 1.3 has no whitelist")
def test_hydra_builds_from_a_file_only_what_lies_below_trusted_names():
    assert instantiate(ENCODER, names_of([])).out_dim == instantiate(ENCODER).out_dim
    assert isinstance(instantiate(LINEAR, names_of(["torch.nn"])), torch.nn.Linear)
    with pytest.raises(InstantiationException, match="whitelist"):
        instantiate(LINEAR, names_of(["mine"]))


def test_a_config_of_ones_own_may_name_anything():
    assert isinstance(instantiate(LINEAR), torch.nn.Linear)
