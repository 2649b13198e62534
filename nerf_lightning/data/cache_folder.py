"""Where the program keeps what it can make again."""

import os
from pathlib import Path


def default_folder(kind: str) -> Path:
    """Return $NERF_LIGHTNING_CACHE/kind, else nerf_lightning/kind in $XDG_CACHE_HOME or ~/.cache."""
    chosen = os.environ.get("NERF_LIGHTNING_CACHE")
    if chosen:
        return Path(chosen).expanduser() / kind
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "nerf_lightning" / kind
