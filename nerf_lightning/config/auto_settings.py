"""What `nerf train` chooses for a scene if the user does not: time, and what comes before and after.

The model is chosen in `model_for_scene.py`. Each choice is logged in one line, with the setting that changes it.
"""

import copy
import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.config.compose import Composed
from nerf_lightning.config.model_for_scene import (
    IN_A_BOX,
    LARGE,
    LARGE_CELLS,
    PHOTOGRAPHS,
    grid_for,
    has_large_pictures,
    model_for,
)
from nerf_lightning.config.overrides import SWITCH, key_of, leaves
from nerf_lightning.files.folders import option_names
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.corrections.exposure import Exposure
from nerf_lightning.nerf.types.scene import Scene

AUTO = "auto"
EXPOSURE = f"{Exposure.__module__}.{Exposure.__name__}"
CPU_SECONDS = 300
"""Seconds of training on a CPU if no length is given; with cameras, evaluation and film ten minutes on two cores."""
PAGE_SECONDS, PAGE_FROM = 100, 100
"""Seconds of CPU_SECONDS that are left for the page of a scene; the shortest training after which it is written."""
SHORT_SECONDS, SHORT_GPU_SECONDS = 100, 10
"""In shorter runs, more and cheaper steps are worth more than finer grids."""
FEW_PHOTOGRAPHS = 30
"""Training views; fewer do not constrain a finer grid, unless distances are known."""
TABLE_SIZES = {512: 18, 1024: 18, 2048: 19, 4096: 20}
"""log2 of a hash table's entries, by finest resolution.

After 300 s the fox has 32.20 dB with a resolution of 2048 and 2^19 entries, and 32.09 dB with 1024 and 2^18.
"""

RENDERED_PER_SECOND = 60_000
"""Rays that fast_proposal renders on two cores; evaluation takes as many as this allows in half of the budget."""
FEWEST_EVALUATED = 3

LONGEST_SETTING, GPU_LONGEST = "scene.longest", 1600
STEPS_SETTING = "model.levels.fine.sampler.num_steps"
RAYS_SETTING = "model.subpixels"
GRID_SETTINGS = {"encoder", "encoder.max_resolution", "encoder.log2_table_size"}
"""Settings that choose the grid if the user types one of them."""
CHOSEN_NUMBERS = (
    *("encoder.max_resolution", "encoder.log2_table_size", "field.color_layers"),
    *(STEPS_SETTING, RAYS_SETTING, "data.batch_rays", "data.sample_budget"),
)
"""What model=auto may set besides the model and the loss."""
SHORT_STEPS, LARGE_STEPS, LARGE_TABLE = 576, 1024, 20
"""For large pictures of a scene in a box: steps across it, and log2 of a hash table's entries.

After 300 s, Lego (800 x 800, 12 test views) has 33.82 dB with 1024 steps, and 33.53 dB with 576 (docs/defaults.md);
after 100 s 31.83 dB with 576, and 31.19 dB with 384.
"""
GPU_BATCHES = {
    "fast": {"data.batch_rays": 65_536, "data.sample_budget": 1 << 18},
    LARGE: {"data.batch_rays": 65_536, "data.sample_budget": 1 << 18},
    "fast_proposal": {"data.batch_rays": 4_096},
}
"""About 2^18 samples per step, as in instant-ngp: on a GPU, a smaller step takes as long."""

log = logging.getLogger(__name__)


def with_longest(requested: Composed, on_gpu: bool) -> Composed:
    """Return the config with the size of photographs that a GPU has time for, unless the user has typed one."""
    begun = None if requested.resumed is None else _number(requested.resumed, LONGEST_SETTING)
    if "longest" not in requested.config.scene or LONGEST_SETTING in requested.typed or not (begun or on_gpu):
        return requested
    return requested.with_setting(LONGEST_SETTING, int(begun or GPU_LONGEST))


def takes_distances(requested: Composed, scene: Scene) -> bool:
    """Return whether a run learns from known distances: with loss=depth, which model=auto chooses for photographs."""
    if "loss" in requested.typed or requested.choices.get("model") != AUTO:
        return requested.choices.get("loss") == "depth"
    return model_for(scene)[0] == PHOTOGRAPHS


