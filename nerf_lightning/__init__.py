"""nerf_lightning: learn a radiance field from photographs with known cameras, and render new views.

From a notebook: `build_run`, `RadianceFieldSystem` and `RayDataModule` are here, loaded when they are asked for.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_OFFERED = {
    "RadianceFieldSystem": "nerf_lightning.training.system",
    "RayDataModule": "nerf_lightning.data.datamodule",
    "build_run": "nerf_lightning.training.build",
}


def __getattr__(name: str) -> Any:
    """Load what brings torch and Lightning only now: it takes seconds."""
    if name not in _OFFERED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_OFFERED[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_OFFERED]
