"""nerf_lightning: train radiance fields from photographs and render new views.

From Python: `read` a capture, `train` a model, `load` a trained one; step by step, or with Lightning's own Trainer:
`build_run`, `RadianceFieldSystem` and `RayDataModule`. They are imported on first use; `__init__.pyi` has all names.
"""

import importlib
import re
import sys
import zlib  # noqa: F401  before pycolmap, which brings another that Pillow's PNGs would be mixed with
from collections.abc import Callable
from pathlib import Path
from typing import Any

__version__ = "1.0.0"


def lazily(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package that offers what the stub next to its `file` imports.

    What brings torch, numba and Lightning takes seconds, so that it is imported only when it is asked for.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    offered = {name: module for module, name in re.findall(r"^from (\S+) import (\w+) as", stub, re.MULTILINE)}

    def load(name: str) -> Any:
        if name not in offered:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(offered[name]), name)

    return load, lambda: [*vars(sys.modules[package]), *offered]


__getattr__, __dir__ = lazily(__name__, __file__)
