"""`twofold view`, and the viewer of `twofold train --view`."""

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from twofold.cli.advice import require_capture
from twofold.cli.console import ALONE, console, say
from twofold.errors import TwofoldError
from twofold.inputs import is_there

if TYPE_CHECKING:
    from twofold.capture.types import Capture
    from twofold.methods.base import Avatar


@dataclass(frozen=True)
class LiveView:
    """The viewer of a training."""

    view: bool = False
    """Shows the avatar in a browser while it learns."""
    host: str = "127.0.0.1"
    """Address of the viewer (--view); 0.0.0.0 lets other machines in."""
    port: int | None = None
    """Port of the viewer (--view); by default the first free one from 8080."""


NO_VIEW = LiveView()


def view(
    source: Annotated[Path, tyro.conf.Positional],
    host: str = "127.0.0.1",
    port: int | None = None,
    capture: Path | None = None,
    out: Path | None = None,
    device: str = "auto",
) -> None:
    """Show a run's avatar, or a capture, in a browser: orbit, scrub, pose, switch branches, save.

    Args:
        source: Run folder or capture folder.
        host: Address to listen on; by default only this machine can connect, 0.0.0.0 lets others in.
        port: Port to listen on; by default the first free one from 8080.
        capture: Capture folder of a run, if it has moved since training.
        out: Folder for what is saved; by default RUN/viewer, or NAME-viewer in the current folder for a capture.
        device: auto, cpu, cuda or cuda:N.
    """
    from twofold.training.run import choose_device, find_capture
    from twofold.viewer.server import choose_port, require_viser
    from twofold.viewer.session import ViewSession
    from twofold.viewer.viewed import open_capture, open_run

    require_viser()
    where, number = choose_device(device), choose_port(host, port)
    if is_there(source / "recipe.json"):
        try:
            found = find_capture(source, capture)
        except TwofoldError:
            found = None  # the viewer says what it lacks
        viewed, folder = open_run(source, found, where), out or source / "viewer"
    else:
        require_capture(source)
        if capture is not None:
            raise TwofoldError(f"{source} is no run; --capture names the capture of a run, leave it out.")
        viewed, folder = open_capture(source), out or Path(f"{source.resolve().name}-viewer")
    with ViewSession(viewed, host, number, folder) as session:
        _announce(session.address, host, port, folder)
        for note in viewed.notes:
            console().print(note, soft_wrap=True)
        session.wait()
        saved = f"What was saved is in {folder}." if session.saved else "Nothing was saved."
    following = f"twofold export {source}" if viewed.avatar is not None else f"twofold train {source}"
    say(f"The viewer is closed. {saved}", following)


def _announce(address: str, host: str, asked: int | None, folder: Path) -> None:
    from twofold.viewer.server import FIRST_PORT, is_loopback

    console().print(f"The viewer is at {address}; open it in a browser. Ctrl-C ends it.", soft_wrap=True)
    if asked is None and not address.endswith(f":{FIRST_PORT}"):
        console().print(f"Port {FIRST_PORT} is taken, so it is another one.", soft_wrap=True)
    if not is_loopback(host):
        console().print(
            f"Everybody who can reach {host} sees the person, and can save files into {folder}.", soft_wrap=True
        )


class _Training:
    """What a training calls: with the avatar, and after each step."""

    def __init__(self, attach: "Callable[[Avatar], None]", step: Callable[[], None]) -> None:
        self._attach, self._step = attach, step

    def before_first(self, avatar: "Avatar") -> str | None:
        """Takes the new avatar, and attaches its perceptual network; see `loop.train`."""
        from twofold.training.perceptual_loss import attach_perceptual

        self._attach(avatar)
        return attach_perceptual(avatar)

    def after_step(self, _shown: None) -> None:
        """Lets the viewer render what is due, when progress has been shown."""
        self._step()


@contextlib.contextmanager
def training_view(options: LiveView, capture: "Capture", folder: Path) -> Generator[_Training, None, None]:
    """A viewer that shows an avatar while it is trained; without --view nothing.

    Args:
        options: of the command line.
        capture: that is trained on.
        folder: the run.

    Raises:
        TwofoldError: a port or an address that cannot be used, or a package that is missing.
    """
    if not options.view and options != NO_VIEW:
        raise TwofoldError("--host and --port are the viewer's; add --view, or leave them out.")
    if not options.view or not ALONE:
        yield _Training(lambda _: None, lambda: None)
        return
    from dataclasses import replace

    from twofold.viewer.field_source import TrainingField
    from twofold.viewer.server import choose_port
    from twofold.viewer.session import ViewSession
    from twofold.viewer.viewed import view_capture

    field = TrainingField()
    viewed = replace(view_capture(capture), title=f"training {folder.name}")
    number = choose_port(options.host, options.port)
    with ViewSession(viewed, options.host, number, folder / "viewer", source=field, bake=False) as session:
        _announce(session.address, options.host, options.port, folder / "viewer")
        try:
            yield _Training(field.attach, field.between_steps)
        finally:
            field.close()
