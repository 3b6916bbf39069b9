"""Conversions of a hand's pose and keypoints: MANO's joint rotations, keypoint orders, WebXR, OpenXR."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_shape
from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.rotation_representations import rotation_vector_from_rotation
from torchreg.shapes.hand import FINGER_NAMES, Hand

_KEYPOINTS = ("wrist", *(f"{finger}_{number}" for finger in FINGER_NAMES for number in range(1, 5)))
_MANO_FINGERS = ("index", "middle", "little", "ring", "thumb")
_MANO = (
    "wrist", *(f"{finger}_{number}" for finger in _MANO_FINGERS for number in range(1, 4)),
    *(f"{finger}_4" for finger in FINGER_NAMES),
)  # fmt: skip
_INTERHAND = (*(f"{finger}_{number}" for finger in FINGER_NAMES for number in range(4, 0, -1)), "wrist")

KEYPOINT_ORDERS: dict[str, tuple[str, ...]] = {
    "torchreg": _KEYPOINTS,
    "openpose": _KEYPOINTS,
    "mediapipe": _KEYPOINTS,
    "freihand": _KEYPOINTS,
    "mano": _MANO,
    "interhand": _INTERHAND,
}
"""Names of the 21 keypoints in the order of each convention; 1 is a finger's base joint, 4 its tip.

"mano" is MANO's 16 joints, then the tips, thumb to little finger.
"""

# MANO's 15 joints as parts of the hand.
_MANO_PARTS = tuple(3 * FINGER_NAMES.index(finger) + number for finger in _MANO_FINGERS for number in (1, 2, 3))
_PARTS = {"thumb": ("metacarpal", "proximal", "distal"), "long": ("proximal", "middle", "distal")}
_WEBXR_PARTS = {"metacarpal": None, "proximal": "proximal", "intermediate": "middle", "distal": "distal"}
# Alternations of two closed forms, the first of which is exact where the joint can make the rotation.
_ALTERNATIONS = 20


def _webxr() -> dict[str, tuple[str, str | None]]:
    """Return the part that moves with each WebXR joint, and the keypoint at its position."""
    joints: dict[str, tuple[str, str | None]] = {"wrist": ("palm", "wrist")}
    for finger in FINGER_NAMES:
        word = "thumb" if finger == "thumb" else f"{'pinky' if finger == 'little' else finger}-finger"
        segments = _PARTS["thumb" if finger == "thumb" else "long"]
        if finger == "thumb":
            joints["thumb-metacarpal"] = ("thumb_metacarpal", "thumb_1")
        else:
            joints[f"{word}-metacarpal"] = ("palm", None)
        bones = ("proximal", "distal") if finger == "thumb" else ("proximal", "intermediate", "distal")
        for bone in bones:
            segment = _WEBXR_PARTS[bone]
            number = segments.index(str(segment)) + 1
            joints[f"{word}-phalanx-{bone}"] = (f"{finger}_{segment}", f"{finger}_{number}")
        joints[f"{word}-tip"] = (f"{finger}_distal", f"{finger}_4")
    return joints


def _openxr_name(webxr: str) -> str:
    return webxr.replace("pinky", "little").replace("-finger", "").replace("phalanx-", "").replace("-", "_").upper()


_WEBXR = _webxr()
WEBXR_JOINTS: tuple[str, ...] = tuple(_WEBXR)
"""The 25 joints of WebXR Hand Input, in its order."""
OPENXR_JOINTS: tuple[str, ...] = ("PALM", *(_openxr_name(name) for name in WEBXR_JOINTS))
"""The 26 joints of OpenXR's XR_EXT_hand_tracking, in its order: ``XR_HAND_JOINT_<name>_EXT``."""
WEBXR_PARTS: dict[str, str] = {name: part for name, (part, _) in _WEBXR.items()}
"""The hand's part that moves with each WebXR joint."""
OPENXR_PARTS: dict[str, str] = {"PALM": "palm", **{_openxr_name(name): part for name, part in WEBXR_PARTS.items()}}
"""The hand's part that moves with each OpenXR joint."""
_XR_KEYPOINTS = {
    "webxr": [
        WEBXR_JOINTS.index(name) for key in _KEYPOINTS for name, (_, keypoint) in _WEBXR.items() if keypoint == key
    ]
}
_XR_KEYPOINTS["openxr"] = [index + 1 for index in _XR_KEYPOINTS["webxr"]]
_XR_SIZES = {"webxr": len(WEBXR_JOINTS), "openxr": len(OPENXR_JOINTS)}


