"""Compose a command's config once a call: Hydra composes it a first time only to look for `hydra.mode`."""

from hydra._internal.hydra import Hydra
from hydra.types import RunMode

composed_mode = Hydra.get_mode


def mode_as_typed(hydra: Hydra, config_name: str | None, overrides: list[str]) -> RunMode | None:
    """Return what Hydra's own `get_mode` does: our conf/ sets no mode, so that only an override could."""
    return composed_mode(hydra, config_name, overrides) if "hydra.mode" in str(overrides) else None
