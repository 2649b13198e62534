"""Where the yaml files are, and where the program keeps what it can make again."""

import os
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def conf_folder() -> Path:
    """Return where the yaml files are: inside the package when installed as a wheel, beside it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def conf_folders() -> list[Path]:
    """Return every folder of yaml files: the program's own, then each extension's (`extensions/NAME/conf`)."""
    return [conf_folder(), *sorted((PACKAGE / "extensions").glob("*/conf"))]


def conf_file(name: str) -> Path:
    """Return the yaml file of a name such as `scene/bricks`, the first on the search path; it may not exist."""
    files = [folder / f"{name}.yaml" for folder in conf_folders()]
    return next((file for file in files if file.is_file()), files[0])


def option_names(group: str) -> list[str]:
    """Return the options of a group (`encoder`, or `encoder@direction_encoder`), those of extensions included."""
    name = group.partition("@")[0]
    return sorted({file.stem for folder in conf_folders() for file in (folder / name).glob("*.yaml")})


def default_folder(kind: str) -> Path:
    """Return $NERF_LIGHTNING_CACHE/kind, else nerf_lightning/kind in $XDG_CACHE_HOME or ~/.cache."""
    chosen = os.environ.get("NERF_LIGHTNING_CACHE")
    if chosen:
        return Path(chosen).expanduser() / kind
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(home).expanduser() / "nerf_lightning" / kind
