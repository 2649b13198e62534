"""The cameras as an animation, a photograph a frame: nerfstudio's camera path, and a script with Blender's keyframes.

Both know pinholes of one size whose pixels are square; `beyond_pinholes` says what of the photographs' cameras is lost.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch

from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.poses import quaternion_from_rotation
from nerf_lightning.nerf.types.scene import Cameras, LensModel

CAMERA_TYPES: dict[LensModel, str] = {
    "pinhole": "perspective",
    "radial_tangential": "perspective",
    "fisheye": "fisheye",
    "equirectangular": "equirectangular",
}
SENSOR_WIDTH = 36.0  # Of Blender's camera, in millimetres; its focal length is in these too.


def nerfstudio_path(cameras: Cameras, fps: int) -> dict[str, Any]:
    """Return what `ns-render camera-path` reads, of cameras in the user's frame; `fps` are photographs per second."""
    panorama = cameras.lens_model == "equirectangular"
    frames = [
        {
            "camera_to_world": [*cameras.c2w[view].flatten().tolist(), 0.0, 0.0, 0.0, 1.0],  # row by row
            # Degrees across the height; of a panorama nerfstudio asks nothing.
            "fov": 90.0 if panorama else math.degrees(2 * math.atan(0.5 * height / float(cameras.focal[view, 1]))),
            "aspect": int(cameras.width[view]) / height,
        }
        for view, height in enumerate(cameras.height.tolist())
    ]
    return {
        "camera_type": CAMERA_TYPES[cameras.lens_model],
        "render_height": int(cameras.height[0]),
        "render_width": int(cameras.width[0]),
        "fps": fps,
        "seconds": len(frames) / fps,
        "camera_path": frames,
    }


SCRIPT = """# In Blender: Scripting, Open, Run Script. Makes a camera with a keyframe for each photograph.
import bpy

WIDTH, HEIGHT, FPS, SENSOR_WIDTH = {width}, {height}, {fps}, {sensor}  # pixels, pixels, frames per second, millimetres
# For each photograph: name, place, rotation (w, x, y, z), focal length in millimetres, shift in widths of the picture.
FRAMES = [
{frames}
]

scene = bpy.context.scene
data = bpy.data.cameras.new("photographs")
camera = bpy.data.objects.new("photographs", data)
scene.collection.objects.link(camera)
scene.camera = camera
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
scene.render.fps, scene.render.fps_base = FPS, 1.0
scene.frame_start, scene.frame_end = 1, len(FRAMES)
data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_WIDTH
camera.rotation_mode = "QUATERNION"
for number, (name, place, rotation, lens, shift) in enumerate(FRAMES, start=1):
    camera.location, camera.rotation_quaternion = place, rotation
    data.lens, (data.shift_x, data.shift_y) = lens, shift
    for key in ("location", "rotation_quaternion"):
        camera.keyframe_insert(key, frame=number)
    for key in ("lens", "shift_x", "shift_y"):
        data.keyframe_insert(key, frame=number)
    scene.timeline_markers.new(name, frame=number)
"""


def blender_script(cameras: Cameras, names: Sequence[str], fps: int) -> str:
    """Return a script in Python that Blender runs, of cameras in the user's frame and of `fps` photographs per second.

    It holds numbers, and names, which may come from anybody, as literals in ASCII.
    """
    if cameras.lens_model in ("fisheye", "equirectangular"):
        raise InputError(
            f"what.format=blender: the photographs are {CAMERA_TYPES[cameras.lens_model]} ones, and the keyframes "
            "are a perspective camera's. Give what.format=nerfstudio or what.format=transforms."
        )
    rotations = quaternion_from_rotation(cameras.c2w[:, :, :3])
    for view in range(1, len(rotations)):  # q and -q are one rotation; between keys, the nearer one turns less
        if rotations[view] @ rotations[view - 1] < 0:
            rotations[view] = -rotations[view]
    width, height = cameras.width.double(), cameras.height.double()
    lens = SENSOR_WIDTH * cameras.focal[:, 0] / width
    offset = cameras.center - 0.5 * torch.stack([width, height], dim=-1)
    shift = torch.stack([-offset[:, 0], offset[:, 1]], dim=-1) / width[:, None]  # to the right, and up
    rows = zip(names, cameras.c2w[:, :, 3].tolist(), rotations.tolist(), lens.tolist(), shift.tolist(), strict=True)
    frames = "\n".join(f"    {row!a}," for row in rows)
    return SCRIPT.format(width=int(width[0]), height=int(height[0]), fps=fps, sensor=SENSOR_WIDTH, frames=frames)


def beyond_pinholes(cameras: Cameras, shifts: bool) -> list[str]:
    """Return what of the cameras an animated pinhole does not show, where it would be seen: by half a pixel.

    `shifts` says whether the principal point may lie off the middle.
    """
    (width, height), (fx, fy) = (cameras.width, cameras.height), cameras.focal.unbind(dim=-1)
    off = cameras.center - 0.5 * torch.stack([width, height], dim=-1)
    found = {
        "the coefficients of the lens": bool(cameras.lens.any()),
        "that pixels are not square": bool(((fx / fy - 1).abs() * 0.5 * height > 0.5).any()),
        "that the principal point is off the middle": not shifts and bool((off.abs() > 0.5).any()),
        "that the photographs differ in size": bool((width != width[0]).any() or (height != height[0]).any()),
    }
    return [what for what, lost in found.items() if lost]
