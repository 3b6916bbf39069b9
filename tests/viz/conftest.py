"""Small results of every kind, made without running a pipeline, and a viewer of files."""

import numpy as np
import pygltflib
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.alignment.results import AlignResult, Calibration, PoseStarts
from torchreg.datasets.hand import hand_motion
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.results import ScanRegistration, SequenceRegistration
from torchreg.result import Status
from torchreg.shapes.hand import Hand
from torchreg.spines.results import SpineSequence
from torchreg.spines.spine import Spine
from torchreg.tracking.results import DemoResult, TrackResult

_DTYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class _GltfViewer:
    """Evaluates a file as the specification says: tracks at the key frames, hierarchy, inverse bind matrices, skin."""

    def __init__(self, path):
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def read(self, index):
        accessor = self.gltf.accessors[index]
        start = self.gltf.bufferViews[accessor.bufferView].byteOffset
        width = _WIDTHS[accessor.type]
        values = np.frombuffer(self.blob, _DTYPES[accessor.componentType], accessor.count * width, start)
        return values.reshape(-1, width)

    def vertices(self, frame):
        local = [np.eye(4) for _ in self.gltf.nodes]
        for matrix, node in zip(local, self.gltf.nodes, strict=True):
            matrix[:3, :3] = Rotation.from_quat(node.rotation or (0, 0, 0, 1)).as_matrix()
            matrix[:3, 3] = node.translation or (0, 0, 0)
        animation = self.gltf.animations[0]
        for channel in animation.channels:
            value = self.read(animation.samplers[channel.sampler].output)[frame].astype(np.float64)
            matrix = local[channel.target.node]
            if channel.target.path == "translation":
                matrix[:3, 3] = value
            else:
                matrix[:3, :3] = Rotation.from_quat(value).as_matrix()
        world = {}

        def visit(node, above):
            world[node] = above @ local[node]
            for child in self.gltf.nodes[node].children:
                visit(child, world[node])

        for root in self.gltf.scenes[0].nodes:
            visit(root, np.eye(4))
        skin = self.gltf.skins[0]
        inverse = self.read(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([world[node] @ bind for node, bind in zip(skin.joints, inverse, strict=True)])
        attributes = self.gltf.meshes[0].primitives[0].attributes
        points = np.c_[self.read(attributes.POSITION), np.ones(self.gltf.accessors[attributes.POSITION].count)]
        total = np.zeros_like(points)
        for name in ("0", "1"):
            index = getattr(attributes, f"JOINTS_{name}", None)
            if index is not None:
                weights = self.read(getattr(attributes, f"WEIGHTS_{name}"))
                moved = np.einsum("vsij,vj->vsi", joints[self.read(index)], points)
                total += np.einsum("vs,vsi->vi", weights, moved)
        return total[:, :3]


@pytest.fixture(scope="session")
def gltf_viewer():
    """Return the class that opens a binary glTF file, reads its arrays and plays its animation."""
    return _GltfViewer


def _bar_model(num_bones=3):
    """Return a model of a long ellipsoid that bends, its points and faces."""
    mesh = unit_sphere(3)
    points = mesh.vertices.double() * torch.tensor([3.0, 0.6, 0.5])
    grid = SparseGrid.from_points(points, 24)
    seeds = torch.linspace(-2, 2, num_bones, dtype=torch.float64)
    soft = torch.softmax(-4 * (grid.corner_points()[:, :1] - seeds).abs(), dim=-1)
    # A chain that bends: each bone turns about its joint with the one before.
    motions = [torch.eye(4, dtype=torch.float64)]
    turn = se3_exp(torch.tensor([0.0, 0, 0, 0, 0, 0.35], dtype=torch.float64))
    for joint in (seeds[1:] + seeds[:-1]) / 2:
        place = torch.eye(4, dtype=torch.float64)
        place[0, 3] = joint
        motions.append(motions[-1] @ place @ turn @ torch.linalg.inv(place))
    return GridLBS(grid, soft, torch.stack(motions)), points, mesh.faces


@pytest.fixture(scope="session")
def bar_model():
    """Return the function that makes a `GridLBS`, points and faces, given a number of bones."""
    return _bar_model


@pytest.fixture(scope="session")
def registration():
    model, points, faces = _bar_model()
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    count = len(points)
    return ScanRegistration(
        model, points, faces, deformed, weights.argmax(-1), model.transforms.detach(), weights,
        torch.linspace(0, 0.1, count, dtype=torch.float64), torch.ones(count, dtype=torch.bool), Status.CONVERGED,
        torch.zeros(4),
    )  # fmt: skip


@pytest.fixture(scope="session")
def sequence():
    model, points, faces = _bar_model()
    rest = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    transforms = torch.stack([rest, model.transforms.detach()])
    model.set_transforms_(transforms)
    with torch.no_grad():
        deformed, weights = model(points), model.weights_at(points)
    fused = torch.cat([points, points])
    frames = torch.arange(2).repeat_interleave(len(points))
    return SequenceRegistration(
        model,
        points,
        faces,
        deformed,
        weights.argmax(-1),
        transforms,
        weights,
        fused,
        fused,
        frames,
        0,
        Status.CONVERGED,
    )


@pytest.fixture(scope="session")
def spine():
    line = torch.linspace(1, 0, 8).unsqueeze(-1)
    ends = torch.tensor([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]])
    still = line * ends.unsqueeze(1)
    curves = torch.stack([still, still + torch.tensor([0.0, 0, 0.2]), still + torch.tensor([0.0, 0, 0.4])])
    graph = torch.tensor([[0, 3], [1, 3], [2, 3]])
    radii, frames = torch.full((3, 3, 8), 0.1), torch.eye(3).expand(3, 3, 8, 3, 3)
    model, count = Spine(curves, graph, radii), 3
    yes = torch.ones(count, 3, dtype=torch.bool)
    return SpineSequence(
        model, graph, curves, radii, frames, torch.arange(3.0), yes, yes, 0, ("(()()())",) * 3, ("(()()())",) * 3,
        (Status.CONVERGED,) * 3, Status.CONVERGED, (),
    )  # fmt: skip


