"""Compiled loops that render a mesh: its projected vertices, and the colour behind every sample.

The nearest triangle behind a sample comes from `geometry.face_kernels`.
"""

# pyright: reportMissingParameterType=false

from twofold.kernels.parallel import compiled


@compiled
def project(vertices, rotation, translation, intrinsics, out):  # noqa: ANN001, ANN201
    """Columns, rows and depths of points; `out` is V x 3."""
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        a = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        b = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        c = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if c > 1e-6:
            out[v, 0] = (intrinsics[0, 0] * a + intrinsics[0, 1] * b) / c + intrinsics[0, 2]
            out[v, 1] = intrinsics[1, 1] * b / c + intrinsics[1, 2]
        out[v, 2] = c


@compiled
def shade(points, faces, face, corners, uv, texture, colors, light, factor, out, first, end):  # noqa: ANN001, ANN201
    """Mean colour and opacity of the samples in each pixel of rows first..end.

    Args:
        points: projected vertices.
        faces: triangles.
        face: which triangle each sample sees.
        corners: the same triangles by corners of the atlas.
        uv: of these, in texels.
        texture: h x w x 3, or without texels where there is none.
        colors: of the vertices, where there is no texture.
        light: brightness of each vertex.
        factor: samples along each side of a pixel.
        out: h x w x 4, is written.
        first: pixel row to begin with.
        end: pixel row to end before.
    """
    height, width = texture.shape[0], texture.shape[1]
    for row in range(first, end):
        for column in range(out.shape[1]):
            r = g = b = count = 0.0
            for sample in range(factor * factor):
                y, x = row * factor + sample // factor, column * factor + sample % factor
                f = face[y, x]
                if f < 0:
                    continue
                i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
                ax, ay = points[i, 0], points[i, 1]
                bx, by, cx, cy = points[j, 0] - ax, points[j, 1] - ay, points[k, 0] - ax, points[k, 1] - ay
                scale = 1 / (bx * cy - by * cx)
                s = min(max(((x - ax) * cy - (y - ay) * cx) * scale, 0.0), 1.0)
                t = min(max(((y - ay) * bx - (x - ax) * by) * scale, 0.0), 1.0 - s)
                wa, wb, wc = (1 - s - t) / points[i, 2], s / points[j, 2], t / points[k, 2]
                total = wa + wb + wc
                wa, wb, wc = wa / total, wb / total, wc / total
                bright = wa * light[i] + wb * light[j] + wc * light[k]
                if height > 0:
                    p, q, o = corners[f, 0], corners[f, 1], corners[f, 2]
                    u = wa * uv[p, 0] + wb * uv[q, 0] + wc * uv[o, 0] - 0.5
                    v = wa * uv[p, 1] + wb * uv[q, 1] + wc * uv[o, 1] - 0.5
                    u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
                    m, n = int(u), int(v)
                    du, dv = u - m, v - n
                    w00, w01, w10, w11 = (1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv
                    bright /= 255
                    r += bright * (w00 * texture[n, m, 0] + w01 * texture[n, m + 1, 0]
                                   + w10 * texture[n + 1, m, 0] + w11 * texture[n + 1, m + 1, 0])  # fmt: skip
                    g += bright * (w00 * texture[n, m, 1] + w01 * texture[n, m + 1, 1]
                                   + w10 * texture[n + 1, m, 1] + w11 * texture[n + 1, m + 1, 1])  # fmt: skip
                    b += bright * (w00 * texture[n, m, 2] + w01 * texture[n, m + 1, 2]
                                   + w10 * texture[n + 1, m, 2] + w11 * texture[n + 1, m + 1, 2])  # fmt: skip
                else:
                    r += bright * (wa * colors[i, 0] + wb * colors[j, 0] + wc * colors[k, 0])
                    g += bright * (wa * colors[i, 1] + wb * colors[j, 1] + wc * colors[k, 1])
                    b += bright * (wa * colors[i, 2] + wb * colors[j, 2] + wc * colors[k, 2])
                count += 1
            samples = factor * factor
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = r / samples, g / samples, b / samples
            out[row, column, 3] = count / samples
