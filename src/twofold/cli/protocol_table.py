"""`evaluate --protocol all`: which networks it uses, and its table."""

from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from twofold.cli.console import console
from twofold.errors import TwofoldError

if TYPE_CHECKING:
    from twofold.metrics.protocols import Networks


def networks_asked_for(protocol: str, weights: Path | None, unverified: bool) -> "Networks | None":
    """The networks of `--protocol all`, where their weights are there; None for the default protocol.

    Raises:
        TwofoldError: weights are named that are not used, the folder is missing, or a file in it is not accepted.
    """
    if protocol == "default":
        if weights is not None or unverified:
            raise TwofoldError("--weights and --unverified-weights need --protocol all; the default uses no network.")
        return None
    if weights is not None and not weights.is_dir():
        raise TwofoldError(f"{weights} is not a folder; name the one that holds the weights, or leave --weights out.")
    from twofold.metrics.protocols import load_networks

    return load_networks(weights, unverified or None)


def print_protocols(section: str, values: object) -> None:
    """A row for each setting; what needs absent weights says which file to put where."""
    from twofold.metrics.protocols import METRICS, SETTINGS, UNVERIFIED

    if not isinstance(values, dict):
        return
    protocol = values["protocol"]
    marked = False

    def cell(name: str) -> str:
        nonlocal marked
        value = values[name]
        if not isinstance(value, float):
            return str(value)
        other = protocol[name].endswith(UNVERIFIED)
        marked = marked or other
        return f"{value:.4g}{'*' if other else ''}"

    table = Table("setting", *METRICS, title=section.replace("_", " "))
    for name in SETTINGS:
        table.add_row(name, *(cell(f"{name}_{metric}") for metric in METRICS))
    console().print(table)
    for name in ("kid_x1000", "fid", "ms_ssim", "gradient_error"):
        console().print(f"{name}: {cell(name)}", soft_wrap=True)
    if marked:
        console().print("* with unverified weights, not the published ones", soft_wrap=True)
