"""The libraries that meshes need: an optional extra."""

from importlib import import_module
from typing import Any

from nerf_lightning.errors import InputError


def require_library(name: str) -> Any:
    """Return a module of the extra `mesh`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f"Exporting a mesh needs {name.partition('.')[0].replace('skimage', 'scikit-image')}, which is not "
            f"installed or does not load here ({error}). Install it with: pip install 'nerf-lightning[mesh]'"
        ) from error
