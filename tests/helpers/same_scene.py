"""Whether a capture shows the scene that a data set was written of."""

import numpy as np

from twofold.body.skeleton import pose_body, shape_body
from twofold.geometry.cameras import project
from twofold.geometry.silhouettes import overlap, silhouette


def require_same_scene(capture, scene, cameras, frame_of=lambda frame: frame, soft=0.85, colours=25):
    """Every image of every split: vertices within half a pixel, the same silhouette, a mask and colours that fit.

    Args:
        capture: to be compared.
        scene: ground truth.
        cameras: of the capture, by the scene's index.
        frame_of: the scene's frame of a capture's.
        soft: silhouette IoU that the masks reach (they may have been bent by a lens and straightened again).
        colours: by how much they differ on average at most, 0..255.
    """
    index = {name: place for place, name in cameras.items()}
    shaped = shape_body(capture.body, capture.betas)
    count = 0
    for frames in capture.splits.values():
        for frame in frames:
            c, t = index[frame.camera_name], frame_of(frame.frame_index)
            posed = pose_body(shaped, frame.pose, frame.translation)
            factor = frame.camera.width / scene.size
            expected = (scene.pixels(c, t) + 0.5) * factor - 0.5
            off = np.abs(project(frame.camera, posed.vertices)[0].numpy() - expected).max()
            assert off < 0.05, (frame.camera_name, frame.frame_index, off)  # half a pixel is promised
            image, mask = scene.image(c, t)
            shown = silhouette(frame.camera, posed.vertices, posed.faces)
            if factor == 1:
                assert overlap(shown, mask > 0) > 0.99
            assert overlap(shown, frame.mask().numpy() > 0.5) > soft
            if factor == 1:
                inside = (mask > 0) & (frame.mask().numpy() > 0.99)
                assert np.abs(255 * frame.image().numpy() - image)[inside].mean() < colours
            count += 1
    assert count
    return count
