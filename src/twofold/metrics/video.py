"""How steady a video of an avatar is, by optical flow (Horn and Schunck 1981).

Papers print a flow score without its formula. Both readings are here, with all that the numbers depend on in the
constants below; they compare runs measured in one way, not runs with numbers printed elsewhere.
"""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, pad

from twofold.metrics.image import to_8bit

ALPHA = 15.0
"""Weight of smoothness beside the change of brightness, in grey levels of 0..255 per pixel."""
ITERATIONS = 100
"""Jacobi steps from zero flow."""
GREY = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in grey (Rec. 601)."""
_SETTINGS = (
    f"Horn-Schunck flow in pixels, grey of 8-bit colours (Rec. 601), 2x2x2 differences, alpha {ALPHA:g}, "
    f"{ITERATIONS} iterations"
)
PROTOCOLS = {
    "flow_length_px": f"mean length of the flow between successive rendered images of one camera; {_SETTINGS}",
    "flow_length_truth_px": "the same of the true images",
    "flow_error_px": "mean length of the difference between the flow of the rendered images and that of the true ones, "
    "whole image",
    "flow_error_mask_px": "the same over the pixels where the subject is in either of the two true images",
}
"""What each number of `frame_consistency` is, in one line."""


def horn_schunck(
    first: Float[Tensor, "h w 3"], second: Float[Tensor, "h w 3"], alpha: float = ALPHA, iterations: int = ITERATIONS
) -> Float[Tensor, "h w 2"]:
    r"""Optical flow from the first image to the second, in pixels along columns and rows.

    Minimises $\sum (E_x u + E_y v + E_t)^2 + \alpha^2 (|\nabla u|^2 + |\nabla v|^2)$ by

    $$u \leftarrow \bar u - E_x \frac{E_x \bar u + E_y \bar v + E_t}{\alpha^2 + E_x^2 + E_y^2}, \quad
    v \leftarrow \bar v - E_y \frac{E_x \bar u + E_y \bar v + E_t}{\alpha^2 + E_x^2 + E_y^2}$$

    The derivatives are means of four differences in cubes of 2 x 2 x 2 grey values; the means of $u$ and $v$ weigh the
    four neighbours by 1/6 and the diagonal ones by 1/12. Images and flow go on as they end beyond the edge.

    Args:
        first: colours 0..1, stored as 8 bit before their grey is taken.
        second: the same.
        alpha: see `ALPHA`.
        iterations: see `ITERATIONS`.

    >>> ramp = torch.linspace(0, 1, 52)[None, :, None].expand(8, -1, 3)  # 5 grey levels a pixel
    >>> flow = horn_schunck(ramp[:, 1:], ramp[:, :-1], iterations=500)  # moved by one pixel to the right
    >>> round(flow[4, 25, 0].item(), 2), round(flow[4, 25, 1].item(), 2)
    (1.0, 0.0)
    """
    dx, dy, dt = _derivatives(_grey(first), _grey(second))
    weights = torch.tensor([[1, 2, 1], [2, 0, 2], [1, 2, 1]], dtype=dx.dtype)[None, None] / 12
    flow = torch.zeros(2, 1, *dx.shape, dtype=dx.dtype)
    gradient = torch.stack([dx, dy])[:, None]
    scaled = gradient / (alpha**2 + dx.square() + dy.square())
    for _ in range(iterations):
        mean = conv2d(pad(flow, (1, 1, 1, 1), mode="replicate"), weights)
        flow = mean - scaled * ((gradient * mean).sum(0) + dt)
    return flow[:, 0].movedim(0, -1)


def _grey(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """0..255."""
    return to_8bit(image).float() @ torch.tensor(GREY)


def _derivatives(first: Float[Tensor, "h w"], second: Float[Tensor, "h w"]) -> tuple[Tensor, Tensor, Tensor]:
    cube = pad(torch.stack([first, second])[:, None], (0, 1, 0, 1), mode="replicate")[:, 0]
    along_rows, along_columns, in_time = cube.diff(dim=1), cube.diff(dim=2), cube.diff(dim=0)
    dx = (along_columns[:, :-1] + along_columns[:, 1:]).sum(0) / 4
    dy = (along_rows[:, :, :-1] + along_rows[:, :, 1:]).sum(0) / 4
    rows = in_time[0, :-1] + in_time[0, 1:]
    return dx, dy, (rows[:, :-1] + rows[:, 1:]) / 4


def flow_length(flow: Float[Tensor, "h w 2"], inside: Bool[Tensor, "h w"] | None = None) -> float:
    r"""Mean length of the flow in pixels, $\frac{1}{|M|} \sum_{p \in M} \|f_p\|$; 0 where no pixel counts.

    >>> flow_length(torch.tensor([[[3.0, 4.0], [0.0, 0.0]]]))
    2.5
    """
    lengths = flow.norm(dim=-1)
    chosen = lengths if inside is None else lengths[inside]
    return chosen.mean().item() if chosen.numel() else 0.0


def flow_error(
    flow: Float[Tensor, "h w 2"], truth: Float[Tensor, "h w 2"], inside: Bool[Tensor, "h w"] | None = None
) -> float:
    r"""Mean end-point difference of two flows in pixels, $\frac{1}{|M|} \sum_{p \in M} \|f_p - g_p\|$.

    >>> flow_error(torch.tensor([[[3.0, 4.0]]]), torch.tensor([[[3.0, 1.0]]]))
    3.0
    """
    return flow_length(flow - truth, inside)


def frame_consistency(
    frames: Iterable[tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"], Float[Tensor, "h w"]]],
) -> dict[str, float]:
    """Figures of a video, named as in `PROTOCOLS`; empty where it has fewer than two images.

    Args:
        frames: rendered image, true image and true mask, in the order of time and from one camera that does not move.
            They are taken one by one, so two are in memory at a time.
    """
    sums, count = dict.fromkeys(PROTOCOLS, 0.0), 0
    before: tuple[Tensor, Tensor, Tensor] | None = None
    for now in frames:
        if before is not None:
            flow, truth = horn_schunck(before[0], now[0]), horn_schunck(before[1], now[1])
            sums["flow_length_px"] += flow_length(flow)
            sums["flow_length_truth_px"] += flow_length(truth)
            sums["flow_error_px"] += flow_error(flow, truth)
            sums["flow_error_mask_px"] += flow_error(flow, truth, (before[2] > 0.5) | (now[2] > 0.5))
            count += 1
        before = now
    return {name: total / count for name, total in sums.items()} if count else {}