def resolve_auto(requested: Composed, scene: Scene, device_type: str = "cpu") -> Composed:
    """Return the config with every choice made for its scene.

    A resumed run keeps what was chosen for it, on any device and for any length.

    The length of a run is what is typed: `trainer.max_steps` or `trainer.max_epochs`, `budget.seconds`, or the shorter
    of both. Without either, a run takes CPU_SECONDS on a CPU, and the model's published steps on other devices.

    Raises:
        InputError: a setting that is neither a value nor auto.
    """
    config, resumed = requested.config, requested.resumed
    is_capture = config.scene.get("root", "") != "" and scene.capture_of is None  # of an archive it is empty
    seconds = config.budget.seconds
    if seconds == AUTO:
        has_steps = config.trainer.max_steps is not None or config.trainer.max_epochs is not None
        seconds = CPU_SECONDS if device_type == "cpu" and not has_steps else None
        if resumed is not None and not has_steps:
            seconds = _number(resumed, "budget.seconds")
    fitted = fit_model(requested, scene, device_type == "cuda", seconds)
    config = copy.deepcopy(fitted.config)
    _settle(config, "doctor", is_capture)
    _settle(config.final, "report", is_capture and "report" in option_names("final"))
    writes_page = is_capture and _writes_page(fitted, seconds)
    if writes_page:
        if config.budget.seconds == AUTO and resumed is None:
            seconds = CPU_SECONDS - PAGE_SECONDS
        log.info("page: after %g s of training, export/page.html is written (final.page=false skips it)", seconds)
    if not isinstance(config.final.get("page"), DictConfig):  # else the exporter's settings are typed
        _settle(config.final, "page", writes_page)
    if config.budget.seconds == AUTO:
        config.budget.seconds = seconds
    if config.budget.seconds is None and config.trainer.max_steps is None and config.trainer.max_epochs is None:
        begun = None if resumed is None else _number(resumed, "trainer.max_steps")
        config.trainer.max_steps = begun or config.trainer.published_steps
    if config.evaluation.max_views == AUTO:
        if resumed is not None:
            config.evaluation.max_views = _number(resumed, "evaluation.max_views")
        else:
            config.evaluation.max_views = _views_for(scene, config) if device_type == "cpu" else None
    return replace(fitted, config=config)


def _writes_page(requested: Composed, seconds: int | float | None) -> bool:
    """Return whether the page of a capture is written although it was not requested."""
    photographs = requested.choices.get("model") == PHOTOGRAPHS and requested.config.final.get("page") == AUTO
    return photographs and seconds is not None and seconds >= PAGE_FROM and "page" in option_names("what")


def _views_for(scene: Scene, config: DictConfig) -> int | None:
    """Return how many held-out views a CPU evaluates within half of the training time, and log it; None: all."""
    if config.budget.seconds is None or not config.final.evaluate:
        return None
    views = list(scene.splits.get(config.evaluation.split, ()))
    pixels = scene.cameras.width[views].double() * scene.cameras.height[views].double()
    affordable = config.budget.seconds / 2 * RENDERED_PER_SECOND
    if float(pixels.sum()) <= affordable:
        return None
    count = min(len(views), max(FEWEST_EVALUATED, int(affordable / float(pixels.mean()))))
    log.info(
        "evaluation: %d of %d %s views, because all take long (evaluation.max_views=null takes them)",
        count,
        len(views),
        config.evaluation.split,
    )
    return count


def _number(config: Mapping[str, Any], key: str) -> int | float | None:
    """Return a positive number of an untrusted config; None if there is none."""
    value = leaves(config).get(key)
    return value if isinstance(value, int | float) and value > 0 else None


def fit_model(requested: Composed, scene: Scene, on_gpu: bool, seconds: int | float | None = None) -> Composed:
    """Return a config with what model=auto means for a scene, if it was chosen; what the user has typed stays.

    `seconds` of training; None: unknown.
    """
    if requested.choices.get("model") != AUTO:
        return requested
    typed, resumed = requested.typed, requested.resumed
    fitted = requested.composed_with(
        _for_scene(scene, typed, on_gpu, seconds) if resumed is None else _as_begun(scene, typed, resumed)
    )
    for section in {"paths", "scene", "final"} & requested.config.keys():  # settled by now
        fitted.config[section] = requested.config[section]
    return fitted


def chosen_numbers(config: Mapping[str, Any]) -> list[str]:
    """Return the overrides that repeat the numbers that model=auto has chosen for a run, by the run's config.

    Missing sections and values that are not integers are skipped: the config is untrusted.
    """
    values = leaves(config)
    return [f"{key}={values[key]}" for key in CHOSEN_NUMBERS if type(values.get(key)) is int]


def _for_scene(scene: Scene, typed: set[str], on_gpu: bool, seconds: int | float | None) -> list[str]:
    """Return the model that suits a scene, with what suits the model, and log it."""
    name, reason = model_for(scene, on_gpu)
    log.info("model: %s, because %s (choose another with model=NAME)", name, reason)
    suited = [f"model={name}"]
    short = seconds is not None and seconds < (SHORT_GPU_SECONDS if on_gpu else SHORT_SECONDS)
    if name == IN_A_BOX and not on_gpu:
        suited += _for_large_pictures(typed, short) if has_large_pictures(scene) else []
        suited += [] if short else _rays(typed)
    if name == PHOTOGRAPHS:
        suited += [*_grid_for_photographs(scene, typed, short), *_loss_for(scene, typed)]
    return suited + (_for_gpu(name, typed) if on_gpu else [])


