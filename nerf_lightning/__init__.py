"""nerf_lightning: learn a radiance field from photographs with known cameras, and render new views.

From Python: `read` a capture, `load` a trained model, `train` one; with Lightning's own Trainer: `build_run`,
`RadianceFieldSystem` and `RayDataModule`. They are loaded when they are asked for; `__init__.pyi` has their types.
"""

import importlib
import zlib  # noqa: F401  before pycolmap, which brings another that Pillow's PNGs would be mixed with
from typing import Any

__version__ = "1.0.0"

_OFFERED = {
    "Cameras": "nerf_lightning.nerf.types.scene",
    "InputError": "nerf_lightning.messages.errors",
    "Picture": "nerf_lightning.nerf.models.render_image",
    "RadianceFieldSystem": "nerf_lightning.training.system",
    "RayDataModule": "nerf_lightning.data.datamodule",
    "Scene": "nerf_lightning.nerf.types.scene",
    "TrainedModel": "nerf_lightning.notebook.trained_model",
    "TrainedRun": "nerf_lightning.notebook.trained_run",
    "build_run": "nerf_lightning.notebook.run",
    "load": "nerf_lightning.notebook.trained_model",
    "read": "nerf_lightning.notebook.captures",
    "train": "nerf_lightning.notebook.trained_run",
}


def __getattr__(name: str) -> Any:
    """Load what brings torch and Lightning only now: it takes seconds."""
    if name not in _OFFERED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_OFFERED[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_OFFERED]
