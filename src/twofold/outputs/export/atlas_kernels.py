"""Compiled loops over the texels of an atlas."""

# pyright: reportMissingParameterType=false

import numpy as np

from twofold.kernels.parallel import compiled


@compiled
def paint(image, covered, uv, faces, table, segments, values):  # noqa: ANN001, ANN201
    """Write at each texel that a triangle covers the values of the lattice there.

    Args:
        image: h x w x c, is written.
        covered: h x w, 1 where something was written.
        uv: corners of the atlas, texels from the upper left corner.
        faces: their triangles.
        table: nodes of each triangle, see `TriangleLattice`.
        segments: of the lattice.
        values: of the nodes, N x c.
    """
    height, width, channels = image.shape
    for f in range(len(faces)):
        ax, ay = uv[faces[f, 0], 0], uv[faces[f, 0], 1]
        bx, by = uv[faces[f, 1], 0], uv[faces[f, 1], 1]
        cx, cy = uv[faces[f, 2], 0], uv[faces[f, 2], 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-12:
            continue
        left = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
        right = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
        top = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
        bottom = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5 - ax, row + 0.5 - ay
                b1 = (x * (cy - ay) - y * (cx - ax)) / area
                b2 = (y * (bx - ax) - x * (by - ay)) / area
                if b1 < -1e-6 or b2 < -1e-6 or b1 + b2 > 1 + 1e-6:
                    continue
                s, t = max(b1, 0.0) * segments, max(b2, 0.0) * segments
                i, j = min(int(s), segments - 1), min(int(t), segments - 1)
                if i + j > segments - 1:  # by rounding, on the third side
                    i, j = (i - 1, j) if i > 0 else (i, j - 1)
                p, q = s - i, t - j
                # Node (i, j) stands after the rows 0..i-1, which have segments + 1, segments, ... nodes.
                here = i * (segments + 1) - i * (i - 1) // 2 + j
                below = (i + 1) * (segments + 1) - (i + 1) * i // 2 + j
                covered[row, column] = 1
                if p + q <= 1 or i + j == segments - 1:
                    n0, n1, n2 = table[f, here], table[f, below], table[f, here + 1]
                    w1, w2 = p, q
                else:
                    n0, n1, n2 = table[f, below + 1], table[f, here + 1], table[f, below]
                    w1, w2 = 1 - p, 1 - q
                w0 = 1 - w1 - w2
                for c in range(channels):
                    image[row, column, c] = w0 * values[n0, c] + w1 * values[n1, c] + w2 * values[n2, c]
