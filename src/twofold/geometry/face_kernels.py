"""A compiled loop over triangles: the nearest one behind every sample.

A second rasterizer beside the reference, `geometry.raster`, because previews and the viewer need some 25 images of a
character of 40,000 triangles a second, and `prepare` paints the fitted body twice a frame: `geometry.raster` lists
every (triangle, pixel) pair in tensors and takes over ten times as long.
"""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def nearest_faces(points, faces, inverse, face, first, end):  # noqa: ANN001, ANN201
    """Fill rows first..end of the z-buffer: inverse depth, and which triangle; only those seen from outside count.

    Args:
        points: projected vertices, V x 3 (column, row, depth).
        faces: triangles, counter-clockwise from outside.
        inverse: h x w, zero where nothing is.
        face: h x w, -1 where nothing is.
        first: row to begin with.
        end: row to end before.
    """
    width = inverse.shape[1]
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if points[i, 2] <= 1e-6 or points[j, 2] <= 1e-6 or points[k, 2] <= 1e-6:
            continue
        ax, ay, bx, by = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
        cx, cy = points[k, 0], points[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area >= -1e-12:  # rows count downwards, so what faces the camera turns the other way
            continue
        top = max(first, int(np.ceil(min(ay, by, cy))))
        bottom = min(end - 1, int(np.floor(max(ay, by, cy))))
        left = max(0, int(np.ceil(min(ax, bx, cx))))
        right = min(width - 1, int(np.floor(max(ax, bx, cx))))
        if top > bottom or left > right:
            continue
        scale = 1 / area
        da, db, dc = 1 / points[i, 2], 1 / points[j, 2], 1 / points[k, 2]
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column - ax, row - ay
                s = (x * (cy - ay) - y * (cx - ax)) * scale
                t = (y * (bx - ax) - x * (by - ay)) * scale
                if s < -1e-5 or t < -1e-5 or s + t > 1 + 1e-5:
                    continue
                depth = da + s * (db - da) + t * (dc - da)
                if depth > inverse[row, column]:
                    inverse[row, column] = depth
                    face[row, column] = f
