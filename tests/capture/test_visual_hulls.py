import math

import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import camera_ring
from torchreg.capture.color import chroma_key
from torchreg.capture.mask_distance import signed_mask_distance
from torchreg.geometry.visibility import rasterize
from torchreg.io.images import save_image

FormatError, InputError = tr.errors.FormatError, tr.errors.InputError

CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
RADII = torch.tensor([0.3, 0.2, 0.15], dtype=torch.float64)


def ring(count=16, size=120, focal=140.0, lens=()):
    """Cameras on a tilted ring and two rings above and below it, two metres away."""
    cameras = []
    for k in range(count):
        turn, tilt = 2 * math.pi * k / count, (-0.5, 0.0, 0.5)[k % 3]
        away = torch.tensor([math.sin(turn) * math.cos(tilt), math.sin(tilt), math.cos(turn) * math.cos(tilt)])
        one = tr.Camera.looking_at(CENTER + 1.2 * away, CENTER, focal=focal, width=size, height=size, name=f"c{k}")
        cameras.append(tr.Camera(size, size, one.intrinsics, one.world_to_camera, lens, one.name))
    return cameras


def ellipsoid_mask(camera):
    """Exact: a ray hits the ellipsoid if the discriminant of the quadratic is positive."""
    rays = camera.directions(camera.pixel_grid()) / RADII
    start = (camera.position - CENTER) / RADII
    b = rays @ start
    return b**2 - (rays**2).sum(-1) * ((start**2).sum() - 1) > 0


def box_mesh(half):
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3) * half
    quads = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return tr.TriangleMesh(CENTER + corners, torch.cat((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])))


def edges_used(mesh):
    sides = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    return (sides[:, 0] * mesh.num_vertices + sides[:, 1]).unique(return_counts=True)[1]


@pytest.mark.parametrize("lens", [(), (-0.2, 0.05, 1e-3, 0.0)], ids=["plain", "lens"])
def test_hull_of_an_ellipsoid_is_no_smaller_and_little_larger(lens):
    cameras = ring(24, lens=lens)
    hull = tr.visual_hull([ellipsoid_mask(camera) for camera in cameras], cameras, resolution=64)
    truth = 4 / 3 * math.pi * float(RADII.prod())
    assert 0.99 * truth < hull.volume() < 1.06 * truth
    mesh = hull.mesh()
    assert (edges_used(mesh) == 1).all()
    outside = (((mesh.vertices - CENTER) / RADII) ** 2).sum(-1).sqrt()
    assert outside.min() > 0.97


def test_octree_equals_looking_at_every_voxel():
    cameras = ring(5, size=60, focal=70.0)
    masks = [ellipsoid_mask(camera) for camera in cameras]
    hull = tr.visual_hull(masks, cameras, resolution=48)
    steps = torch.ones(hull.field.shape, dtype=torch.bool).nonzero()
    points = hull.origin + hull.spacing * steps
    inside = torch.ones(len(points), dtype=torch.bool)
    near = torch.zeros_like(inside)
    for mask, camera in zip(masks, cameras, strict=True):
        pixels, _ = camera.project(points.double())
        column, row = pixels.round().long().clamp(0, 59).unbind(-1)
        inside &= mask[row, column] & camera.contains(pixels)
        # Interpolation and nearest pixel may differ along the outline.
        patch = torch.nn.functional.max_pool2d(mask[None].float(), 3, 1, 1) != -torch.nn.functional.max_pool2d(
            -mask[None].float(), 3, 1, 1
        )
        near |= patch[0, row, column]
    found = (hull.field < 0).flatten()
    assert (found == inside)[~near].all()
    assert (found != inside).double().mean() < 0.01


def test_a_given_box_cuts_the_hull():
    cameras = ring(6, size=60, focal=70.0)
    masks = [ellipsoid_mask(camera) for camera in cameras]
    box = torch.stack((CENTER - 1, CENTER + CENTER.new_tensor([0, 1, 1])))
    hull, half = (tr.visual_hull(masks, cameras, resolution=32, box=given) for given in (None, box))
    assert half.volume() == pytest.approx(0.5 * hull.volume(), rel=0.15)
    assert (edges_used(half.mesh()) == 1).all()