@pytest.fixture(scope="session")
def hand():
    return Hand()


@pytest.fixture(scope="session")
def track(hand):
    poses = hand_motion(hand, "bend", 3)
    poses[0] = torch.nan
    count = len(poses)
    return TrackResult(
        poses, torch.zeros_like(poses), hand.keypoints(poses).detach(), torch.ones(count), torch.ones(count),
        torch.arange(float(count)) / 20, torch.ones(count), (Status.LOST, Status.CONVERGED, Status.CONVERGED),
        ("lost", "found", "tracked"),
    )  # fmt: skip


@pytest.fixture(scope="session")
def clouds(track):
    return [torch.nan_to_num(points, 0.0) + 0.001 for points in track.keypoints]


@pytest.fixture(scope="session")
def alignment(track):
    pose, points = track.poses[1], track.keypoints[1]
    inliers = torch.arange(len(points)) % 3 > 0
    return AlignResult(
        pose, points, points, torch.zeros(len(points)), inliers, torch.linspace(0, 1, len(points)),
        torch.tensor(0.002), torch.tensor(1.0), Status.CONVERGED,
    )  # fmt: skip


@pytest.fixture(scope="session")
def demo(track, clouds):
    masks = tuple(torch.arange(len(cloud)) % 2 > 0 for cloud in clouds)
    tips = torch.zeros(3, 5)
    return DemoResult(track, track.poses, tuple(clouds), masks, tips, tips > -1, 0)


@pytest.fixture(scope="session")
def starts(track):
    return PoseStarts(track.poses[1:], torch.tensor([0.1, 0.2]), torch.tensor(0.9))


@pytest.fixture(scope="session")
def calibration(hand, track):
    zeros = torch.zeros(len(hand.part_names))
    return Calibration(hand, track.poses[1:], zeros, zeros, torch.tensor(0.1), Status.CONVERGED)


@pytest.fixture(scope="session")
def everything(alignment, track, demo, starts, calibration, registration, sequence, spine):
    """Return every kind of result that can be shown, by name."""
    return {
        "alignment": alignment, "track": track, "demo": demo, "starts": starts, "calibration": calibration,
        "registration": registration, "sequence": sequence, "spine": spine,
    }  # fmt: skip
