"""Keys of a JSON file of frames: those that are used, not modeled, or irrelevant to the pictures."""

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from nerf_lightning.messages.escaping import for_terminal, listed

USED = {
    *("frames", "file_path", "transform_matrix", "applied_transform", "applied_scale", "ply_file_path"),
    *("w", "h", "fl_x", "fl_y", "x_fov", "y_fov", "camera_angle_x", "camera_angle_y", "cx", "cy"),
    *("camera_model", "is_fisheye", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "ftheta_p0", "latlong"),
    *("equirectangular", "fisheye_crop_radius", "mask_path", "white_transparent", "black_transparent"),
    *("depth_file_path", "depth_path", "depth_unit_scale_factor", "integer_depth_scale", "time", "from_mitsuba"),
    *("aabb_scale", "aabb", "scale", "offset", "train_filenames", "val_filenames", "test_filenames"),
}
NOT_MODELED = {
    **dict.fromkeys(("rolling_shutter", "rolling_shutter_time", "rolling_shutter_type"), "a rolling shutter"),
    **dict.fromkeys(("camera_linear_velocity", "camera_angular_velocity", "velocity"), "a moving camera"),
    **dict.fromkeys(("transform_matrix_start", "transform_matrix_end", "exposure_time"), "a moving camera"),
    **dict.fromkeys(("skew", "s", "camera_skew"), "skewed pixels"),
    **dict.fromkeys(("s1", "s2", "s3", "s4", "b1", "b2"), "this part of the lens"),
    **dict.fromkeys(("ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"), "this lens"),
    **dict.fromkeys(("normal_file_path", "semantic_path", "segmentation_path"), "maps of this kind"),
    **dict.fromkeys(("envmap", "light", "light_direction", "light_position", "driver_parameters"), "other light"),
    **dict.fromkeys(("fix_premult", "is_hdr", "hdr", "sharpen", "mask_color"), "other colors"),
    **dict.fromkeys(("timestamp_delta", "latent", "extra_dims", "n_extra_learnable_dims"), "changing content"),
}
"""What a key would change in the pictures."""
MEANINGLESS = {
    *("sharpness", "sharpness_discard_threshold", "colmap_im_id", "colmap_image_id", "image_id", "camera_id", "id"),
    *("camera_label", "label", "name", "index", "idx", "frame_id", "frame_index", "frame_number", "timestamp"),
    *("rotation", "up", "centroid", "avglen", "totw", "version", "type", "source", "exporter", "generator", "comment"),
    *("orientation_override", "auto_scale_poses_override", "render_aabb", "n_frames", "bbox", "lens", "exif"),
    *("enable_ray_loading", "enable_depth_loading", "importance_sampling", "normal_mts_args", "aabb_range"),
    *("sphere_center", "sphere_radius", "scene_center", "scene_scale", "blur", "blur_score", "manual_keyframe"),
    *("motion_blur", "sparse_pcd_path", "split", "width", "height"),
}

log = logging.getLogger(__name__)


def say_of_keys(where: Path, dictionaries: Iterable[Mapping[str, Any]]) -> None:
    """Log once which keys of a file and its frames are not modeled, and which are unknown.

    Args:
        where: the file, for messages.
        dictionaries: the file's own keys, and those of each frame.
    """
    said = dict.fromkeys(key for each in dictionaries for key, value in each.items() if _says(value))
    changing = [key for key in said if key in NOT_MODELED]
    if changing:
        words = listed(dict.fromkeys(f"{NOT_MODELED[key]} ({key})" for key in changing), 10)
        log.warning("%s: not modeled, so details may be blurred or displaced: %s", for_terminal(str(where)), words)
    unknown = [for_terminal(key) for key in said if key not in USED | MEANINGLESS | NOT_MODELED.keys()]
    if unknown:
        log.info("%s: keys that are not known are ignored: %s", for_terminal(str(where)), listed(unknown, 10))


def _says(value: object) -> bool:
    """Return whether a value has an effect: zero, false, and lists of nothing else have none."""
    return any(value) if isinstance(value, list) else bool(value)
