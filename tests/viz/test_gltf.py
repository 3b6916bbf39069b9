import pytest
import torch

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.errors import InputError
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.hand import Hand
from torchreg.models.skin import LinearBlendSkin
from torchreg.viz.gltf import save_shape_animation


@pytest.fixture(scope="module")
def hand():
    return Hand()


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.01)


def test_the_file_plays_what_the_skin_gives(hand, skin, tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    poses = hand_motion(hand, "bend", 5)
    path = save_shape_animation(tmp_path / "a.glb", hand, poses, fps=10, skin=skin)
    document = pygltflib.GLTF2().load(str(path))
    blob = document.binary_blob()

    def read(index, width):
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        kinds = {5126: torch.float32, 5121: torch.uint8, 5123: torch.int16}
        data = blob[view.byteOffset : view.byteOffset + view.byteLength]
        return torch.frombuffer(bytearray(data), dtype=kinds[accessor.componentType]).reshape(accessor.count, width)

    animation = document.animations[0]
    seconds = read(animation.samplers[0].input, 1)[:, 0]
    torch.testing.assert_close(seconds, torch.arange(5) / 10)
    names = [document.nodes[node].name for node in document.skins[0].joints]
    assert names == list(hand.part_names)

    # The player: local tracks down the hierarchy, inverse bind matrices, linear blending; frame 3.
    frame, local = 3, {}
    for channel in animation.channels:
        values = read(animation.samplers[channel.sampler].output, 3 if channel.target.path == "translation" else 4)
        local.setdefault(channel.target.node, {})[channel.target.path] = values[frame].double()
    world = {}

    def place(node, parent):
        matrix = torch.eye(4, dtype=torch.float64)
        if node in local:
            x, y, z, w = local[node]["rotation"]
            matrix[:3, :3] = torch.stack(
                [
                    torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]),
                    torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]),
                    torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]),
                ]
            )
            matrix[:3, 3] = local[node]["translation"]
        world[node] = parent @ matrix
        for child in document.nodes[node].children or []:
            place(child, world[node])

    for root in document.scenes[0].nodes:
        place(root, torch.eye(4, dtype=torch.float64))
    inverse_bind = read(document.skins[0].inverseBindMatrices, 16).reshape(-1, 4, 4).mT.double()
    joints = torch.stack([world[node] for node in document.skins[0].joints]) @ inverse_bind
    attributes = document.meshes[0].primitives[0].attributes
    points, weights = read(attributes.POSITION, 3).double(), read(attributes.WEIGHTS_0, 4).double()
    moved = torch.einsum("nk,nkij,nj->ni", weights, joints[read(attributes.JOINTS_0, 4).long()],
                         torch.nn.functional.pad(points, (0, 1), value=1.0))  # fmt: skip
    torch.testing.assert_close(moved[:, :3].float(), skin(poses[frame]).detach(), atol=1e-5, rtol=0)


def test_the_file_reads_back_as_a_shape(hand, skin, tmp_path):
    times = torch.tensor([0.0, 0.3, 1.0])
    path = save_shape_animation(tmp_path / "a.glb", hand, hand_motion(hand, "rotate", 3), times, skin=skin)
    again = ArticulatedShape.from_gltf(path)
    assert set(again.part_names) <= set(hand.part_names)
    assert again.surface is not None
    torch.testing.assert_close(again.surface.vertices.float(), skin.points, atol=1e-5, rtol=0)


def test_the_surface_is_made_when_no_skin_is_given(tmp_path):
    box = torch.tensor([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.2, 0.4)])
    weights = torch.zeros(12, 2)
    weights[torch.arange(12), (box[:, 2] > 0.3).long()] = 1.0
    faces = torch.tensor([[0, 1, 3], [1, 2, 4], [6, 7, 9], [7, 8, 10]])
    shape = ArticulatedShape.from_skinned_mesh(box, faces, weights, box[[0, 1]], [-1, 0])
    poses = shape.rest_pose().expand(2, -1)
    assert save_shape_animation(tmp_path / "a.glb", shape, poses).stat().st_size > 500


def test_save_shape_animation_refuses(hand, skin, tmp_path):
    poses = hand.rest_pose().expand(3, -1)
    with pytest.raises(InputError, match=r"times must have shape \(3\), got \(2,\)"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, torch.arange(2.0), skin=skin)
    with pytest.raises(InputError, match=r"poses must have shape \(T, 27\)"):
        save_shape_animation(tmp_path / "a.glb", hand, poses[0], skin=skin)
    with pytest.raises(InputError, match=r"path must end in \.glb"):
        save_shape_animation(tmp_path / "a.gif", hand, poses, skin=skin)
    with pytest.raises(InputError, match="fps must be positive"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, fps=-1.0, skin=skin)
    bare = LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())
    with pytest.raises(InputError, match="skin must have faces"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, skin=bare)
