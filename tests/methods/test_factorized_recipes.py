from dataclasses import replace

import pytest
import torch

from twofold.config import with_overrides
from twofold.field.factorized import FactorizedFieldConfig
from twofold.methods.factorized import FactorizedConfig
from twofold.methods.factorized_recipes import ABLATIONS, ablation, paper, quick, released
from twofold.methods.table import RECIPES, recipe_from_dict, recipe_to_dict
from twofold.recipe import Recipe

# As the paper has them: [x,y] are octaves of the two branches, [a] is the detail branch alone.
PARAMETERS = {
    "wo_s1c1": 815_803, "wo_s2c2": 407_817, "wo_common_loss": 1_305_571, "wo_feat": 1_223_619, "pose_lf": 1_305_571,
    "wo_comm": 1_305_571, "[5]": 815_863, "[6]": 815_851, "[8]": 815_827, "[10]": 815_803, "[6,6]": 1_307_155,
    "[6,8]": 1_307_131, "[6,10]": 1_307_107, "[8,8]": 1_310_203, "[8,10]": 1_310_179, "[10,10]": 1_313_251,
}  # fmt: skip

# Every switch by which the authors' program (second) differs from their text (first).
SWITCHES = {
    "method.field.include_pi": (True, False),
    "method.field.gate_width": (None, 0.05),
    "method.field.base_color": ("linear", "sigmoid"),
    "method.field.color_sees_position": (False, True),
    "method.field.normals": ("canonical", "observation"),
    "method.field.pose_code": (None, 8),
    "method.field.feature_code": (None, 32),
    "method.losses.mask": (0.0, 0.1),
    "method.losses.s3im": (0.0, 0.1),
    "method.losses.eikonal": (3 * (576 + 2 * 24**2) * 0.1, 0.1),
    "method.losses.lpips": (3 * (576 + 2 * 24**2), 1.0),
    "method.losses.reduction": ("sum", "mean"),
    "method.pose.divide_by_pi": (False, True),
    "method.pose.with_root": (True, False),
    "method.pose.zero_until": (0, 10_000),
    "method.pose.zero_every": (0, 50),
    "method.rates.high": (5e-4, 2e-4),
    "method.rates.beta": (5e-4, 1e-4),
    "method.rates.pose": (5e-4, 5e-5),
    "training.adam_betas": ([0.9, 0.99], [0.9, 0.999]),
    "name": ("paper", "released"),
}


def settings(recipe: Recipe) -> dict[str, object]:
    """Every setting by its dotted key."""
    found: dict[str, object] = {}
    open_ = [("", recipe_to_dict(recipe))]
    while open_:
        prefix, values = open_.pop()
        for key, value in values.items():
            if isinstance(value, dict):
                open_.append((f"{prefix}{key}.", value))
            else:
                found[prefix + key] = value
    return found


def parameters(method: FactorizedConfig) -> int:
    """Of the field and the density's scale; poses come with the capture and are not counted."""
    assert isinstance(method.field, FactorizedFieldConfig)
    field = method.field.build(None, 72 if method.pose.with_root else 69, torch.Generator().manual_seed(0))
    return 1 + sum(parameter.numel() for parameter in field.parameters())


def test_released_has_the_published_number_of_parameters():
    assert parameters(released().method) == 1_305_571


@pytest.mark.parametrize(("name", "count"), PARAMETERS.items())
def test_ablations_have_the_published_number_of_parameters(name, count):
    assert parameters(ablation(name, released()).method) == count


def test_text_and_program_differ_in_these_switches_and_no_other():
    text, program = settings(paper()), settings(released())
    assert text.keys() == program.keys()
    assert {key: (text[key], program[key]) for key in text if text[key] != program[key]} == SWITCHES