FOUR = ring(4, size=40, focal=45.0)
MASKS = [ellipsoid_mask(camera) for camera in FOUR]
CORNER = torch.zeros(40, 40, dtype=torch.bool)
CORNER[2:6, 2:6] = True
INWARDS = [tr.Camera(c.width, c.height, c.intrinsics, FOUR[0].world_to_camera) for c in FOUR]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"masks": MASKS[:3]}, "InputError", "one per camera, two or more, got 3 and 4"),
        ({"masks": [mask.float() for mask in MASKS]}, "InputTypeError", "masks must be Boolean"),
        ({"masks": [MASKS[0][1:], *MASKS[1:]]}, "InputError", r"c0 has 40 x 40 pixels, the mask has shape \(39, 40\)"),
        ({"masks": [MASKS[0], MASKS[1] & False, *MASKS[2:]]}, "InputError", "that of c1 is empty"),
        ({"masks": [MASKS[0], MASKS[1] | True, *MASKS[2:]]}, "InputError", "that of c1 touches the border"),
        ({"masks": [CORNER, *MASKS[1:]], "resolution": 16}, "InputError", "no point is inside all of them"),
        ({"resolution": 1000}, "InputError", "at most 512"),
        ({"box": torch.zeros(2, 3)}, "InputError", "lower and its upper corner"),
        ({"cameras": INWARDS}, "InputError", "stand around the object"),
    ],
)
def test_what_gives_no_hull_is_refused(change, error, words):
    with pytest.raises(getattr(tr.errors, error), match=words):
        tr.visual_hull(**{"masks": MASKS, "cameras": FOUR, **change})


@pytest.mark.parametrize("background", [None, (0.1, 0.7, 0.2)])
def test_chroma_key_tells_skin_from_a_shaded_screen(background):
    generator = torch.Generator().manual_seed(0)
    row, column = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    truth = torch.hypot(row - 30, column - 40) < 15
    light = (0.5 + 0.5 * column / 80).unsqueeze(-1)
    skin, screen = torch.tensor([0.8, 0.55, 0.45]), torch.tensor([0.1, 0.7, 0.2])
    image = torch.where(truth.unsqueeze(-1), skin, screen) * light
    image = image + 0.01 * torch.randn(60, 80, 3, generator=generator)
    mask = chroma_key(torch.stack((image, image.flip(1))), background)
    assert (mask[0] != truth).float().mean() < 0.005
    assert torch.equal(mask[1], mask[0].flip(1))


def test_chroma_key_checks_its_arguments():
    with pytest.raises(InputError, match="image must have shape"):
        chroma_key(torch.zeros(5, 5))
    with pytest.raises(InputError, match="tolerance must be positive"):
        chroma_key(torch.zeros(5, 5, 3), tolerance=0.0)
    with pytest.raises(InputError, match="background must have shape"):
        chroma_key(torch.zeros(5, 5, 3), (1.0, 0.0))


def test_exchanged_masks_are_refused():
    cameras = ring(9, size=60, focal=70.0)
    masks = [ellipsoid_mask(camera) for camera in cameras]
    tr.visual_hull(masks, cameras, resolution=24)
    mesh = box_mesh(torch.tensor([0.35, 0.06, 0.12], dtype=torch.float64))
    boxes = [rasterize(mesh, camera.view()).face_index >= 0 for camera in cameras]
    tr.visual_hull(boxes, cameras, resolution=24)
    boxes[0], boxes[2] = boxes[2], boxes[0]
    with pytest.raises(InputError, match=r"fills \d+ % of that of c\d; check that masks and cameras are in the same"):
        tr.visual_hull(boxes, cameras, resolution=24)


RADIUS = 0.1


@pytest.fixture(scope="module")
def rig():
    return camera_ring([0.0, 0.0, 0.0], 0.6, 5, focal=120.0, width=80, height=64)


def ball_mask(camera, center):
    rays = camera.directions(camera.pixel_grid())
    start = camera.position - rays.new_tensor(center)
    return (rays @ start) ** 2 > (rays**2).sum(-1) * ((start**2).sum() - RADIUS**2)


@pytest.fixture(scope="module")
def folders(rig, tmp_path_factory):
    """Two frames of a ball that moves, one folder per camera."""
    place = tmp_path_factory.mktemp("masks")
    for camera in rig:
        (place / camera.name).mkdir()
        for number, x in ((9, 0.0), (10, 0.03)):
            save_image(place / camera.name / f"{number}.png", ball_mask(camera, [x, 0.0, 0.0]))
    return place


