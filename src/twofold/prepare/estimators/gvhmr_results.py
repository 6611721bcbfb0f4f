"""GVHMR: a torch file for a video, `hmr4d_results.pt`, whose poses are SMPL-X's.

https://github.com/zju3dv/GVHMR
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from twofold.capture.readers.sequence import numbers
from twofold.errors import TwofoldError
from twofold.npz import read_npz
from twofold.prepare.estimators.estimates import (
    Estimates,
    Lens,
    PersonTrack,
    PoseOptions,
    as_axis_angle,
    betas_of,
)
from twofold.torch_files import read_torch

_WORDS = "results of GVHMR"
_PARAMETERS = "smpl_params_incam"


def recognizes(path: Path) -> bool:
    """Whether it looks like them."""
    return path.suffix in (".pt", ".pth")


def read(path: Path, options: PoseOptions) -> Estimates:
    """The one person, in the camera's axes, as SMPL-X has them: the pelvis is where it is, betas are not SMPL's.

    The translation that comes back is the pelvis', so that `known_estimators` can bring it to any body.

    Raises:
        TwofoldError: the file is damaged, or the user's SMPL-X file is missing.
    """
    content = read_torch(path, _WORDS, (_PARAMETERS, "K_fullimg"))
    parameters = content.get(_PARAMETERS)
    keys = ("global_orient", "body_pose", "transl", "betas")
    missing = [key for key in keys if not isinstance(parameters, dict) or key not in parameters]
    if missing or not isinstance(parameters, dict):
        raise TwofoldError(f"{path} lacks {', '.join(missing)} of {_PARAMETERS}, which GVHMR writes; run it again.")
    root = as_axis_angle(parameters["global_orient"], 1, "global_orient", path)
    body = as_axis_angle(parameters["body_pose"], 21, "body_pose", path)
    count = len(root)
    if len(body) != count:
        raise TwofoldError(f"body_pose in {path} has {len(body)} rows, global_orient {count}; run GVHMR again.")
    poses = torch.cat([root, body, torch.zeros(count, 2, 3).double()], 1)
    places = torch.from_numpy(numbers(parameters["transl"], (count, 3), "transl", path))
    betas = betas_of(parameters["betas"], count, path)
    if options.smplx is None:
        raise TwofoldError(
            f"{path} has poses of SMPL-X, whose pelvis lies elsewhere than SMPL's; name the SMPL-X file that GVHMR "
            "used with --smplx FILE (SMPLX_NEUTRAL.npz)."
        )
    pelvis = smplx_pelvis(options.smplx, betas.mean(0))
    track = PersonTrack(tuple(map(str, range(count))), poses, places + pelvis, torch.zeros(count, 0).double())
    lens: Lens | None = None
    if isinstance(content.get("K_fullimg"), np.ndarray):
        k = numbers(content["K_fullimg"], (count, 3, 3), "K_fullimg", path).mean(0)
        four = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
        lens = lambda width, height: four  # noqa: E731 - it belongs to one video
    remark = f"{path} has betas of SMPL-X, which SMPL cannot take; the mean shape is used."
    return Estimates("GVHMR", path, {0: track}, lens, counted=True, complete=True, remarks=(remark,))


def smplx_pelvis(path: Path, betas: Float[Tensor, "S"]) -> Float[Tensor, "3"]:
    """Where SMPL-X's rest pelvis is for a shape, metres, out of the user's own file.

    Raises:
        TwofoldError: the file is missing, damaged, or of another model.
    """
    arrays = read_npz(path, ("v_template", "shapedirs", "J_regressor"))
    missing = [name for name in ("v_template", "shapedirs", "J_regressor") if name not in arrays]
    if missing:
        raise TwofoldError(f"{path} lacks {', '.join(missing)}; --smplx takes SMPLX_NEUTRAL.npz.")
    template = numbers(arrays["v_template"], (None, 3), "v_template", path)
    regressor = numbers(arrays["J_regressor"], (None, len(template)), "J_regressor", path)
    if len(regressor) != 55:
        raise TwofoldError(f"{path} has {len(regressor)} joints, SMPL-X has 55; --smplx takes SMPLX_NEUTRAL.npz.")
    shapes = numbers(arrays["shapedirs"], (len(template), 3, None), "shapedirs", path)[..., : len(betas)]
    return torch.from_numpy(regressor[0] @ (template + shapes @ betas.numpy()[: shapes.shape[-1]]))
