"""The viewer's panel without a browser: what stands on it, and somebody who presses it."""

import time
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
from support.scenes import ball_scene, tiny_model

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.extensions.viewer.camera_state import quaternion_of
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.extensions.viewer.controls import Controls
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import SlicedRenderer
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.video.paths.base import frame_of

HEIGHT = 12


class Handle:
    """Something on the panel; `act` is what the page calls."""

    order = 1.0

    def __init__(self, value, **options):
        self.value, self.options, self.visible = value, (), True
        vars(self).update({name: value for name, value in options.items() if value is not None})
        self.act = lambda event: None

    def on_update(self, function):
        self.act = function

    on_click = on_update

    def remove(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass


class Gui:
    """What has been put on the panel, by its label or its text."""

    def __init__(self):
        self.made = {}

    def __getattr__(self, kind):
        def add(label, *values, initial_value=None, **options):
            value = values[-1] if values and initial_value is None else initial_value
            if kind == "add_dropdown":
                options["options"] = values[0]
            if kind == "add_slider":
                options |= {"min": values[0], "max": values[1]}
            self.made[label] = Handle(value, label=label, content=label, **options)
            return self.made[label]

        return add


class Panel:
    """A person's panel over a ball, and the queue that serves them."""

    def __init__(self, folder, scene=None, exports=None, width=16, **changed):
        capture, scene = scene, scene or ball_scene(num_views=4, size=16)
        record = replace(scene_record(scene), **changed)
        self.queue = RenderQueue(SlicedRenderer(tiny_model().eval(), record, "white", 4096))
        self.client, self.gui = MagicMock(client_id=1), Gui()
        self.client.gui = self.gui
        c2w, camera = record.cameras.c2w[0], self.client.camera
        camera.wxyz, camera.position, camera.fov = quaternion_of(c2w), c2w[:, 3].double().numpy(), 0.6
        camera.image_width, camera.image_height, camera.aspect = width, HEIGHT, width / HEIGHT
        camera.look_at, camera.up_direction = np.zeros(3), np.array([0.0, 0.0, 1.0])
        around = frame_of(record.cameras, record.aabb)
        self.session = ViewerClient(self.client, self.queue, Photographs(record, capture, "white"), around, HEIGHT)
        self.session.start()
        self.controls = Controls(self.session, folder, 0.6, exports=exports)

    def work(self):
        while self.queue.work():
            pass

    def wait(self, true, seconds=20.0):
        """Wait for what another thread does."""
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end
            time.sleep(0.01)

    def said(self):
        """What the page says of the camera path."""
        return self.gui.made["No keyframes yet."].content

    def depth_sent(self):
        """The depth that came with the last picture."""
        return self.client.scene.set_background_image.call_args.kwargs["depth"]

    def press(self, label):
        """Press a button."""
        self.gui.made[label].act(MagicMock())

    def set(self, label, value):
        """Give a control a value, as somebody does in the page."""
        self.gui.made[label].value = value
        self.press(label)
