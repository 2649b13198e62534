"""A page without a browser: speaks viser's protocol, moves a camera, collects the pictures that are sent."""

import io
import math
import threading
import time

import numpy as np
import pytest

viser = pytest.importorskip("viser", reason="viser is not installed: pip install '.[viewer]'")

import msgspec  # noqa: E402
import zstandard  # noqa: E402
from PIL import Image  # noqa: E402
from viser.transforms import SO3  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402


class ViserClient:
    """Somebody who looks on from a circle around the middle; reads what is sent unless told to be slow.

    `address` is the one that is printed, with its token; `handshake` goes to the websocket's `connect`.
    """

    def __init__(self, address: str, width: int = 160, height: int = 120, reads: bool = True, **handshake):
        self.width, self.height = width, height
        self.pictures: list[np.ndarray] = []
        self.said: list[dict] = []
        """What is put on the panel, and notifications."""
        protocol = f"viser-v{viser.__version__}"
        url = address.replace("http", "ws", 1)
        self.socket = connect(url, subprotocols=[protocol], max_size=None, **handshake)
        if reads:
            threading.Thread(target=self._read, daemon=True).start()

    def look_from(self, degrees: float, distance: float = 4.0, **changed) -> None:
        """Say that the camera stands there now; `changed` takes the place of parts of the message."""
        angle = math.radians(degrees)
        eye = distance * np.array([math.cos(angle), math.sin(angle), 0.4])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": SO3.from_matrix(rotation).wxyz.tolist(),
            "position": eye.tolist(),
            "fov": 0.6,
            "near": 0.01,
            "far": 100.0,
            "image_height": self.height,
            "image_width": self.width,
            "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, 0.0, 1.0],
        }
        self.send(message | changed)

    def set(self, label: str, value: object) -> None:
        """Give what stands under this label on the panel a value, as soon as it is there; True presses a button."""
        self.wait_until(lambda: label in self._uuids)
        self.send({"type": "GuiUpdateMessage", "uuid": self._uuids[label], "updates": {"value": value}})

    def send(self, message: object) -> None:
        """Send a message as it is."""
        self.socket.send(msgspec.msgpack.encode(message))

    def wait_for(self, enough, seconds: float = 60.0) -> None:
        """Wait until `enough(pictures)`; give up loudly."""
        self.wait_until(lambda: enough(self.pictures), seconds)

    def wait_until(self, true, seconds: float = 60.0) -> None:
        """Wait until `true()`; give up loudly."""
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, f"{len(self.pictures)} pictures came, and not what was waited for"
            time.sleep(0.02)

    def wait_for_height(self, height: int, after: int = 0) -> np.ndarray:
        """Wait for a picture of this height among those after the first `after`."""
        self.wait_for(lambda pictures: any(len(each) == height for each in pictures[after:]))
        return next(each for each in self.pictures[after:] if len(each) == height)

    def close(self) -> None:
        self.socket.close()

    @property
    def _uuids(self) -> dict[str, str]:
        made = [each for each in list(self.said) if "label" in (each.get("props") or {})]
        return {each["props"]["label"]: each["uuid"] for each in made}

    def _read(self) -> None:
        try:
            for raw in self.socket:
                size = int.from_bytes(raw[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
                for message in msgspec.msgpack.decode(inner)["messages"]:
                    if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                        self.pictures.append(np.array(Image.open(io.BytesIO(message["rgb_data"]))))
                    elif message["type"].startswith(("Gui", "Notification")):
                        self.said.append(message)
        except ConnectionClosed:
            pass
