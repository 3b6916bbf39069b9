import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig, StereoPair
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.geometry.rotation import so3_exp

INTRINSICS = (600.0, 600.0, 319.5, 239.5)


def camera_at(x, turn=(0.0, 0.0, 0.0), intrinsics=INTRINSICS, **kwargs):
    rotation = so3_exp(torch.tensor(turn, dtype=torch.float64))
    place = torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    return Camera(640, 480, intrinsics, rigid_matrix(rotation, -rotation @ place), **kwargs)


@pytest.fixture
def pair():
    motion = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64))
    right = camera_at(0.06, intrinsics=(600.0, 600.0, 310.0, 239.5))
    return StereoPair(camera_at(-0.06).moved(motion), right.moved(motion))


def test_disparity_is_the_difference_of_columns(pair):
    assert pair.baseline == pytest.approx(0.12)
    assert pair.is_rectified
    depth = torch.tensor([0.5, 0.8], dtype=torch.float64)
    pixels = torch.tensor([[400.0, 100.0], [300.0, 200.0]], dtype=torch.float64)
    other, _ = pair.right.project(pair.left.unproject(pixels, depth))
    disparity = pixels[:, 0] - other[:, 0]
    assert torch.allclose(pair.disparity(depth), disparity)
    assert torch.allclose(pair.depth(disparity), depth)
    assert torch.allclose(other[:, 1], pixels[:, 1])
    assert pair.depth(torch.tensor([0.0])).isnan().all()


def test_depth_deviation_is_the_derivative(pair):
    depth = torch.tensor([0.6], dtype=torch.float64)
    step = 1e-4
    moved = pair.depth(pair.disparity(depth) - step) - depth
    assert torch.allclose(moved / step, pair.depth_std(depth, 1.0), rtol=1e-5)


@pytest.mark.parametrize(
    "right",
    [
        camera_at(0.06, turn=(0.01, 0.0, 0.0)),
        camera_at(0.06, turn=(0.0, 0.01, 0.0)),
        camera_at(0.06, turn=(0.0, 0.0, 0.01)),
        camera_at(0.06, intrinsics=(600.0, 600.0, 319.5, 250.0)),
        camera_at(0.06, intrinsics=(620.0, 600.0, 319.5, 239.5)),
        camera_at(0.06, distortion=(0.1, 0.0, 0.0, 0.0)),
        camera_at(0.06).scaled(0.5),
    ],
)
def test_other_pairs_are_not_rectified(right):
    pair = StereoPair(camera_at(-0.06), right)
    assert not pair.is_rectified
    with pytest.raises(InputError, match="the pair is not rectified"):
        pair.check_rectified()


def test_swapped_and_senseless_pairs_are_refused():
    with pytest.raises(InputError, match=r"swapped: the right camera stands 0\.12 to the left"):
        StereoPair(camera_at(0.06), camera_at(-0.06))
    with pytest.raises(InputError, match="different places"):
        StereoPair(camera_at(0.0), camera_at(0.0))
    with pytest.raises(InputError, match="look the same way"):
        StereoPair(camera_at(0.0), camera_at(0.1, turn=(0.0, 2.0, 0.0)))


def test_rig_finds_cameras_by_name_and_place():
    rig = CameraRig((camera_at(0.0, name="left"), camera_at(0.1)))
    assert rig.names == ("left", "camera1")
    assert rig["left"] is rig[0]
    assert len(rig) == len(list(rig)) == 2
    assert rig.stereo().baseline == pytest.approx(0.1)
    with pytest.raises(InputError, match="no camera 'top', it has left, camera1"):
        rig["top"]
    with pytest.raises(InputError, match="two cameras"):
        CameraRig((rig[0],)).stereo()
    with pytest.raises(InputError, match="left more than once"):
        CameraRig((rig[0], rig[0]))
    with pytest.raises(InputError, match="at least one"):
        CameraRig(())
    with pytest.raises(InputTypeError, match="Camera records"):
        CameraRig((1,))