def test_hulls_follow_the_ball_and_are_kept(rig, folders, tmp_path):
    frames = tr.SilhouetteFrames([folders / camera.name for camera in rig], rig, resolution=32)
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
    other = tr.SilhouetteFrames([folders / camera.name for camera in rig], rig, resolution=24)
    assert other.mesh(1, tmp_path / "kept").num_vertices < meshes[1].num_vertices


def test_folders_belong_to_cameras_by_name_or_by_order(rig, folders, tmp_path):
    names = [camera.name for camera in rig]
    turned = [folders / name for name in reversed(names)]
    frames = tr.SilhouetteFrames(turned, rig, resolution=24)
    assert frames.cameras.names == tuple(reversed(names))
    some = tr.SilhouetteFrames(turned[:3], rig, resolution=24)
    assert some.mesh(0).num_faces > 100
    plain = tmp_path / "plain"
    plain.mkdir()
    for number, name in enumerate(names):
        (plain / str(number)).mkdir()
        for file in (folders / name).iterdir():
            (plain / str(number) / file.name).write_bytes(file.read_bytes())
    ordered = tr.SilhouetteFrames([plain / str(k) for k in range(5)], rig, resolution=24)
    named = tr.SilhouetteFrames([folders / name for name in names], rig, resolution=24)
    assert torch.equal(ordered.mesh(0).vertices, named.mesh(0).vertices)


def test_pictures_before_a_screen_become_masks(rig, tmp_path):
    folders = []
    for camera in rig:
        folders.append(tmp_path / camera.name)
        folders[-1].mkdir()
        mask = ball_mask(camera, [0.0, 0.0, 0.0]).unsqueeze(-1)
        image = torch.where(mask, torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.65, 0.2]))
        save_image(folders[-1] / "0.png", image)
    frames = tr.SilhouetteFrames(folders, rig, screen=True, resolution=24)
    for camera, mask in zip(rig, frames.masks(0), strict=True):
        assert (mask ^ ball_mask(camera, [0.0, 0.0, 0.0])).float().mean() < 0.01
    save_image(folders[0] / "0.png", torch.zeros(64, 80))
    with pytest.raises(FormatError, match=r"camera00.0.png: pictures before a screen must be in color"):
        frames.masks(0)


def test_errors_name_the_file_or_the_frame(rig, folders, tmp_path):
    places = [folders / camera.name for camera in rig]
    with pytest.raises(InputError, match="one per camera, got 1 folders and 5 cameras"):
        tr.SilhouetteFrames([folders], rig)
    with pytest.raises(InputError, match="there is none called other"):
        tr.SilhouetteFrames([places[0], tmp_path / "other"], rig)
    (tmp_path / "camera00").mkdir()
    save_image(tmp_path / "camera00" / "0.png", torch.zeros(10, 20))
    with pytest.raises(FormatError, match="equally many pictures"):
        tr.SilhouetteFrames([tmp_path / "camera00", places[1]], rig)
    save_image(tmp_path / "camera00" / "1.png", torch.zeros(64, 80))
    frames = tr.SilhouetteFrames([tmp_path / "camera00", places[1]], rig)
    told = pytest.warns(tr.errors.FileWarning, match=r"0\.png: the mask keeps none")
    with told, pytest.raises(FormatError, match=r"camera00.0.png: is 20 x 10 pixels, .* camera00 are 80 x 64"):
        frames.mesh(0)
    told = pytest.warns(tr.errors.FileWarning, match=r"1\.png: the mask keeps none")
    with told, pytest.raises(FormatError, match=r"frame 1 .*1.png\): masks must show the whole object"):
        frames.mesh(1)


def test_distance_to_a_disk_and_its_sign():
    row, column = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    radius = torch.hypot(row - 20, column - 25)
    distance = signed_mask_distance(radius <= 10.3)
    assert (distance - (radius - 10.3)).abs().max() < 1.0
    assert ((distance < 0) == (radius <= 10.3)).all()
    assert torch.equal(signed_mask_distance(radius > 10.3), -distance)


def test_a_straight_edge_is_exact():
    mask = torch.zeros(3, 6, dtype=torch.bool)
    mask[:, 3:] = True
    assert signed_mask_distance(mask)[1].tolist() == [2.5, 1.5, 0.5, -0.5, -1.5, -2.5]


def test_masks_without_outline_are_half_a_diagonal_away_from_one():
    full = torch.ones(3, 4, dtype=torch.bool)
    assert (signed_mask_distance(full) == -2.5).all()
    assert (signed_mask_distance(~full) == 2.5).all()
