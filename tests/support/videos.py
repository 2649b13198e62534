"""Reading videos back in tests."""

import warnings

import imageio_ffmpeg
import numpy as np


def read_video(path, **options):
    """Return what ffmpeg says of a video, and its frames as (frames, height, width, channels)."""
    reader = imageio_ffmpeg.read_frames(str(path), **options)
    meta = next(reader)
    width, height = meta["size"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # imageio-ffmpeg's reader forgets its pipes
        frames = [np.frombuffer(frame, np.uint8) for frame in reader]
        del reader
    return meta, np.stack(frames).reshape(len(frames), height, width, -1)
