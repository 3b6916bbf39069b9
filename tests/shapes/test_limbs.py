"""Limbs of hands, robots and odd trees."""

import torchreg as tr
from tests.shapes.kinds import at
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.limbs import find_limbs
from torchreg.shapes.primitives import Primitive


def limbs_of(joints, frames):
    rod = Primitive("capsule", (0.1, 0.05), at())
    return find_limbs(tr.ArticulatedShape(KinematicTree(tuple(joints)), frames, [rod] * len(frames), nu=0.01))


def test_the_limbs_of_a_hand_are_its_fingers(hand):
    limbs, trunk = find_limbs(hand)
    assert trunk == [0]
    assert [limb.parts for limb in limbs] == [[3 * finger + 1 + bone for bone in range(3)] for finger in range(5)]
    assert [len(limb.dofs) for limb in limbs] == [5, 4, 4, 4, 4]
    assert sorted(dof for limb in limbs for dof in limb.dofs) == list(range(6, 27))
    assert {limb.level for limb in limbs} == {0}
    assert [body.parent for body in limbs[1].bodies] == [0, 4, 5]


def test_a_chain_is_one_limb_and_parts_that_move_as_one_are_one_body():
    joints = [
        Joint("base", -1, at(0.0)),
        Joint("plate", 0, at(0.1)),
        Joint("arm", 0, at(0.2), "revolute"),
        Joint("cover", 2, at(0.1)),
        Joint("hand", 3, at(0.3), "prismatic"),
    ]
    limbs, trunk = limbs_of(joints, ["base", "plate", "arm", "cover", "hand"])
    assert trunk == [0, 1]
    assert len(limbs) == 1
    assert [body.parts for body in limbs[0].bodies] == [(2, 3), (4,)]
    assert [body.dofs for body in limbs[0].bodies] == [(6,), (7,)]


def test_limbs_that_hang_on_limbs_come_after_them():
    joints = [
        Joint("pelvis", -1, at(0.0)),
        Joint("spine", 0, at(0.2), "revolute"),
        Joint("leg", 0, at(-0.2), "revolute"),
        Joint("left", 1, at(0.1), "revolute"),
        Joint("right", 1, at(0.2), "revolute"),
        Joint("fist", 4, at(0.2), "revolute"),
    ]
    limbs, trunk = limbs_of(joints, ["pelvis", "spine", "leg", "left", "right", "fist"])
    assert trunk == [0]
    assert [(limb.parts, limb.level) for limb in limbs] == [([1], 0), ([2], 0), ([3], 1), ([4, 5], 1)]


def test_a_mimic_joint_belongs_to_the_limb_that_it_follows():
    joints = [
        Joint("palm", -1, at(0.0)),
        Joint("jaw", 0, at(0.1), "prismatic", lower=0.0, upper=0.1),
        Joint("other", 0, at(-0.1), "prismatic", mimic=(1, -1.0, 0.0)),
    ]
    limbs, trunk = limbs_of(joints, ["palm", "jaw", "other"])
    assert [limb.dofs for limb in limbs] == [[6], []]
    assert trunk == [0]


def test_a_moving_first_part_is_a_limb_of_the_base():
    joints = [Joint("world", -1, at(0.0)), Joint("arm", 0, at(0.1), "revolute")]
    limbs, trunk = limbs_of(joints, ["arm"])
    assert trunk == []
    assert limbs[0].bodies[0].parent == -1
