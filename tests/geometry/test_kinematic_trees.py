"""The kinematic tree record: what it accepts, and that each impossible tree is refused with the frame's name."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.errors import ModelError
from torchreg.geometry.kinematic_tree import JOINT_TYPES, Joint, KinematicTree


def joint(name, parent, **fields):
    return Joint(name, parent, fields.pop("offset", torch.eye(4, dtype=torch.float64)), **fields)


def finger():
    return [
        joint("palm", -1),
        joint("base", 0, kind="revolute", lower=-0.3, upper=1.5),
        joint("tip", 1, kind="revolute", axis=(0.0, 0.6, 0.8), mimic=(1, 0.7, 0.0)),
    ]


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(KeyError, match="no frame is called 'thumb'; known: palm, base, tip"):
        KinematicTree(tuple(finger())).index("thumb")


@given(st.lists(st.integers(0, 10**6), max_size=12), st.integers(0, 2**31))
def test_any_topologically_ordered_tree_with_rigid_offsets_passes(draws, seed):
    joints = [joint("0", -1)]
    for index, draw in enumerate(draws, start=1):
        offset = torch.eye(4, dtype=torch.float64)
        offset[:3, :3] = torch.from_numpy(Rotation.random(random_state=seed + index).as_matrix())
        offset[:3, 3] = float(index)
        joints.append(joint(str(index), draw % index, offset=offset, kind=JOINT_TYPES[draw % 3]))
    assert len(KinematicTree(tuple(joints))) == len(draws) + 1


def matrix(**entries):
    """Return the identity with some entries replaced, keyed like ``m01`` for row 0, column 1."""
    value = torch.eye(4, dtype=torch.float64)
    for key, entry in entries.items():
        value[int(key[1]), int(key[2])] = entry
    return value


@pytest.mark.parametrize(
    ("index", "change", "message"),
    [
        (0, {"parent": 1}, "frame 'palm' must be the root"),
        (1, {"parent": -1}, "frame 'base' is a second root: the tree is disconnected"),
        (1, {"parent": 2}, r"frame 'base' \(index 1\) has parent index 2 of 3: .*cyclic"),
        (1, {"parent": 1}, "frame 'base' .*cyclic or out of order"),
        (1, {"parent": -2}, "frame 'base' .* has parent index -2 of 3"),
        (2, {"name": "palm"}, "frame names must be unique, these occur more than once: palm"),
        (1, {"kind": "ball"}, "joint 'base' has kind 'ball'; known: fixed, revolute, prismatic"),
        (1, {"offset": torch.eye(3)}, r"joint 'base' needs a finite \(4, 4\) offset"),
        (1, {"offset": matrix(m03=float("nan"))}, r"joint 'base' needs a finite \(4, 4\) offset"),
        (1, {"offset": matrix(m00=2.0)}, "joint 'base' has an offset that is not a rigid motion"),
        (1, {"offset": matrix(m01=0.5)}, "joint 'base' has an offset that is not a rigid motion"),
        (1, {"offset": matrix(m22=-1.0)}, "joint 'base' has an offset that is not a rigid motion"),
        (1, {"axis": (0.0, 0.0, 0.0)}, r"joint 'base' has axis .* of length 0.0; a unit vector is needed"),
        (1, {"axis": (0.0, 2.0, 0.0)}, "joint 'base' has axis .* of length 2.0"),
        (1, {"axis": (0.0, float("nan"), 0.0)}, "joint 'base' has axis .* of length nan"),
        (1, {"lower": 1.0, "upper": -1.0}, "joint 'base' has limits 1.0 to -1.0; lower must not exceed upper"),
        (1, {"lower": float("nan")}, "joint 'base' has limits nan"),
        (1, {"lower": float("inf"), "upper": float("inf")}, "'base' has limits inf to inf, which no finite value"),
        (1, {"axis": (0.6, 0.8)}, "joint 'base' has axis .* a unit vector is needed"),
        (1, {"offset": matrix(m30=0.1)}, "joint 'base' has an offset whose last row is .* it must be 0, 0, 0, 1"),
        (1, {"offset": matrix(m33=2.0)}, "joint 'base' has an offset whose last row is .* it must be 0, 0, 0, 1"),
        (2, {"mimic": (3, 1.0, 0.0)}, "joint 'tip' mimics the joint of index 3, but there are 3"),
        (2, {"mimic": (-1, 1.0, 0.0)}, "joint 'tip' mimics the joint of index -1, but there are 3"),
        (2, {"mimic": (2, 1.0, 0.0)}, "joint 'tip' follows itself through its mimic joints: tip"),
        (1, {"mimic": (2, 1.0, 0.0)}, "joint 'base' follows itself through its mimic joints: base, tip"),
        (2, {"mimic": (1, float("nan"), 0.0)}, "joint 'tip' has a mimic of multiplier nan"),
        (2, {"mimic": (1, 1.0, float("inf"))}, "joint 'tip' has a mimic of .*offset inf"),
        (2, {"mimic": (0, 1.0, 0.0)}, "joint 'tip' mimics 'palm': neither of the two may be fixed"),
        (2, {"kind": "fixed"}, "joint 'tip' mimics 'base': neither of the two may be fixed"),
    ],
)
def test_impossible_trees_are_refused_by_name(index, change, message):
    joints = finger()
    joints[index] = replace(joints[index], **change)
    with pytest.raises(ModelError, match=message):
        KinematicTree(tuple(joints))


def test_an_empty_tree_is_refused_and_fixed_joints_need_no_axis_nor_locked_ones_a_range():
    with pytest.raises(ModelError, match="the kinematic tree is empty"):
        KinematicTree(())
    assert len(KinematicTree((joint("palm", -1), joint("nail", 0, axis=(0.0, 0.0, 0.0))))) == 2
    KinematicTree((joint("palm", -1), joint("base", 0, kind="prismatic", lower=0.1, upper=0.1)))
