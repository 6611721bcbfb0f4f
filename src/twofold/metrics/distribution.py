"""How far a set of rendered images is from a set of photographs: KID and FID over features of a network."""

import torch
from jaxtyping import Float
from torch import Tensor

from twofold.errors import TwofoldError

SUBSETS, SUBSET_SIZE = 100, 1000
"""Subsets of KID, and the most images in one."""
_FEATURES = (
    "Inception 2015 features of whole images, 8 bit, resized to 299 x 299 as floats by PIL's bicubic filter, clipped"
)
PROTOCOLS = {
    "kid_x1000": f"1000 times the unbiased squared MMD with the kernel (x.y / 2048 + 1)^3, mean of {SUBSETS} subsets "
    f"of min(images, {SUBSET_SIZE}) drawn without replacement; {_FEATURES}",
    "fid": "Frechet distance of two normal distributions; far too high for fewer than some thousand images; "
    f"{_FEATURES}",
}
"""What each number is, in one line."""


def polynomial_mmd(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> float:
    r"""Unbiased squared maximum mean discrepancy with the kernel $k(a, b) = (a \cdot b / d + 1)^3$.

    $$\frac{\sum_{i \ne j} k(x_i, x_j)}{n (n - 1)} + \frac{\sum_{i \ne j} k(y_i, y_j)}{m (m - 1)}
    - \frac{2}{n m} \sum_{i, j} k(x_i, y_j)$$

    Being unbiased, it may be slightly negative.

    >>> x = torch.tensor([[1.0], [-1.0]])
    >>> polynomial_mmd(x, x)  # 0 + 0 - 2 (8 + 0 + 0 + 8) / 4
    -8.0

    Raises:
        TwofoldError: a set has fewer than two members.
    """
    n, m = len(x), len(y)
    if min(n, m) < 2:
        raise TwofoldError(f"KID needs at least 2 images of each kind, it got {min(n, m)}; measure more.")
    x, y = x.double(), y.double()

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        return (a @ b.T / a.shape[1] + 1) ** 3

    xx, yy = kernel(x, x), kernel(y, y)
    within = (xx.sum() - xx.trace()) / (n * (n - 1)) + (yy.sum() - yy.trace()) / (m * (m - 1))
    return (within - 2 * kernel(x, y).mean()).item()


def kid(
    features: Float[Tensor, "n d"], true_features: Float[Tensor, "m d"], generator: torch.Generator,
    subsets: int = SUBSETS, size: int = SUBSET_SIZE,
) -> float:  # fmt: skip
    r"""Kernel inception distance (Binkowski et al. 2018): mean of `polynomial_mmd` over random subsets.

    Args:
        features: of the rendered images.
        true_features: of the photographs.
        generator: draws the subsets, of $\min(n, m, \mathrm{size})$ members without replacement. Where both sets have
            just as many, every subset is the whole and nothing is drawn.
        subsets: how many.
        size: largest size of a subset.

    >>> x = torch.tensor([[1.0], [-1.0]])
    >>> kid(x, x, torch.Generator())
    -8.0

    Raises:
        TwofoldError: a set has fewer than two members.
    """
    n, m = len(features), len(true_features)
    count = min(n, m, size)
    if n == m == count:
        return polynomial_mmd(features, true_features)
    total = 0.0
    for _ in range(subsets):
        ours, theirs = (torch.randperm(k, generator=generator)[:count] for k in (n, m))
        total += polynomial_mmd(features[ours], true_features[theirs])
    return total / subsets


def fid(features: Float[Tensor, "n d"], true_features: Float[Tensor, "m d"]) -> float:
    r"""Frechet distance of the normal distributions with the features' means and covariances (Heusel et al. 2017).

    $$\|\mu - \nu\|^2 + \mathrm{tr}\, \Sigma + \mathrm{tr}\, \Lambda - 2\, \mathrm{tr}\, (\Sigma \Lambda)^{1/2}$$

    With $\Sigma = A A^T$ and $\Lambda = B B^T$ the last trace is the sum of the singular values of $A^T B$, so no root
    of a 2048 x 2048 matrix is taken where there are fewer images than that.

    >>> x = torch.tensor([[0.0], [2.0]])
    >>> round(fid(x, x + 3), 6), round(fid(x, 2 * x - 1), 6)  # means 3 apart; deviations sqrt(2) and 2 sqrt(2)
    (9.0, 2.0)

    Raises:
        TwofoldError: a set has fewer than two members.
    """
    if min(len(features), len(true_features)) < 2:
        few = min(len(features), len(true_features))
        raise TwofoldError(f"FID needs at least 2 images of each kind, it got {few}; measure more.")
    x, y = features.double(), true_features.double()
    a, b = _root(x), _root(y)
    apart = (x.mean(0) - y.mean(0)).square().sum()
    root = torch.linalg.svdvals(a.T @ b).sum()
    return max((apart + a.square().sum() + b.square().sum() - 2 * root).item(), 0.0)


def _root(features: Float[Tensor, "n d"]) -> Float[Tensor, "d k"]:
    """A matrix A with A A^T the covariance, of min(n, d) columns."""
    centred = (features - features.mean(0)) / (len(features) - 1) ** 0.5
    if len(features) <= features.shape[1]:
        return centred.T
    values, vectors = torch.linalg.eigh(centred.T @ centred)
    return vectors * values.clamp_min(0).sqrt()