def test_numbers_that_only_the_program_tells_are_the_same_in_both():
    wanted = {
        "method.field.low_octaves": 5, "method.field.high_octaves": 10, "method.field.width": 256,
        "method.field.low_sdf_depth": 4, "method.field.low_color_depth": 2, "method.field.high_sdf_depth": 8,
        "method.field.high_color_depth": 4, "method.field.high_skip": 3, "method.field.activation": "softplus",
        "method.field.weight_norm": True, "method.field.radius": 0.6, "method.sampler.refined": 128,
        "method.sampler.shaded": 64, "method.sampler.extra": 32, "method.sampler.rounds": 5,
        "method.sampler.ends": "released", "method.sampler.units": "scene", "method.sampler.box": "given",
        "method.losses.reconstruction": 1.0, "method.losses.common": 0.5, "method.losses.lpips_start": 20_001,
        "method.losses.lpips_dropout": 0.5, "method.losses.lpips_off_box": "picture",
        "method.losses.s3im_center": 2.0, "method.losses.eikonal_points": 512,
        "method.losses.eikonal_replacement": False, "method.losses.mask_form": "hard", "method.neighbours": 1,
        "method.late_neighbours": 7, "method.late_from": 100, "method.falloff": "scene",
        "method.normals_by": "canonical", "method.beta": 0.1001, "method.beta_floor": 1e-4,
        "method.beta_form": "absolute", "method.outliers_in_shading": False, "method.scene_scale": "released",
        "method.field.sdf_head": "tanh", "method.pose.epochs": "training", "method.pose.canonical_shape": "given",
        "method.pose.test_shape": "given", "training.epochs": "steps", "training.pixels.reachable": "box",
        "training.pixels.subject": "any", "training.pixels.replacement": False,
        "method.outlier_distance": 0.1, "method.pose.refine": ["root", "body", "translation", "shape"],
        "training.steps": 200_000, "training.images_per_step": 2, "method.rates.low": 5e-4,
        "training.milestones": [200, 400], "training.clip": 1.0, "training.pixels.rays": 576,
        "training.pixels.patches": 2, "training.pixels.patch_size": 24, "training.pixels.subject_share": 0.7,
    }  # fmt: skip
    for recipe in (paper(), released()):
        found = settings(recipe)
        assert {key: found[key] for key in wanted} == wanted


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_is_called_by_its_name_and_reads_back_from_json(name):
    recipe = RECIPES[name]()
    assert recipe.name == name
    assert recipe_from_dict(recipe_to_dict(recipe), "here") == recipe


@pytest.mark.parametrize("name", ABLATIONS)
@pytest.mark.parametrize("start", [quick, released])
def test_ablations_change_what_they_name_and_leave_the_common_loss_out_where_one_image_is_left(name, start):
    changed, full = settings(ablation(name, start())), settings(start())
    different = {key: changed[key] for key in full if changed[key] != full[key]} | {"name": changed["name"]}
    field = {f"method.field.{key}": value for key, value in ABLATIONS[name].items()}
    alone = {} if name in ("wo_feat", "pose_lf") else {"method.losses.common": 0.0}
    assert different == {**field, **alone, "name": f"{full['name']} {name}"}


def test_ten_octaves_alone_are_the_detail_branch_alone():
    first, second = ablation("[10]", released()), ablation("wo_s1c1", released())
    assert first.method == second.method


def test_pairs_of_octaves_keep_both_branches():
    method = ablation("[6, 8]", released()).method
    assert (method.field.low_octaves, method.field.high_octaves, method.losses.common) == (6, 8, 0.5)


@pytest.mark.parametrize(("name", "start"), [("w/o", released()), ("[8]", quick()), ("[1,2,3]", released())])
def test_an_ablation_that_does_not_exist_is_named_with_those_that_do(name, start):
    with pytest.raises(ValueError, match="wo_feat"):
        ablation(name, start)


def test_ablation_by_settings_is_the_ablation_by_name():
    by_settings = with_overrides(released(), ["method.field.branches=low", "method.losses.common=0"])
    assert replace(by_settings, name="released wo_s2c2") == ablation("wo_s2c2", released())
