"""Crops of whole pictures that may show a shape: those of a hand among other things."""

import torch

import torchreg as tr
from experiments.made_up.rooms import KINDS
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.search.crops import likely_crops
from torchreg.alignment.search.start_source import StartSource


def test_the_likeliest_crop_of_a_room_is_the_hand_in_it_without_its_forearm():
    scene = KINDS["hand"](4, True)
    skin = tr.sample_skin(scene.shape)
    crops = likely_crops(scene.frame, skin, StartSource.of(scene.shape))
    assert [crop.odds for crop in crops] == sorted((crop.odds for crop in crops), reverse=True)
    first = crops[0]
    assert (first.frame.mask & scene.shown).sum() > 0.6 * (first.frame.mask | scene.shown).sum()
    assert (scene.shape.keypoints(first.start) - scene.keypoints).norm(dim=-1).mean() < 0.04


def test_without_a_network_the_likeliest_piece_of_surfaces_shows_the_arm():
    scene = KINDS["arm"](5, True)
    crops = likely_crops(scene.frame, tr.sample_skin(scene.shape), StartSource.of(scene.shape))
    assert all(crop.start is None for crop in crops)
    shown = [int((crop.frame.mask & scene.shown).sum()) / int((crop.frame.mask | scene.shown).sum()) for crop in crops]
    assert shown[0] == max(shown) > 0.7
    assert crops[0].odds > len(crops) > sum(crop.odds for crop in crops if not (crop.frame.mask & scene.shown).any())


def test_of_an_arm_of_which_something_is_known_all_crops_have_even_odds():
    scene = KINDS["arm"](5, True)
    source = StartSource.of(scene.shape).with_known(KnownDofs.of(scene.shape, ["elbow"], None))
    crops = likely_crops(scene.frame, tr.sample_skin(scene.shape), source)
    assert {crop.odds for crop in crops} == {1.0}


def test_a_picture_of_nothing_has_no_crops(plain_hand):
    camera = tr.Camera(64, 48, (60.0, 60.0, 31.5, 23.5))
    wall = tr.DepthFrame(torch.full((48, 64), 1.5), camera)
    assert likely_crops(wall, tr.sample_skin(plain_hand), StartSource.of(plain_hand)) == []