@dataclass(frozen=True)
class ManoPose:
    """A hand's pose as MANO's parameters, without the mean pose that MANO may add (``flat_hand_mean=True``)."""

    global_orient: Tensor  # (..., 3) rotation vector of the wrist, radians
    hand_pose: Tensor  # (..., 15, 3) in the parents: index, middle, little, ring, thumb, three each from base to tip
    wrist: Tensor  # (..., 3) position, metres; MANO's ``transl`` is this less its own wrist in the rest pose


def reorder_keypoints(keypoints: Tensor, source: str, target: str) -> Tensor:
    """Return 21 keypoints (..., 21, C) in the order of another convention; both are keys of `KEYPOINT_ORDERS`."""
    check_choice(source, "source", tuple(KEYPOINT_ORDERS))
    check_choice(target, "target", tuple(KEYPOINT_ORDERS))
    check_shape(keypoints, "keypoints", (21, "C"), batch=True)
    return keypoints[..., [KEYPOINT_ORDERS[source].index(name) for name in KEYPOINT_ORDERS[target]], :]


def keypoints_from_xr(joints: Tensor, api: str = "webxr") -> Tensor:
    """Return the 21 keypoints (..., 21, C), from wrist to little finger, base to tip, of "webxr" or "openxr" joints.

    The joints (..., 25 or 26, C) come in the order of `WEBXR_JOINTS` or `OPENXR_JOINTS`; the metacarpals' bases are
    left out.
    """
    check_choice(api, "api", tuple(_XR_SIZES))
    check_shape(joints, "joints", (_XR_SIZES[api], "C"), batch=True)
    return joints[..., _XR_KEYPOINTS[api], :]


def to_mano_pose(hand: Hand, pose: Tensor, *, flat_pose: Tensor | None = None) -> ManoPose:
    """Return MANO's joint rotations of a hand's pose (..., 27); no MANO file is needed.

    MANO's joint frames are parallel in its rest pose: palm down, fingers along -x (right) or +x (left), thumb on +z. A
    part's rotation from there is ``M = G(pose) G(flat)^-1``, and MANO's joint turns by ``M_parent^-1 M``. In
    ``flat_pose`` (27,), zeros by default, the bones point as MANO's do at rest. Romero, Tzionas, Black 2017.
    """
    pose = hand.check_pose(pose)
    axes, flat = _mano_axes(hand), _flat_rotations(hand, flat_pose)
    turned = hand.part_transforms(pose)[..., :3, :3] @ flat.mT
    parents = [hand.part_parents[part] for part in _MANO_PARTS]
    local = turned[..., parents, :, :].mT @ turned[..., list(_MANO_PARTS), :, :]
    hand_pose = rotation_vector_from_rotation(axes @ local @ axes.mT)
    # The wrist's rotation starts from MANO's axes, not from the hand's.
    return ManoPose(rotation_vector_from_rotation(turned[..., 0, :, :] @ axes.mT), hand_pose, pose[..., :3])