def _as_begun(scene: Scene, typed: set[str], resumed: Mapping[str, Any]) -> list[str]:
    """Return the model of a run that is resumed, and the numbers that were chosen for it."""
    name = model_for(scene)[0]
    numbers = [each for each in chosen_numbers(resumed) if key_of(each) not in typed]
    if has_large_pictures(scene) and f"data.batch_rays={GPU_BATCHES[LARGE]['data.batch_rays']}" in numbers:
        name = LARGE
    loss = _loss_for(scene, typed) if name == PHOTOGRAPHS else []
    return [f"model={name}", *loss, *numbers]


def _for_large_pictures(typed: set[str], short: bool) -> list[str]:
    """Return the steps, grid and layers that suit large pictures of a scene in a box; what the user has typed stays."""
    suited = []
    if STEPS_SETTING not in typed:
        steps = SHORT_STEPS if short else LARGE_STEPS
        log.info("steps: %d across the box, because the pictures are large (%s=N)", steps, STEPS_SETTING)
        suited.append(f"{STEPS_SETTING}={steps}")
    if not short and not typed & GRID_SETTINGS:
        suited += _grid(LARGE_CELLS, LARGE_TABLE, "because the pictures are large")
    if not short and not typed & {"field", "field.color_layers"}:
        log.info("field: two color layers, because the pictures are large (field.color_layers=1 is faster)")
        suited.append("field.color_layers=2")
    return suited


def _rays(typed: set[str]) -> list[str]:
    """Return several rays for each pixel, unless the user has typed their number.

    After 100 s, Lego at 200 x 200 has 34.58 dB with 2 x 2 rays and 33.64 dB with one; at 800 x 800, it has 33.90 and
    33.76 dB after 300 s, and 35.13 and 34.79 dB after 1200 s.
    """
    if {RAYS_SETTING, "loss"} & typed:
        return []
    log.info(
        "rays: 2 x 2 through each pixel at the end of the run, for sharper pictures (%s=1 renders four times as fast)",
        RAYS_SETTING,
    )
    return [f"{RAYS_SETTING}=2"]


def _grid(resolution: int, table: int, cause: str) -> list[str]:
    """Return the overrides for a hash grid, and log why."""
    log.info(
        "encoder: %d cells per side, %s, and hash tables of 2^%d entries (encoder.max_resolution=N, "
        "encoder.log2_table_size=N)",
        resolution,
        cause,
        table,
    )
    return [f"encoder.max_resolution={resolution}", f"encoder.log2_table_size={table}"]


def _grid_for_photographs(scene: Scene, typed: set[str], short: bool) -> list[str]:
    """Return the grid that suits photographs; what the user has typed stays. `short`: whether the run is short."""
    if GRID_SETTINGS & typed:
        return []
    few = scene.depths is None and len(scene.splits["train"]) < FEW_PHOTOGRAPHS
    pixels = grid_for(scene)
    resolution = max(pixels // 2, 512) if short or few else pixels
    cause = "the run is short" if short else "there are few photographs and no known distances"
    wide = "as small as the pixels" if resolution == pixels else f"twice as wide as the pixels because {cause}"
    return _grid(resolution, 18 if short else TABLE_SIZES[resolution], wide)


def _loss_for(scene: Scene, typed: set[str]) -> list[str]:
    """Return the loss that suits photographs, unless the user has typed one."""
    if scene.depths is None or "loss" in typed:
        return []
    log.info(
        "loss: depth, since the distance of %s pixels is known (loss=proposal ignores it)", f"{len(scene.depths):,}"
    )
    return ["loss=depth"]


def _for_gpu(model: str, typed: set[str]) -> list[str]:
    """Return the batches of a model on a GPU; what the user has typed stays."""
    larger = [f"{key}={value}" for key, value in GPU_BATCHES[model].items() if key not in typed]
    if larger:
        log.info("batches: about 2^18 samples a step, as suits a GPU (%s)", ", ".join(larger))
    return larger


def resolve_correction(requested: Composed, finding: str | None = None) -> Composed:
    """Return the config with the correction that the photographs need, unless the user has typed one.

    `finding` is what the doctor says of their exposure; None: nothing. A resumed run keeps its own.
    """
    if requested.choices.get("correction") != AUTO:
        return requested
    if requested.resumed is None:
        cause = finding
    else:
        section = requested.resumed.get("correction")
        kept = isinstance(section, dict) and section.get("_target_") == EXPOSURE
        cause = "the run began with it" if kept else None
    name = "exposure" if cause else "none"
    if cause:
        log.info("correction: exposure, since %s (correction=none leaves colors unchanged)", cause)
        exposure = requested.composed_with(["correction=exposure"]).config.correction
        requested = requested.with_setting("correction", exposure)
    return replace(requested, choices={**requested.choices, "correction": name})


def _settle(section: DictConfig, key: str, value: bool) -> None:
    meant = {AUTO: value, **SWITCH}
    if section.get(key) not in meant:
        raise InputError(f"{key}={section[key]} is not valid: it must be on, off or auto.")
    section[key] = meant[section.get(key)]
