"""Each baseline, put together from its parts, has as many parameters as its authors' program.

Codes of frames (32 a frame for Vid2Avatar, 128 or 256 for NPC, DANBO and PM-Avatar) and one density scale come on top
where they are counted apart.
"""

import torch
from little_body import JOINTS
from torch import nn

from twofold.deform.pose_correction import PoseCorrection
from twofold.deform.weight_volume import WeightVolume, bone_prior, canonical_box
from twofold.field.bone_boxes import RIGID_PARTS, BoxSizes, initial_half_sizes
from twofold.field.conditioned_radiance import ConditionedRadiance
from twofold.field.implicit_geometry import ImplicitFieldConfig
from twofold.field.inverted_sphere import InvertedSphereFieldConfig
from twofold.field.local_volumes import LocalVolumes
from twofold.field.nerf import CanonicalNerf, ImageConditionedNerf, NonRigidMotion
from twofold.field.pixel_background import PixelBackground
from twofold.field.point_features import PointFeatures, PointRadiance
from twofold.field.points import PointCloud, PointDeformation
from twofold.field.pose_modulated import PoseModulatedField
from twofold.field.resunet import ResUNet, ViewBlending

JOINTS = torch.tensor(JOINTS)
DENSITY_SCALE = 1


def count(*modules: nn.Module) -> int:
    return sum(p.numel() for module in modules for p in module.parameters())


def weight_volume() -> WeightVolume:
    return WeightVolume(bone_prior(JOINTS, canonical_box(JOINTS)))


def test_vid2avatar():
    foreground = ImplicitFieldConfig().build()
    assert count(foreground) + DENSITY_SCALE == 815_851
    assert count(foreground, InvertedSphereFieldConfig().build()) + DENSITY_SCALE == 1_391_643


def test_humannerf():
    assert count(NonRigidMotion(), CanonicalNerf(), PoseCorrection(), weight_volume()) == 64_417_381


def test_monohuman():
    motions = [NonRigidMotion(), NonRigidMotion()]
    images = [ResUNet(), ViewBlending(with_unused_heads=True)]
    assert count(*motions, *images, ImageConditionedNerf(), PoseCorrection(), weight_volume()) == 73_676_456


def test_npc_and_danbo():
    half_sizes = initial_half_sizes(JOINTS)
    cloud = PointCloud(torch.rand(200, len(RIGID_PARTS), 3), JOINTS, half_sizes)
    npc = count(cloud, PointDeformation(), PointFeatures(), PointRadiance(), PixelBackground()) + DENSITY_SCALE
    assert npc == 2_580_473
    assert count(LocalVolumes(), ConditionedRadiance(195, 27), BoxSizes(half_sizes)) == 2_454_852


def test_pm_avatar():
    boxes = BoxSizes(initial_half_sizes(JOINTS))
    assert count(PoseModulatedField(), ConditionedRadiance(768, 16), boxes) == 3_011_684
