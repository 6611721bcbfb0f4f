"""The meshes that move: the bare body at once, the baked avatar as soon as it is there."""

from collections.abc import Callable
from typing import final

from twofold.errors import TwofoldError, install_command
from twofold.outputs.export.bake_cache import BakeCache, open_cache
from twofold.outputs.export.character import Character
from twofold.outputs.export.make import Baked, bake
from twofold.outputs.export.write import missing_packages, require_surface
from twofold.outputs.mesh_motion import CONFIG
from twofold.viewer.view_images import Part, body_character, residual_character
from twofold.viewer.viewed import Viewed

Progress = Callable[[float, str], None]


@final
class Meshes:
    """A mesh for each part of the avatar; `version` counts how often they have changed.

    Attributes:
        baked: the baked avatar; None until it is there.
        note: why the bare body moves, as a sentence; empty where the avatar does.
    """

    def __init__(self, viewed: Viewed) -> None:
        self._viewed = viewed
        self._body = body_character(viewed.body)
        self._parts: dict[Part, Character] = {}
        self.version = 0
        self.baked: Baked | None = None
        self.note = "" if viewed.avatar is None else "The mesh is being baked; until then the bare body moves."

    def of(self, part: Part) -> tuple[Character, bool]:
        """The mesh of a part, and whether it is the bare body, which has no colours of its own."""
        found = self._parts.get(part)
        return (self._body, True) if found is None else (found, False)

    def bake(
        self, progress: Progress = lambda _done, _note: None, note: Callable[[str], None] = lambda _: None
    ) -> None:
        """Bakes the avatar, or takes it from the run's folder; the bare body stays where that is not possible.

        Args:
            progress: called with the fraction that is done and what comes next.
            note: called with sentences about the cache.
        """
        try:
            self._bake(progress, note)
        except TwofoldError as error:
            self.note = f"The bare body moves, the field is rendered when nothing does: {error}"
            self.version += 1

    def _bake(self, progress: Progress, note: Callable[[str], None]) -> None:
        viewed = self._viewed
        if viewed.avatar is None:
            return
        if viewed.capture is None:
            raise TwofoldError("the run's capture, whose poses the bake needs, is gone; name it with --capture.")
        if missing := missing_packages(CONFIG):
            raise TwofoldError(f"baking needs {' and '.join(missing)}; run {install_command('export')}.")
        require_surface(viewed.avatar)
        cache = None if viewed.run is None else open_cache(viewed.run, viewed.capture, note)
        self.baked = self._colored("full", cache, progress)
        self._use({"full": self.baked.character})
        if viewed.has_base:
            base = self._colored("base", cache, progress).character
            self._use({"base": base, "residual": residual_character(self.baked.character, base)})
        self.note = ""
        self.version += 1

    def _colored(self, color: Part, cache: BakeCache | None, progress: Progress) -> Baked:
        viewed = self._viewed
        assert viewed.avatar is not None
        assert viewed.capture is not None
        return bake(viewed.avatar, viewed.capture, CONFIG, color, viewed.title, progress, cache)

    def _use(self, parts: dict[Part, Character]) -> None:
        self._parts |= parts
        self.version += 1
