"""Types of what the package offers when it is asked for (`__init__.py`)."""

from nerf_lightning.data.captures.in_memory import scene_from_cameras as scene_from_cameras
from nerf_lightning.data.datamodule import RayDataModule as RayDataModule
from nerf_lightning.messages.errors import InputError as InputError
from nerf_lightning.nerf.models.render_image import Picture as Picture
from nerf_lightning.nerf.types.scene import Cameras as Cameras
from nerf_lightning.nerf.types.scene import Scene as Scene
from nerf_lightning.notebook.captures import read as read
from nerf_lightning.notebook.run import build_run as build_run
from nerf_lightning.notebook.trained_model import TrainedModel as TrainedModel
from nerf_lightning.notebook.trained_model import load as load
from nerf_lightning.notebook.trained_run import TrainedRun as TrainedRun
from nerf_lightning.notebook.trained_run import train as train
from nerf_lightning.training.system import RadianceFieldSystem as RadianceFieldSystem

__version__: str
