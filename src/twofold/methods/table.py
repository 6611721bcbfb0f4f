"""The methods: one line each. Recipes, command-line choices and tests are made from this table."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from twofold.capture.types import Capture
from twofold.config import KIND, from_dict, to_dict, with_overrides
from twofold.errors import TwofoldError
from twofold.inputs import shown
from twofold.methods import danbo, factorized_recipes, humannerf, monohuman, npc, pm_avatar, vid2avatar_recipes
from twofold.methods.base import MethodConfig
from twofold.methods.danbo import DanboConfig
from twofold.methods.factorized import FactorizedConfig
from twofold.methods.humannerf import HumanNerfConfig
from twofold.methods.monohuman import MonoHumanConfig
from twofold.methods.npc import NpcConfig
from twofold.methods.pm_avatar import PmAvatarConfig
from twofold.methods.stored import completed
from twofold.methods.vid2avatar import Vid2AvatarConfig
from twofold.recipe import Recipe, TrainingConfig


@dataclass(frozen=True)
class Method:
    """A method: its configuration class and its recipes by name."""

    config: type[MethodConfig]
    recipes: dict[str, Callable[[], Recipe]]


METHODS: dict[str, Method] = {
    "factorized": Method(FactorizedConfig, factorized_recipes.RECIPES),
    "danbo": Method(DanboConfig, danbo.RECIPES),
    "humannerf": Method(HumanNerfConfig, humannerf.RECIPES),
    "monohuman": Method(MonoHumanConfig, monohuman.RECIPES),
    "npc": Method(NpcConfig, npc.RECIPES),
    "pm_avatar": Method(PmAvatarConfig, pm_avatar.RECIPES),
    "vid2avatar": Method(Vid2AvatarConfig, vid2avatar_recipes.RECIPES),
}
"""Every method by its name. A recipe stored without a kind is of the first."""

RECIPES: dict[str, Callable[[], Recipe]] = {
    name: recipe for method in METHODS.values() for name, recipe in method.recipes.items()
}
"""What `--recipe` offers; the first is the default."""


@dataclass(frozen=True)
class _Rest:
    """A recipe without its method, for reading."""

    name: str
    training: TrainingConfig = TrainingConfig()
    seed: int = 0


RENAMES: dict[str, str] = {
    "training.rate_low": "method.rates.low",
    "training.rate_high": "method.rates.high",
    "training.rate_grid": "method.rates.grid",
    "training.rate_beta": "method.rates.beta",
    "training.rate_pose": "method.rates.pose",
    "method.sampler.least_weight": "method.sampler.min_weight",
    "method.sampler.stray": "method.sampler.miswarp_slack",
    "method.sampler.table_voxel": "method.sampler.sdf_grid_voxel",
}
"""Settings that had another name: stored recipes and `--set` may use either."""

DROPPED = ("training.pixels.rounded",)
"""Settings that stored recipes may have and that have no effect any more."""


def with_settings(recipe: Recipe, settings: Sequence[str]) -> Recipe:
    """The recipe with settings such as "training.steps=500" changed; old names count as the new ones.

    Raises:
        TwofoldError: an unknown setting, or a value that does not fit.
    """
    renamed = [RENAMES.get(key, key) + equals + value for key, equals, value in (s.partition("=") for s in settings)]
    return with_overrides(recipe, renamed)


def learning_rates(recipe: Recipe) -> dict[str, float]:
    """The method's learning rates by the names of their settings.

    >>> learning_rates(RECIPES["danbo"]())
    {'method.rates.all': 0.0005}
    """
    return {f"method.rates.{name}": rate for name, rate in to_dict(recipe.method.rates).items()}


def with_steps(recipe: Recipe, steps: int) -> Recipe:
    """The recipe over another number of steps, all stages together, with its whole schedule shortened or stretched.

    >>> npc = with_steps(RECIPES["npc_fast"](), 500)
    >>> npc.method.first_steps + npc.training.steps
    500
    """
    method = cast(MethodConfig, recipe.method)
    factor = steps / method.total_steps(recipe.training)
    scaled = replace(recipe, method=method.scaled(factor), training=recipe.training.scaled(factor))
    own = scaled.method.total_steps(scaled.training) - scaled.training.steps
    training = replace(scaled.training, steps=max(steps - own, 1))  # rounding aside
    return replace(scaled, training=training)


def chosen_recipe(
    name: str, settings: Sequence[str] = (), seed: int = 0, completion: bool | None = None, steps: int | None = None
) -> Recipe:
    """A recipe of the table with what a user changes in it.

    Args:
        name: of `RECIPES`.
        settings: such as "training.pixels.rays=500"; they hold whatever the other arguments change.
        seed: of everything random.
        completion: whether unobserved regions are completed; None as the recipe has it.
        steps: of the training, with the whole schedule scaled to it; None as the recipe has them.

    Raises:
        TwofoldError: no such recipe, an unknown setting, a value that does not fit, no completion.
    """
    if name not in RECIPES:
        raise TwofoldError(f"There is no recipe {name!r}; there are {', '.join(RECIPES)}.")
    recipe = RECIPES[name]()
    if steps is not None:
        recipe = with_steps(recipe, steps)
    if completion is not None:
        recipe = with_completion(recipe, completion)
    return with_settings(recipe, [f"seed={seed}", *settings])


def fitted(recipe: Recipe, capture: Capture) -> tuple[Recipe, str | None]:
    """The recipe with what its method leaves to a capture settled, and what to tell the user about that."""
    method, note = cast(MethodConfig, recipe.method).fitted(capture)
    return replace(recipe, method=method), note


def with_completion(recipe: Recipe, on: bool) -> Recipe:
    """The recipe with unobserved regions completed, or left as they come.

    Raises:
        TwofoldError: its method cannot complete them.
    """
    method = cast(MethodConfig, recipe.method).completing(on)
    return replace(recipe, method=method)


def _renamed(data: dict[str, Any]) -> dict[str, Any]:
    """Stored settings under their present names."""
    new = json.loads(json.dumps(data))
    for old in DROPPED:
        path = [str(name) for name in old.split(".")]
        (_inside(new, path[:-1]) or {}).pop(path[-1], None)
    for old, present in RENAMES.items():
        path, target = [str(name) for name in old.split(".")], [str(name) for name in present.split(".")]
        place = _inside(new, path[:-1])
        above = _inside(new, target[:-2])
        if place is None or path[-1] not in place or above is None:
            continue
        value = place.pop(path[-1])
        into = above.setdefault(target[-2], {})
        if isinstance(into, dict):
            into.setdefault(target[-1], value)
    return new


def _inside(data: dict[str, Any], path: Sequence[str]) -> dict[str, Any] | None:
    """The object at a path, or None where there is none."""
    found: Any = data
    for name in path:
        found = found.get(name) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else None


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """A recipe as JSON data; the method's configuration carries the name of its class."""
    method = {KIND: type(recipe.method).__name__, **to_dict(recipe.method)}
    return {"name": recipe.name, "method": method, "training": to_dict(recipe.training), "seed": recipe.seed}


