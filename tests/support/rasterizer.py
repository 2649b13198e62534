"""A picture of a mesh: the face that each pixel shows, and its colour by vertex or by texture; a z-buffer in loops."""

import numpy as np
from numba import njit


@njit(cache=True)
def _draw(places, depth, faces, nearest, face, shares):
    for number in range(len(faces)):
        a, b, c = faces[number]
        if depth[a] <= 0 or depth[b] <= 0 or depth[c] <= 0:
            continue
        ax, ay, bx, by, cx, cy = places[a, 0], places[a, 1], places[b, 0], places[b, 1], places[c, 0], places[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        for i in range(max(0, int(min(ay, by, cy))), min(nearest.shape[0], int(max(ay, by, cy)) + 1)):
            for j in range(max(0, int(min(ax, bx, cx))), min(nearest.shape[1], int(max(ax, bx, cx)) + 1)):
                x, y = j + 0.5, i + 0.5
                v = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                w = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                u = 1 - v - w
                if u < 0 or v < 0 or w < 0:
                    continue
                # What is straight in the world is so in 1 / depth on the screen.
                inverse = u / depth[a] + v / depth[b] + w / depth[c]
                if inverse > nearest[i, j]:
                    nearest[i, j], face[i, j] = inverse, number
                    shares[i, j, 0] = u / depth[a] / inverse
                    shares[i, j, 1] = v / depth[b] / inverse
                    shares[i, j, 2] = w / depth[c] / inverse


def rasterize(vertices, faces, cameras, view, times=1):
    """Return face (-1: none) and the shares of its corners for each pixel of a pinhole, of `times` as many a side."""
    c2w = cameras.c2w[view].double().numpy()
    focal, center = (times * getattr(cameras, name)[view].double().numpy() for name in ("focal", "center"))
    local = (np.asarray(vertices, float) - c2w[:, 3]) @ c2w[:, :3]
    depth = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.stack([local[:, 0], -local[:, 1]], axis=1) / depth[:, None] * focal + center
    shape = (times * int(cameras.height[view]), times * int(cameras.width[view]))
    nearest, face, shares = np.zeros(shape), np.full(shape, -1, np.int64), np.zeros((*shape, 3))
    _draw(places, depth, np.asarray(faces, np.int64), nearest, face, shares)
    return face, shares


def at_corners(values, faces, face, shares):
    """Return what stands at the corners, mixed between them, for each pixel; NaN where there is no face."""
    mixed = (shares[..., None] * np.asarray(values, float)[np.asarray(faces)[face]]).sum(axis=-2)
    return np.where(face[..., None] >= 0, mixed, np.nan)


def in_texture(picture, uv):
    """Return the colours at places of a texture (v up), mixed between the four texels around each."""
    height, width, _ = picture.shape
    x, y = (np.nan_to_num(uv) * (1, -1) + (0, 1)).reshape(-1, 2).T * np.array([[width], [height]]) - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - j)[:, None], (y - i)[:, None]

    def texel(row, column):
        return picture[row.clip(0, height - 1), column.clip(0, width - 1)].astype(float)

    top, bottom = ((1 - u) * texel(row, j) + u * texel(row, j + 1) for row in (i, i + 1))
    return ((1 - v) * top + v * bottom).reshape(*uv.shape[:-1], 3)


def smaller(picture, times):
    """Return the mean of blocks of times x times pixels."""
    height, width, channels = picture.shape
    return picture.reshape(height // times, times, width // times, times, channels).mean(axis=(1, 3))
