"""The perceptual loss of recipes that have one: its network is no part of a recipe or a checkpoint."""

from twofold.methods.base import Avatar
from twofold.metrics.perceptual import load_lpips, weights_hint


def attach_perceptual(avatar: Avatar) -> str | None:
    """Gives the avatar the network of its perceptual loss where its recipe has one.

    Returns:
        A sentence for the run's notes: that the loss has LPIPS, or which file it lacks; None where none is wanted.
    """
    if not avatar.wants_perceptual:
        return None
    network = load_lpips()
    avatar.attach_perceptual(network)
    return weights_hint() if network is None else "LPIPS is part of the loss."
