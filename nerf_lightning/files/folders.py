"""Where the yaml files are, and where the program keeps what it can make again."""

import os
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def conf_folder() -> Path:
    """Return where the yaml files are: inside the package when installed as a wheel, beside it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def default_folder(kind: str) -> Path:
    """Return $NERF_LIGHTNING_CACHE/kind, else nerf_lightning/kind in $XDG_CACHE_HOME or ~/.cache."""
    chosen = os.environ.get("NERF_LIGHTNING_CACHE")
    if chosen:
        return Path(chosen).expanduser() / kind
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "nerf_lightning" / kind
