import pytest
import torch

from torchreg.capture.silhouette_frames import SilhouetteFrames
from torchreg.datasets.pictures import camera_ring
from torchreg.errors import FormatError, InputError
from torchreg.io.images import save_image

RADIUS = 0.1


@pytest.fixture(scope="module")
def ring():
    return camera_ring([0.0, 0.0, 0.0], 0.6, 5, focal=120.0, width=80, height=64)


def ball_mask(camera, center):
    rays = camera.directions(camera.pixel_grid())
    start = camera.position - rays.new_tensor(center)
    return (rays @ start) ** 2 > (rays**2).sum(-1) * ((start**2).sum() - RADIUS**2)


@pytest.fixture(scope="module")
def folders(ring, tmp_path_factory):
    """Two frames of a ball that moves, one folder per camera."""
    place = tmp_path_factory.mktemp("masks")
    for camera in ring:
        (place / camera.name).mkdir()
        for number, x in ((9, 0.0), (10, 0.03)):
            save_image(place / camera.name / f"{number}.png", ball_mask(camera, [x, 0.0, 0.0]))
    return place


def test_hulls_follow_the_ball_and_are_kept(ring, folders, tmp_path):
    frames = SilhouetteFrames([folders / camera.name for camera in ring], ring, resolution=32)
    assert len(frames) == 2
    assert [name.rpartition("/")[2] for name in frames.names] == ["9.png", "10.png"]
    meshes = [frames.mesh(number, tmp_path / "kept") for number in range(2)]
    for mesh, x in zip(meshes, (0.0, 0.03), strict=True):
        middle = mesh.vertices.mean(0)
        assert (middle - torch.tensor([x, 0.0, 0.0])).norm() < 0.02
    assert len(list((tmp_path / "kept").glob("hull_*.safetensors"))) == 2
    again = frames.mesh(1, tmp_path / "kept")
    assert torch.equal(again.vertices, meshes[1].vertices)
    # Another resolution is another surface.
    other = SilhouetteFrames([folders / camera.name for camera in ring], ring, resolution=24)
    assert other.mesh(1, tmp_path / "kept").num_vertices < meshes[1].num_vertices


def test_folders_belong_to_cameras_by_name_or_by_order(ring, folders, tmp_path):
    names = [camera.name for camera in ring]
    turned = [folders / name for name in reversed(names)]
    frames = SilhouetteFrames(turned, ring, resolution=24)
    assert frames.cameras.names == tuple(reversed(names))
    some = SilhouetteFrames(turned[:3], ring, resolution=24)
    assert some.mesh(0).num_faces > 100
    plain = tmp_path / "plain"
    plain.mkdir()
    for number, name in enumerate(names):
        (plain / str(number)).mkdir()
        for file in (folders / name).iterdir():
            (plain / str(number) / file.name).write_bytes(file.read_bytes())
    ordered = SilhouetteFrames([plain / str(k) for k in range(5)], ring, resolution=24)
    named = SilhouetteFrames([folders / name for name in names], ring, resolution=24)
    assert torch.equal(ordered.mesh(0).vertices, named.mesh(0).vertices)


def test_pictures_before_a_screen_become_masks(ring, tmp_path):
    folders = []
    for camera in ring:
        folders.append(tmp_path / camera.name)
        folders[-1].mkdir()
        mask = ball_mask(camera, [0.0, 0.0, 0.0]).unsqueeze(-1)
        image = torch.where(mask, torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.65, 0.2]))
        save_image(folders[-1] / "0.png", image)
    frames = SilhouetteFrames(folders, ring, screen=True, resolution=24)
    for camera, mask in zip(ring, frames.masks(0), strict=True):
        assert (mask ^ ball_mask(camera, [0.0, 0.0, 0.0])).float().mean() < 0.01
    save_image(folders[0] / "0.png", torch.zeros(64, 80))
    with pytest.raises(FormatError, match=r"camera00.0.png: pictures before a screen must be in color"):
        frames.masks(0)


def test_errors_name_the_file_or_the_frame(ring, folders, tmp_path):
    places = [folders / camera.name for camera in ring]
    with pytest.raises(InputError, match="one per camera, got 1 folders and 5 cameras"):
        SilhouetteFrames([folders], ring)
    with pytest.raises(InputError, match="there is none called other"):
        SilhouetteFrames([places[0], tmp_path / "other"], ring)
    (tmp_path / "camera00").mkdir()
    save_image(tmp_path / "camera00" / "0.png", torch.zeros(10, 20))
    with pytest.raises(FormatError, match="equally many pictures"):
        SilhouetteFrames([tmp_path / "camera00", places[1]], ring)
    save_image(tmp_path / "camera00" / "1.png", torch.zeros(64, 80))
    frames = SilhouetteFrames([tmp_path / "camera00", places[1]], ring)
    with pytest.raises(FormatError, match=r"camera00.0.png: is 20 x 10 pixels, the pictures of camera00 are 80 x 64"):
        frames.mesh(0)
    with pytest.raises(FormatError, match=r"frame 1 .*1.png\): masks must show the whole object"):
        frames.mesh(1)
