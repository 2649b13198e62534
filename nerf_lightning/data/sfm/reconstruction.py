"""Structure from motion on the CPU with pycolmap: photographs to cameras, poses and points.

The method is COLMAP's (Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016): SIFT features, matching
and verification of pairs, incremental registration of photographs, bundle adjustment.

What is said if photographs are left out, and from how many on: `remarks` and ENOUGH in `find_poses.py`.
How many features, and which mapper: `attempts` in `settings.py`.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from nerf_lightning.data.sfm.image_pairs import image_pairs, tiles_of
from nerf_lightning.data.sfm.panoramas import lens_of, verification_of
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.data.sfm.settings import FEATURES, MAPPING, MATCHING, Attempt, CameraMode, SfmSettings
from nerf_lightning.files.made_folders import make_folder
from nerf_lightning.messages.errors import InputError, require_extra
from nerf_lightning.messages.escaping import listed

Report = Callable[[str, float], None]


class NothingFoundError(InputError):
    """No camera of the photographs could be placed; `cause` completes "the pictures ..."."""

    def __init__(self, message: str, cause: str):
        super().__init__(message)
        self.cause = cause


OF_ONE_PHOTOGRAPH = "SIMPLE_RADIAL"
# A model of fewer than three photographs is useless; COLMAP would discard those of fewer than ten.
FEWEST_REGISTERED = 3
FEWEST_POINTS = 30
"""Minimum number per photograph: with fewer, GLOMAP places it anywhere. COLMAP's own mapper requires as many."""
LEAST_ROOM = 1 << 20
"""Bytes; an empty database takes less."""
WITHOUT_DEPTH = "show the same details without depth, all from one position or of one flat surface"
"""Why nothing was found, if it applies to more than half of the compared pairs."""


@dataclass(frozen=True)
class SparseModel:
    """A summary of the result."""

    registered: tuple[str, ...]
    left_out: tuple[str, ...]
    disconnected: tuple[str, ...]
    """Left-out photographs that were registered only with each other, such as those of another place."""
    num_points: int
    num_cameras: int
    reprojection_error: float
    """Mean reprojection error of the points in pixels."""


def require_pycolmap() -> Any:
    """Return pycolmap, or report how to install it."""
    return require_extra("pycolmap", "colmap", "Finding camera poses")


def reconstruct(
    photographs: list[FoundPhotograph],
    folder: Path,
    work: Path,
    settings: SfmSettings,
    attempt: Attempt,
    report: Report = lambda stage, fraction: None,
) -> list[Any]:
    """Return COLMAP's models of photographs, the largest first: photographs of several places yield several.

    Args:
        photographs: of one kind, in the order in which they were taken.
        folder: contains the upright pictures under the photographs' names.
        work: a folder for databases and lists; features that an earlier attempt left there are reused.
        settings: of structure from motion.
        attempt: the features and the mapper.
        report: called with a stage of `stage_costs` and its progress from 0 to 1.

    Raises:
        InputError: pycolmap is missing or does not support panoramas, or one camera has photographs of several sizes.
    """
    colmap = require_pycolmap()
    lens = lens_of(colmap, photographs, settings.camera_model)
    groups = _camera_groups(photographs, settings.camera_mode)
    database = work / attempt.database
    with _quiet(colmap), _room_asked_for(work):
        colmap.set_random_seed(settings.seed)
        if not database.exists():
            _find_features(colmap, database, folder, groups, lens, settings, attempt, report)
            _match(colmap, database, photographs, work / "pairs.txt", settings, report)
        models = work / f"{attempt.database}_{attempt.mapper}"
        if attempt.mapper == "global":
            return _mapped_globally(colmap, database, folder, models, settings, report)
        return _mapped(colmap, database, folder, models, settings, report)


