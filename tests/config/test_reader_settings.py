"""What all readers can be told stands in one yaml, for new ones, too; what exporters need is found by itself."""

from dataclasses import MISSING, dataclass, fields

from omegaconf import OmegaConf
from support.configs import composed
from support.planted import write_checkpoint
from support.posed_captures import Known, ring, write_transforms

from nerf_lightning.config.exporters import exporter_class, kernel_modules
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.data.captures.reader import CaptureReader
from nerf_lightning.data.readers.transforms import TransformsReader
from nerf_lightning.export.images import ImagesExport
from nerf_lightning.files.folders import conf_folder
from nerf_lightning.nerf.kernels.backends import backend


@dataclass
class NewReader(CaptureReader):
    """Read a format that nobody has seen."""

    def capture(self):
        return TransformsReader(self.root).capture()


YAML = f"""\
defaults: [/scene_defaults@_here_]
_target_: {__name__}.NewReader
name: new
"""


def test_a_new_reader_of_three_lines_can_be_told_what_all_can(tmp_path):
    (tmp_path / "conf" / "scene").mkdir(parents=True)
    (tmp_path / "conf" / "scene" / "new.yaml").write_text(YAML)
    root = write_transforms(tmp_path / "capture", Known(c2w=ring()))
    given = [f"scene.root={root}", f"scene.cache_dir={tmp_path}/cache"]
    found = [f"hydra.searchpath=[file://{tmp_path}/conf]", "scene=new", *given]
    whole, half = (build(composed("train", *found, *more).scene).read() for more in ([], ["scene.downscale=2"]))
    assert half.cameras.width[0] == whole.cameras.width[0] // 2
    assert half.name == "new"


def test_the_yaml_has_the_settings_that_the_class_has():
    settings = {each.name: "???" if each.default is MISSING else each.default for each in fields(CaptureReader)}
    assert OmegaConf.load(conf_folder() / "scene_defaults.yaml") == settings


def test_what_a_run_was_told_is_taken_from_its_checkpoint(tmp_path):
    def of_this(content):
        content["nerf_lightning"]["choices"]["scene"] = "colmap"

    recorded = {"downscale": 2, "root": str(tmp_path), "cache_dir": "/tmp/x"}
    file = write_checkpoint(tmp_path / "a.ckpt", of_this, scene=recorded)
    overrides = scene_overrides(str(file))
    assert {"scene=colmap", "scene.downscale=2", f"scene.root='{tmp_path}'"} <= set(overrides)
    assert not [each for each in overrides if "cache_dir" in each]


def test_an_exporter_is_known_by_its_yaml_and_every_kernel_of_models_and_of_exporters_compiles():
    modules = kernel_modules()
    assert "nerf_lightning.nerf.kernels.march.cpu" in modules
    assert all(backend(module) for module in modules)
    assert exporter_class("images") is ImagesExport
    assert exporter_class("my_own") is None
