"""A recipe: all that decides a run beside its capture. Configuration only."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from twofold.config import MAX_SEED, require_within


def scaled_count(count: int, factor: float) -> int:
    """A number of steps or epochs multiplied, at least one; zero, which means from the start or never, stays.

    >>> scaled_count(300, 0.5), scaled_count(1, 0.1), scaled_count(0, 3.0)
    (150, 1, 0)
    """
    return max(round(count * factor), 1) if count else 0


@dataclass(frozen=True)
class PixelConfig:
    """How the rays of a step are chosen from an image."""

    rays: int = 576
    """Single pixels, from the subject's box and around it."""
    subject_share: float = 0.7
    """Share of these that come from the subject's surroundings; the rest from all of the posed body's box."""
    surroundings: int | None = None
    """Surroundings are pixels at most this far from the mask; none: the mask's bounding box, as released."""
    patches: int = 2
    """Square patches, whose pixels also go to the perceptual loss."""
    patch_size: int = 24
    """Edge of a patch, pixels."""
    patch_on_subject: float = 0.9
    """Probability that a patch is centred on the subject."""
    reachable: Literal["body", "box", "image"] = "body"
    """Pixels beside the subject: "body", near the body or the mask; "box", all whose rays meet the box of the joints of
    the pose as given, as released; "image", all of the image, for methods that learn the background."""
    subject: Literal["half", "any"] = "half"
    """Pixels of the subject: "half", those that it covers by more than half, in their whole bounding box; "any", as
    released, those that it covers at all, in that box without its last row and column."""
    between: bool = False
    """Whether a single ray passes anywhere in its pixel's square, with colours interpolated between pixels."""
    replacement: bool = True
    """Whether the same single pixel may be drawn twice; the release draws without replacement."""
    memory_gb: float = 1.0
    """Memory for the parts of the training images that show the person, GiB; what it does not hold lies in a temporary
    file. Batches are the same."""

    def __post_init__(self) -> None:
        """Refuses choices with which no image gives pixels, or more than any machine takes."""
        require_within(
            self, rays=(0, 1_000_000), subject_share=(0, 1), surroundings=(0, 10_000), patches=(0, 1000),
            patch_size=(1, 1024), patch_on_subject=(0, 1), memory_gb=(0, 1e6),
        )  # fmt: skip
        if self.rays == 0 and self.patches == 0:
            raise ValueError("rays=0 and patches=0 leave no pixels; set one of them")


@dataclass(frozen=True)
class TrainingConfig:
    """How an avatar is trained; the defaults are the authors' release."""

    steps: int = 200_000
    images_per_step: int = 2
    """Images whose gradients are averaged; each of N processes takes an N-th of them."""
    pixels: PixelConfig = PixelConfig()
    milestones: tuple[int, ...] = (200, 400)
    """Epochs after which the rates are halved; an epoch sees every training image once."""
    epochs: Literal["images", "steps"] = "images"
    """How long an epoch is: "images", as many images as there are, wherever in a step it ends; "steps", as released,
    whole steps, the last one of which begins the images again where they do not come out even."""
    warmup: int = 0
    """Steps over which the rates rise from zero."""
    decay: float = 1.0
    """What the rates are multiplied with in the end, approached exponentially after `decay_from`; 1 for no decay."""
    decay_from: float = 0.3
    """Share of the steps before that decay begins."""
    adam_betas: tuple[float, float] = (0.9, 0.999)
    adam_epsilon: float = 1e-8
    clip: float = 1.0
    """Largest global norm of the gradient; 0 for no limit."""
    checkpoint_every: int = 500
    preview_every: int = 1000
    """Steps between two preview images; 0 for none."""
    camera_colors: Literal["off", "first", "mean"] = "off"
    """Whether each of several training cameras has a learned gain and offset of its colours, and whose colours the
    avatar then has: those of the first training camera or the mean of all. One camera needs none."""
    compile: Literal["never", "auto", "always"] = "never"
    """Whether dense networks run compiled (torch.compile): "auto" on a GPU only. The first step then takes minutes."""

    def __post_init__(self) -> None:
        """Refuses numbers with which nothing can be trained."""
        most = 100_000_000
        require_within(
            self, steps=(1, most), images_per_step=(1, 1000), checkpoint_every=(1, most), preview_every=(0, most),
            warmup=(0, most), milestones=(0, most), decay=(1e-9, 1), decay_from=(0, 1), clip=(0, 1e6),
            adam_epsilon=(1e-30, 1),
        )  # fmt: skip
        # Steps are divided by the root plus epsilon; and means that keep nothing leave nothing to tell noise by.
        if not all(0 < beta < 1 for beta in self.adam_betas):
            raise ValueError(f"adam_betas={self.adam_betas} should lie between 0 and 1 and be neither")

    def scaled(self, factor: float) -> "TrainingConfig":
        """The same schedule stretched by a factor. Checkpoints and previews come as often as before."""
        return replace(
            self,
            steps=scaled_count(self.steps, factor),
            milestones=tuple(scaled_count(epoch, factor) for epoch in self.milestones),
            warmup=scaled_count(self.warmup, factor),
        )


@dataclass(frozen=True)
class Recipe:
    """All that decides a run beside its capture."""

    name: str
    method: Any
    """A method's configuration: a `MethodConfig` of `twofold.methods.base`. `recipe_from_dict` reads it by its kind."""
    training: TrainingConfig = TrainingConfig()
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses seeds that not every generator takes."""
        require_within(self, seed=(0, MAX_SEED))
