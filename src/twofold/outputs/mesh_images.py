"""Images of a triangle mesh by the CPU rasterizer: shaded or in its own colours, with opacity, on a floor."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from twofold.geometry.cameras import Camera, pixel_grid, pixel_rays
from twofold.geometry.raster import box_filter, rasterize, supersampled
from twofold.geometry.surfaces import vertex_normals

CLAY = (0.78, 0.80, 0.86)
_LIGHT = (0.35, 0.80, 0.48)
_TILE, _FADED = 0.5, 7.0
"""Edge of a floor tile, and the distance from the person at which the floor has faded, metres."""


def mesh_image(
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    colors: Float[Tensor, "V 3"] | None = None,
    factor: int = 2,
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Colour (times opacity, that is on black) and opacity of a closed mesh.

    Args:
        camera: where from.
        vertices: world, metres.
        faces: triangles, counter-clockwise from outside.
        colors: of the vertices, 0..1, shown as they are; None for clay in a light from the upper left.
        factor: samples along each edge of a pixel.
    """
    fine = supersampled(camera, factor)
    hits = rasterize(fine, vertices, faces, cull=True)
    corners = faces[hits.face]
    if colors is None:
        normals = (vertex_normals(vertices, faces)[corners] * hits.barycentric[..., None]).sum(1)
        facing = torch.nn.functional.normalize(normals, dim=-1) @ _light(camera)
        shade = 0.42 + 0.30 * facing + 0.28 * facing.clamp_min(0)
        seen = shade[:, None] * torch.tensor(CLAY)
    else:
        seen = (colors[corners] * hits.barycentric[..., None]).sum(1)
    both = torch.cat([seen.clamp(0, 1), torch.ones(len(seen), 1)], -1).float()
    image = box_filter(camera, factor, hits.pixel, both)
    return image[..., :3], image[..., 3]


def _light(camera: Camera) -> Float[Tensor, "3"]:
    """Direction to the light: above, to the viewer's left and ahead."""
    right, ahead = camera.world_to_camera[0, :3], camera.world_to_camera[2, :3]
    x, y, z = _LIGHT
    light = -x * right + torch.tensor([0.0, y, 0.0]) - z * ahead
    return torch.nn.functional.normalize(light, dim=0)


def floor_image(
    camera: Camera, background: Float[Tensor, "3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "h w 3"]:
    """A tiled floor at y = 0 with the mesh's shadow on it, fading into the background.

    Args:
        camera: where from.
        background: colour, 0..1.
        vertices: of the mesh, world, metres.
        faces: its triangles.
    """
    rays = pixel_rays(camera, pixel_grid(camera).flatten(0, 1))
    down = rays.directions[:, 1]
    distance = torch.where(down < -1e-4, -rays.origins[:, 1] / down, torch.inf)
    middle = vertices[:, [0, 2]].mean(0)
    high = float(camera.center[1])
    reach = float((camera.center[[0, 2]] - middle).norm()) + _FADED
    seen = torch.nonzero((distance > 0) & (distance < (reach**2 + high**2) ** 0.5))[:, 0]
    spots = rays.origins[seen] + distance[seen, None] * rays.directions[seen]
    waves = (spots[:, [0, 2]] * (torch.pi / _TILE)).sin().prod(-1)
    # Where a pixel covers much of a tile, the tiles blur instead of flickering.
    covered = distance[seen].square() / (high * float(camera.intrinsics[1, 1])) * (torch.pi / _TILE)
    tiles = (waves / (0.5 * covered).clamp_min(1e-3)).clamp(-1, 1) * (1.6 - covered).clamp(0, 1)
    shade = (0.59 if float(background.mean()) > 0.5 else 0.51) + 0.05 * tiles
    light = _light(camera)
    flat = vertices - light * (vertices[:, 1] / light[1])[:, None]
    flat[:, 1] = 0.002
    dark = torch.zeros(camera.height * camera.width)
    dark[rasterize(camera, flat, faces).pixel] = 1
    dark = torch.nn.functional.avg_pool2d(dark.view(1, camera.height, camera.width), 3, 1, 1).flatten()
    shade = shade * (1 - 0.45 * dark[seen])
    share = (1 - (spots[:, [0, 2]] - middle).norm(dim=-1) / _FADED).clamp(0, 1)[:, None]
    image = background.expand(camera.height * camera.width, 3).clone()
    image[seen] = background + share * (shade[:, None] - background)
    return image.unflatten(0, (camera.height, camera.width))