def recipe_from_dict(data: object, where: str) -> Recipe:
    """What `recipe_to_dict` gave, read back.

    Args:
        data: JSON data.
        where: the file, for messages.

    Raises:
        TwofoldError: an unknown method or setting, or a value that does not fit.
    """
    if not isinstance(data, dict):
        raise TwofoldError(f"{where} should hold an object with a recipe; it holds {type(data).__name__}.")
    whole = cast(dict[str, Any], completed(_renamed(cast(dict[str, Any], data))))
    method = whole.get("method")
    if not isinstance(method, dict):
        raise TwofoldError(f"{where} lacks the method's settings, an object called method; it is damaged.")
    settings = dict(cast(dict[str, Any], method))
    classes = {m.config.__name__: m.config for m in METHODS.values()}
    kind = settings.pop(KIND, next(iter(classes)))
    if not isinstance(kind, str) or kind not in classes:
        raise TwofoldError(f"method in {where} has the unknown kind {shown(kind)}; known are {', '.join(classes)}.")
    rest = from_dict(_Rest, {name: value for name, value in whole.items() if name != "method"}, where)
    chosen = from_dict(classes[kind], settings, f"method in {where}")
    try:
        return Recipe(rest.name, chosen, rest.training, rest.seed)
    except ValueError as error:
        raise TwofoldError(f"{where} is not possible: {error}.") from error