def from_mano_pose(hand: Hand, mano: ManoPose, *, flat_pose: Tensor | None = None) -> Tensor:
    """Return the hand's pose (..., 27) nearest to MANO's joint rotations, see `to_mano_pose`.

    MANO's joints are ball joints; each joint of the hand takes its rotation nearest to MANO's in the squared difference
    of the matrices, whatever the joints before it left over. Limits are not applied: see `ArticulatedShape.clamp`. Add
    MANO's mean pose first if it is in use.
    """
    check_shape(mano.hand_pose, "hand_pose", (15, 3), batch=True)
    check_shape(mano.global_orient, "global_orient", (3,), batch=True)
    check_shape(mano.wrist, "wrist", (3,), batch=True)
    batch = mano.hand_pose.shape[:-2]
    if mano.global_orient.shape[:-1] != batch or mano.wrist.shape[:-1] != batch:
        raise InputError(
            f"global_orient {tuple(mano.global_orient.shape)} and wrist {tuple(mano.wrist.shape)} must have the "
            f"leading dimensions of hand_pose {tuple(mano.hand_pose.shape)}"
        )
    axes, flat = _mano_axes(hand), _flat_rotations(hand, flat_pose)
    rest = hand.part_transforms(torch.zeros_like(hand.rest))[:, :3, :3]
    local = axes.mT @ so3_exp(mano.hand_pose.to(hand.rest)) @ axes
    palm = so3_exp(mano.global_orient.to(hand.rest)) @ axes @ flat[0]
    columns = dict[int, Tensor]()
    for number, part in enumerate(_MANO_PARTS):
        parent = hand.part_parents[part]
        offset = rest[parent].mT @ rest[part]
        wanted = offset.mT @ flat[parent].mT @ local[..., number, :, :] @ flat[part]
        columns.update(_joint_angles(hand, part, wanted))
    rotation = rotation_vector_from_rotation(palm)
    joints = torch.stack([columns[dof] for dof in range(6, hand.num_dofs)], dim=-1)
    return torch.cat([mano.wrist.to(hand.rest), rotation, joints], dim=-1)


def _joint_angles(hand: Hand, part: int, wanted: Tensor) -> dict[int, Tensor]:
    """Return the angles (...), by degree of freedom, whose rotation of a part is nearest to ``wanted`` (..., 3, 3)."""
    finger, number = divmod(part - 1, 3)
    joints = ("cmc", "mcp", "ip") if finger == 0 else ("mcp", "pip", "dip")
    stem = f"{FINGER_NAMES[finger]}_{joints[number]}"
    flexion = hand.dof_names.index(f"{stem}_flexion")
    if f"{stem}_abduction" not in hand.dof_names:
        return {flexion: _angle_about_x(wanted)}
    side = 1.0 if hand.side == "right" else -1.0
    # Exact for a rotation about y and then x, at any angle: its first column depends on the angle about y alone.
    about_y = torch.atan2(-wanted[..., 2, 0], wanted[..., 0, 0])
    for _ in range(_ALTERNATIONS):
        about_x = _angle_about_x(_axis_rotation(about_y, 1).mT @ wanted)
        about_y = _angle_about_y(wanted @ _axis_rotation(about_x, 0).mT)
    return {hand.dof_names.index(f"{stem}_abduction"): side * about_y, flexion: about_x}


def _angle_about_x(rotation: Tensor) -> Tensor:
    return torch.atan2(rotation[..., 2, 1] - rotation[..., 1, 2], rotation[..., 1, 1] + rotation[..., 2, 2])


def _angle_about_y(rotation: Tensor) -> Tensor:
    return torch.atan2(rotation[..., 0, 2] - rotation[..., 2, 0], rotation[..., 0, 0] + rotation[..., 2, 2])


def _axis_rotation(angle: Tensor, axis: int) -> Tensor:
    return so3_exp(angle.unsqueeze(-1) * torch.eye(3, dtype=angle.dtype, device=angle.device)[axis])


def _flat_rotations(hand: Hand, flat_pose: Tensor | None) -> Tensor:
    """Return the rotations (16, 3, 3) of the parts in the flat pose, relative to the base."""
    flat = torch.zeros_like(hand.rest) if flat_pose is None else hand.check_pose(flat_pose, "flat_pose")
    check_shape(flat, "flat_pose", (hand.num_dofs,))
    flat = torch.cat([torch.zeros_like(flat[:6]), flat[6:]])
    return hand.part_transforms(flat)[:, :3, :3]


def _mano_axes(hand: Hand) -> Tensor:
    """Return the rotation from the hand's axes (thumb of a right hand on x, back y, fingers z) to MANO's at rest."""
    side = -1.0 if hand.side == "right" else 1.0
    return torch.tensor([[0.0, 0.0, side], [0.0, 1.0, 0.0], [-side, 0.0, 0.0]]).to(hand.rest)
