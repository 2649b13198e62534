"""Folders of YAML files, and of caches."""

import os
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def conf_folder() -> Path:
    """Return the folder of the YAML files: inside the package if installed as a wheel, next to it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def conf_folders() -> list[Path]:
    """Return every folder of YAML files: the program's own, then each extension's (`extensions/NAME/conf`)."""
    return [conf_folder(), *sorted((PACKAGE / "extensions").glob("*/conf"))]


def conf_file(name: str) -> Path:
    """Return the YAML file of a name such as `scene/bricks`, the first on the search path; it may not exist."""
    files = [folder / f"{name}.yaml" for folder in conf_folders()]
    return next((file for file in files if file.is_file()), files[0])


def option_names(group: str) -> list[str]:
    """Return the options of a group (`encoder`, or `encoder@direction_encoder`), including those of extensions."""
    name = group.partition("@")[0]
    return sorted({file.stem for folder in conf_folders() for file in (folder / name).glob("*.yaml")})


def default_folder(kind: str) -> Path:
    """Return $NERF_LIGHTNING_CACHE/kind, else nerf_lightning/kind in $XDG_CACHE_HOME or ~/.cache."""
    chosen = os.environ.get("NERF_LIGHTNING_CACHE")
    if chosen:
        return Path(chosen).expanduser() / kind
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "nerf_lightning" / kind
