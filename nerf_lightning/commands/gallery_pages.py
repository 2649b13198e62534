"""The pages of runs that a gallery is to link and that have none yet, each made as `nerf export` makes one."""

from collections.abc import Callable
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from nerf_lightning.config.compose import composed_job
from nerf_lightning.config.overrides import quoted
from nerf_lightning.config.scene_overrides import UnknownScene, scene_overrides
from nerf_lightning.export.page import Quality
from nerf_lightning.messages.errors import InputError

# Of what was given for the gallery, what holds for each page.
PASSED_ON = ("trainer", "budgets.")


def page_maker(export_one: Callable[..., list[Path]]) -> Callable[[Path, Quality], Path]:
    """Return what makes the page of a run in its `export` folder, by what exports one checkpoint."""
    passed_on = [each for each in HydraConfig.get().overrides.task if each.startswith(PASSED_ON)]

    def page_of(run: Path, quality: Quality) -> Path:
        try:
            scene = scene_overrides(str(run))
        except UnknownScene:  # its page is without photographs
            scene = ["photographs=false"]
        given = [f"ckpt={quoted(str(run))}", "what=page", f"what.quality={quality}", *passed_on]
        try:
            with composed_job("export", [*scene, *given]) as config:
                (page,) = export_one(config)
        except OSError as error:
            raise InputError(f"its page could not be written: {error}") from error
        return page

    return page_of