def in_short(models: list[Any], names: list[str]) -> SparseModel:
    """Return a summary of the models."""
    model = models[0]
    registered, *others = ({each.image(number).name for number in each.reg_image_ids()} for each in models)
    return SparseModel(
        registered=tuple(name for name in names if name in registered),
        left_out=tuple(name for name in names if name not in registered),
        disconnected=tuple(name for name in names if name not in registered and any(name in other for other in others)),
        num_points=model.num_points3D(),
        num_cameras=model.num_cameras(),
        reprojection_error=model.compute_mean_reprojection_error(),
    )


def cause_of_nothing(work: Path, attempt: Attempt) -> str:
    """Return why an attempt placed no camera: "the pictures ..."."""
    colmap = require_pycolmap()
    kinds = colmap.TwoViewGeometryConfiguration
    with _opened(colmap, work / attempt.database) as content:
        _, pairs = content.read_two_view_geometries()
    flat = [pair.config in (kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC) for pair in pairs]
    return WITHOUT_DEPTH if 2 * sum(flat) > len(pairs) else "share too few details"


@contextmanager
def _quiet(colmap: Any) -> Iterator[None]:
    """Silence COLMAP's log except for fatal errors: failures are detected in its results and reported in our words."""
    before = colmap.logging.minloglevel
    colmap.logging.minloglevel = int(colmap.logging.FATAL)
    try:
        yield
    finally:
        colmap.logging.minloglevel = before


@contextmanager
def _room_asked_for(work: Path) -> Iterator[None]:
    """Check whether the disk is full if COLMAP fails, as COLMAP does not say so."""
    try:
        yield
    except RuntimeError:
        (work / "room").write_bytes(bytes(LEAST_ROOM))
        raise


def _camera_groups(photographs: list[FoundPhotograph], mode: CameraMode) -> tuple[list[list[str]], list[str]]:
    """Return groups of names that share a camera, and the names that each have their own."""
    if mode == "per_image":
        return [], [p.name for p in photographs]
    if mode == "single":
        sizes = Counter((p.width, p.height) for p in photographs).most_common()
        if len(sizes) > 1:
            shown = listed((f"{count} of {width} x {height}" for (width, height), count in sizes), cap=4)
            raise InputError(
                f"camera_mode=single, but the photographs have several sizes ({shown} pixels). Give camera_mode=auto "
                "(one camera per size and zoom) or per_image, or leave out the odd ones."
            )
        return [[p.name for p in photographs]], []
    sharing = Counter(p.camera for p in photographs)
    groups = [[p.name for p in photographs if p.camera == camera] for camera, n in sharing.items() if n > 1]
    return groups, [p.name for p in photographs if sharing[p.camera] == 1]


def _find_features(
    colmap: Any,
    database: Path,
    folder: Path,
    groups: tuple[list[list[str]], list[str]],
    lens: str,
    settings: SfmSettings,
    attempt: Attempt,
    report: Report,
) -> None:
    """Find features a few photographs at a time, to show progress and react to Ctrl-C."""
    options = colmap.FeatureExtractionOptions()
    # Whatever the default: if the wheel lacks ONNX, learned features abort the process.
    options.type = colmap.FeatureExtractorType.SIFT
    options.use_gpu, options.num_threads = False, settings.threads
    options.max_image_size, options.sift.max_num_features = settings.max_image_size, attempt.num_features
    options.sift.estimate_affine_shape = attempt.affine
    shared, alone = groups
    total, done = sum(map(len, shared)) + len(alone), 0
    report(FEATURES, 0.0)
    for names, mode in [*((group, colmap.CameraMode.SINGLE) for group in shared), (alone, colmap.CameraMode.PER_IMAGE)]:
        reader = colmap.ImageReaderOptions()
        # One photograph does not determine more than one term of a lens.
        is_free = mode == colmap.CameraMode.PER_IMAGE and lens == SfmSettings.camera_model
        reader.camera_model = OF_ONE_PHOTOGRAPH if is_free else lens
        for start in range(0, len(names), settings.threads):
            part = names[start : start + settings.threads]
            colmap.extract_features(
                database, folder, part, mode, reader, extraction_options=options, device=colmap.Device.cpu
            )
            done += len(part)
            report(FEATURES, done / total)
            if start == 0 and mode == colmap.CameraMode.SINGLE:
                with _opened(colmap, database) as content:
                    reader.existing_camera_id = content.read_image_with_name(names[0]).camera_id
    with _opened(colmap, database) as content:
        read = {image.name for image in content.read_all_images()}
    if unread := sorted({*chain(*shared), *alone} - read):
        raise InputError(
            f"COLMAP cannot read {listed(unread)} in {folder}. Save these as 8-bit JPEG or PNG, or leave them out."
        )


