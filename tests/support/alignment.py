"""Comparing two sets of camera poses of the same views, each in a frame and scale of its own."""

import numpy as np

FLIP = np.diag([1.0, -1.0, -1.0])


def umeyama(source, target):
    """Return scale, rotation and shift that take source points (n, 3) onto target points with least squared error.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, Eq. 40-43.
    """
    source_mean, target_mean = source.mean(0), target.mean(0)
    source, target = source - source_mean, target - target_mean
    u, d, vt = np.linalg.svd(target.T @ source / len(source))
    sign = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(d) @ sign) / source.var(0).sum()
    return scale, rotation, target_mean - scale * rotation @ source_mean


def pose_errors(found, true):
    """Return the errors of aligned camera-to-world poses (n, 3, 4): of the centers, in true units, and degrees."""
    scale, rotation, shift = umeyama(found[:, :, 3], true[:, :, 3])
    centres = scale * found[:, :, 3] @ rotation.T + shift
    turned = np.swapaxes(rotation @ found[:, :, :3], 1, 2) @ true[:, :, :3]
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(centres - true[:, :, 3], axis=1), np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def colmap_poses(sparse):
    """Return {name: camera-to-world (3, 4), axes right, up, back} of a COLMAP model."""
    import pycolmap

    model = pycolmap.Reconstruction(sparse)
    poses = {}
    for number in model.reg_image_ids():
        world_to_camera = model.image(number).cam_from_world().matrix()
        rotation = world_to_camera[:, :3].T
        poses[model.image(number).name] = np.column_stack([rotation @ FLIP, -rotation @ world_to_camera[:, 3]])
    return poses
