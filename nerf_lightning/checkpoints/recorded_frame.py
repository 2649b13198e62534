"""A scene as the model of a checkpoint knows it: in the frame of its training, with the refined cameras."""

from dataclasses import replace

import torch

from nerf_lightning.checkpoints.reading import Checkpoint
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.alignment import carried, similarity_between
from nerf_lightning.nerf.geometry.world_frame import points_from_user, poses_from_user, unit_of
from nerf_lightning.nerf.types.scene import Scene, SceneRecord

SAME_POSE = 1e-3
"""Tolerance between two readings of one capture, in scene units and in the entries of a rotation."""


def as_trained(scene: Scene, checkpoint: Checkpoint) -> Scene:
    """Return the scene in the frame that a model was trained in, with its refined cameras if it has any.

    Views that it was not trained on follow the overall motion of the trained ones.

    Raises:
        InputError: the model was trained in another kind of space.
    """
    scene, given, refined = in_recorded_frame(scene, checkpoint.scene), checkpoint.given_cameras, checkpoint.scene
    if given is None:
        return scene
    trained = list(refined.splits["train"])
    by = similarity_between(given.c2w[trained], refined.cameras.c2w[trained])
    c2w, focal, lens = carried(scene.cameras.c2w, by), scene.cameras.focal.clone(), scene.cameras.lens.clone()
    same_lens = scene.cameras.lens_model == given.lens_model
    known = {name: number for number, name in enumerate(refined.view_names)}
    for view, name in enumerate(scene.view_names):
        number = known.get(name)
        # Another capture may have photographs of the same names.
        if number is None or float((scene.cameras.c2w[view] - given.c2w[number]).abs().max()) > SAME_POSE:
            continue
        c2w[view] = refined.cameras.c2w[number]
        focal[view] *= refined.cameras.focal[number] / given.focal[number]
        if same_lens:
            lens[view] += refined.cameras.lens[number] - given.lens[number]
    # A pinhole is a lens without distortion, in case training learned some for others.
    model = refined.cameras.lens_model if same_lens else scene.cameras.lens_model
    cameras = replace(scene.cameras, c2w=c2w, focal=focal, lens=lens, lens_model=model)
    return replace(scene, cameras=cameras, refined=True)


def in_recorded_frame(scene: Scene, record: SceneRecord) -> Scene:
    """Return the scene with its poses in the frame that a model was trained in.

    The working frame of a capture follows from the views and the sizes that are read, so a scene read with other
    settings (`scene.frames`, `scene.downscale`) has another one, and the model would be seen from elsewhere. Both
    frames know their transform to the user's.

    Raises:
        InputError: the model was trained in another kind of space.
    """
    if scene.space != record.space:
        raise InputError(
            f"The scene {scene.name} was read with space={scene.space}, but the checkpoint was trained on "
            f"{record.name} with space={record.space}. Give scene.space={record.space}."
        )
    if record.cameras.ndc is not None:
        views = len(scene.view_names)
        ndc, far = record.cameras.ndc[:1].expand(views, 2), record.far.max().expand(views)
        scene = replace(scene, cameras=replace(scene.cameras, ndc=ndc), far=far)
    if torch.equal(scene.to_user, record.to_user):
        return scene
    # The model's frame as this scene's sees it: theirs to the user's, and the user's to this one.
    apart = torch.linalg.inv(scene.to_user.double()) @ record.to_user.double()
    ratio = 1.0 if record.cameras.ndc is not None else 1.0 / unit_of(apart)
    return replace(
        scene,
        cameras=replace(scene.cameras, c2w=poses_from_user(scene.cameras.c2w.double(), apart).float()),
        near=ratio * scene.near,
        far=ratio * scene.far,
        aabb=record.aabb,
        points=points_from_user(scene.points.double(), apart).float(),
        to_user=record.to_user,
    )
