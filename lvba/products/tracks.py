"""Which images show which map points: tracks for programs that expect a structure-from-motion model."""

import numpy as np

from lvba.kernels import zbuffer
from lvba.kernels.scene import BlockPoints
from lvba.kernels.visibility_depth import HIDING_PART
from lvba.products.cloud import sort_into_blocks
from lvba.products.views import Views
from lvba.visual.scene_points import HIDDEN_M

_CELL_PX = 4


def visible(points_world: np.ndarray, map_points: np.ndarray, views: Views) -> tuple[np.ndarray, ...]:
    """Pairs of points and images that show them, sorted by (point, image), and the pixel (column, row) of each.

    points_world: (P, 3) float64, m; map_points: (M, 3) float32, m, the whole map, which hides what lies behind it.
    Returns point (O,) int32, image (O,) int32, pixel (O, 2) float64. The pixel is the point's projection, not a feature
    that was matched.
    """
    blocks = sort_into_blocks(map_points)
    ordered = np.ascontiguousarray(map_points[blocks.order].T)
    by_image = [_in_image(points_world, blocks.holding(ordered), views, i) for i in range(len(views))]
    point = np.concatenate([rows for rows, _ in by_image]) if by_image else np.empty(0, np.int64)
    image = np.repeat(np.arange(len(by_image)), [len(rows) for rows, _ in by_image])
    pixel = np.concatenate([pixels for _, pixels in by_image]) if by_image else np.empty((0, 2))
    order = np.lexsort((image, point))
    return point[order].astype(np.int32), image[order].astype(np.int32), pixel[order]


def _in_image(points: np.ndarray, cloud: BlockPoints, views: Views, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N,) of the points that image i shows, and their pixels (N, 2)."""
    camera, mask = views.camera, views.mask
    nearest = zbuffer.seen_depths(cloud, views.poses[i : i + 1], views.intrinsics, _CELL_PX, *mask.shape)[0]
    pose = views.world_from_camera[i]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    front = np.flatnonzero(local[:, 2] > float(zbuffer.NEAR_M))
    scaled = local[front, :2] / local[front, 2:]
    pixel = scaled * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    inside = ((pixel >= 0) & (pixel <= [camera.width - 1, camera.height - 1])).all(1)
    front, pixel = front[inside], pixel[inside]
    column, row = np.rint(pixel).astype(int).T
    limit = nearest[row // _CELL_PX, column // _CELL_PX] * (1 + HIDING_PART) + HIDDEN_M
    shown = (local[front, 2] <= limit) & mask[row, column]
    return front[shown], pixel[shown]
