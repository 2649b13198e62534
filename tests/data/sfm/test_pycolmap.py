"""What pycolmap does to the process that loads it, and what it must not be asked for."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from nerf_lightning.data.sfm.find_cameras import find_cameras
from nerf_lightning.data.sfm.photograph_folder import find_photographs
from nerf_lightning.data.sfm.reconstruction import NothingFoundError
from nerf_lightning.data.sfm.settings import SfmSettings

pycolmap = pytest.importorskip("pycolmap")

SAVE_PNG = """
import io
import nerf_lightning
import pycolmap
from PIL import Image
Image.effect_noise((640, 480), 50).save(io.BytesIO(), "PNG")
"""


def test_pictures_are_saved_after_it_is_loaded():
    result = subprocess.run([sys.executable, "-c", SAVE_PNG], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr


def test_learned_features_are_never_asked_for_whatever_its_defaults(tmp_path, monkeypatch):
    """A wheel without ONNX would end the whole process."""
    made = []

    def by_default(options, learned):
        def make():
            made.append(options())
            made[-1].type = learned
            return made[-1]

        monkeypatch.setattr(pycolmap, options.__name__, make)

    by_default(pycolmap.FeatureExtractionOptions, pycolmap.FeatureExtractorType.ALIKED_N32)
    by_default(pycolmap.FeatureMatchingOptions, pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE)
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 255, (80, 96, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{number}.png")
    settings = SfmSettings(num_features=600, num_threads=1)
    with pytest.raises(NothingFoundError):
        find_cameras(find_photographs(tmp_path), tmp_path, tmp_path, tmp_path / "sparse", settings)
    assert [options.type.name for options in made] == ["SIFT", "SIFT_BRUTEFORCE"]
