"""A body of ellipsoids whose parts are named as anny's, with statures and limbs as coefficients."""

import torch

import torchreg as tr
from torchreg.geometry.mesh import concatenate, unit_sphere

# By part: the one above, center and half axes of its ellipsoid, joint, metres; it looks along -y.
_TRUNK = {
    "pelvis": ("", (0, 0, 0.96), (0.15, 0.1, 0.1), (0, 0, 0.95)),
    "spine05": ("pelvis", (0, 0, 1.03), (0.14, 0.1, 0.1), (0, 0, 0.98)),
    "spine04": ("spine05", (0, 0, 1.12), (0.14, 0.1, 0.1), (0, 0, 1.06)),
    "spine03": ("spine04", (0, 0, 1.22), (0.14, 0.1, 0.1), (0, 0, 1.16)),
    "spine02": ("spine03", (0, 0, 1.32), (0.15, 0.1, 0.1), (0, 0, 1.26)),
    "spine01": ("spine02", (0, 0, 1.42), (0.17, 0.1, 0.1), (0, 0, 1.36)),
    "neck01": ("spine01", (0, 0, 1.5), (0.05, 0.05, 0.05), (0, 0, 1.48)),
    "neck02": ("neck01", (0, 0, 1.54), (0.05, 0.05, 0.05), (0, 0, 1.52)),
    "neck03": ("neck02", (0, 0, 1.58), (0.05, 0.05, 0.05), (0, 0, 1.56)),
    "head": ("neck03", (0, -0.02, 1.7), (0.08, 0.1, 0.13), (0, 0, 1.6)),
}
_LEFT = {
    "upperarm01": ("spine01", (0.3, 0, 1.38), (0.16, 0.05, 0.05), (0.18, 0, 1.42)),
    "lowerarm01": ("upperarm01", (0.54, -0.03, 1.3), (0.14, 0.04, 0.04), (0.42, 0, 1.33)),
    "wrist": ("lowerarm01", (0.73, -0.07, 1.25), (0.08, 0.04, 0.02), (0.67, -0.05, 1.27)),
    "upperleg01": ("pelvis", (0.1, 0, 0.72), (0.08, 0.08, 0.25), (0.1, 0, 0.92)),
    "lowerleg01": ("upperleg01", (0.1, 0, 0.28), (0.055, 0.055, 0.24), (0.1, 0, 0.49)),
    "foot": ("lowerleg01", (0.1, -0.07, 0.03), (0.045, 0.13, 0.04), (0.1, 0, 0.06)),
}


def body_like_anny():
    """A body whose coefficients, from -1 to 1, are its stature and the length of its limbs."""
    parts = dict(_TRUNK)
    for side, sign in ((".L", 1), (".R", -1)):
        for name, (above, center, half, joint) in _LEFT.items():
            carrier = above if above in _TRUNK else above + side
            mirrored = [(sign * place[0], *place[1:]) for place in (center, joint)]
            parts[name + side] = (carrier, mirrored[0], half, mirrored[1])
    return ellipsoid_body(parts, 1)


def ellipsoid_body(parts, detail):
    """A body of ellipsoids, as those above; its coefficients are stature and length of limbs."""
    ball, names = unit_sphere(detail, dtype=torch.float64), list(parts)
    rows = [[torch.tensor(value, dtype=torch.float64) for value in row[1:]] for row in parts.values()]
    mesh = concatenate([tr.TriangleMesh(ball.vertices * half + center, ball.faces) for center, half, _ in rows])
    joints = torch.stack([joint for _, _, joint in rows])
    weights = torch.eye(len(names), dtype=torch.float64).repeat_interleave(len(ball.vertices), 0)
    parents = [names.index(row[0]) if row[0] else -1 for row in parts.values()]

    def dirs(points):
        return torch.stack([0.1 * points, 0.2 * points * torch.tensor([1.0, 0, 0])], dim=-1)

    return tr.ArticulatedShape.from_skinned_mesh(
        mesh.vertices, mesh.faces, weights, joints, parents, joint_names=names, shape_dirs=dirs(mesh.vertices),
        joint_dirs=dirs(joints), coefficient_names=["stature", "limbs"], up=(0.0, 0.0, 1.0),
    ).requires_grad_(False)  # fmt: skip
