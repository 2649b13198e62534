"""Where the yaml files are."""

from pathlib import Path

PACKAGE = Path(__file__).parent


def conf_folder() -> Path:
    """Return where the yaml files are: inside the package when installed as a wheel, beside it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"
