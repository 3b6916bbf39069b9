import math

import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("scenes") as module:
        yield module


def test_a_thing_that_is_there_is_seen_where_its_pose_is(bench):
    for scene in (bench.hand_scene(4, there=True), bench.arm_scene(1, there=True)):
        pixels, depth = scene.frame.camera.project(scene.shape.keypoints(scene.pose).double())
        column, row = pixels.round().long().unbind(-1)
        inside = (column >= 0) & (column < bench.WIDTH) & (row >= 0) & (row < bench.HEIGHT)
        # Keypoints lie inside the thing, whose surface hides them; of a fingertip a pixel may be beside it.
        nearer = scene.frame.depth[row[inside], column[inside]] < depth[inside] + 0.02
        assert float(nearer.double().mean()) > 0.7
        assert bench.is_right(scene, scene.pose)
        off = scene.pose.clone()
        off[0] += 0.03
        assert not bench.is_right(scene, off)


def test_a_picture_is_the_same_for_a_seed_and_nothing_is_right_where_nothing_is(bench):
    first, again = (bench.arm_scene(3, there=False) for _ in range(2))
    assert torch.equal(first.frame.depth, again.frame.depth)
    assert first.pose is None
    assert not bench.is_right(first, first.shape.rest_pose())


def test_the_weights_are_those_that_made_the_cases(bench):
    generator = torch.Generator().manual_seed(1)
    evidence = torch.rand(3000, len(bench.CALIBRATION.weights), generator=generator) * 0.3
    weights = torch.tensor([*bench.CALIBRATION.weights[:-2], 6.0, 2.0])
    right = torch.rand(3000, generator=generator) < torch.sigmoid(bench.CALIBRATION.bias - evidence @ weights)
    rows = [
        bench.Row("hand", True, bool(is_right), True, 0.5, row, 1.0)
        for is_right, row in zip(right, evidence, strict=True)
    ]
    assert bench.calibrated(rows) == pytest.approx((6.0, 2.0), abs=0.8)
    assert "sure and wrong" in bench.render(rows)
    assert not math.isnan(bench.calibrated(rows)[0])