def _match(
    colmap: Any,
    database: Path,
    photographs: list[FoundPhotograph],
    pair_list: Path,
    settings: SfmSettings,
    report: Report,
) -> None:
    """Match and verify pairs of photographs."""
    options = colmap.FeatureMatchingOptions()
    options.type = colmap.FeatureMatcherType.SIFT_BRUTEFORCE
    options.use_gpu, options.num_threads = False, settings.threads
    verification = verification_of(colmap, photographs)
    pairing = colmap.ImportedPairingOptions()
    pairing.match_list_path = str(pair_list)
    pairs = image_pairs(settings.matching, len(photographs))
    # The list is split at spaces, and names may contain some.
    plain = {photograph.name: f"{number:06d}" for number, photograph in enumerate(photographs)}
    _rename(colmap, database, plain)
    done = 0
    report(MATCHING, 0.0)
    for tile in tiles_of(pairs):
        pair_list.write_text("".join(f"{i:06d} {j:06d}\n" for i, j in tile))
        colmap.match_image_pairs(database, options, pairing, verification, device=colmap.Device.cpu)
        done += len(tile)
        report(MATCHING, done / len(pairs))
    _rename(colmap, database, {number: name for name, number in plain.items()})


def _rename(colmap: Any, database: Path, new_names: dict[str, str]) -> None:
    with _opened(colmap, database) as content:
        for image in content.read_all_images():
            image.name = new_names[image.name]
            content.update_image(image)


@contextmanager
def _opened(colmap: Any, database: Path) -> Iterator[Any]:
    content = colmap.Database.open(database)
    try:
        yield content
    finally:
        content.close()


def _mapped(
    colmap: Any, database: Path, folder: Path, models: Path, settings: SfmSettings, report: Report
) -> list[Any]:
    """Return the models of incremental reconstruction, the largest first."""
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = settings.threads, settings.seed
    options.min_model_size = FEWEST_REGISTERED
    with _opened(colmap, database) as content:
        total = content.num_images()
    placed = chain([0.0], (count / total for count in range(2, 10**9)))
    make_folder(models)

    def advance() -> None:
        # A second model starts again with a first pair; the bar stays full while it is tried.
        report(MAPPING, next(placed))

    advance()
    found = colmap.incremental_mapping(
        database, folder, models, options, initial_image_pair_callback=advance, next_image_callback=advance
    )
    return _largest_first(found)


def _mapped_globally(
    colmap: Any, database: Path, folder: Path, models: Path, settings: SfmSettings, report: Report
) -> list[Any]:
    """Return the models of global reconstruction (GLOMAP, arXiv 2407.20219)."""
    options = colmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = settings.threads, settings.seed
    report(MAPPING, 0.0)
    return _largest_first(colmap.global_mapping(database, folder, make_folder(models), options))


def _largest_first(reconstructions: dict[int, Any]) -> list[Any]:
    for model in reconstructions.values():
        for image in [model.image(number) for number in model.reg_image_ids()]:
            if image.num_points3D < FEWEST_POINTS:
                model.deregister_frame(image.frame_id)
    models = [model for model in reconstructions.values() if model.num_reg_images() >= FEWEST_REGISTERED]
    return sorted(models, key=lambda model: model.num_reg_images(), reverse=True)
