"""What is written from results: every kind and ending, read back by other programs, and what is missing or wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import torchreg as tr
from tests.tables import each_row


@pytest.fixture(scope="module")
def results(registered, starfish, folder, plain_hand, plain_hand_skin, tmp_path_factory):
    """A folder with a result of every kind, and by name what each was found in."""
    place = tmp_path_factory.mktemp("results")
    clouds = [tr.load_points(folder / f"cloud{number}.ply").points for number in range(2)]
    start = torch.tensor(list(json.loads((folder / "truth0.json").read_text(encoding="utf-8")).values()))
    config = tr.AlignConfig(search="never")
    for number, cloud in enumerate(clouds):
        tr.align(plain_hand, cloud, start, model_points=plain_hand_skin, config=config).save(
            place / f"aligned{number}.safetensors"
        )
    track = tr.Tracker(plain_hand, start, model_points=plain_hand_skin).run([*clouds, clouds[0][:0]])
    track.save(place / "tracked.safetensors")
    meshes = [tr.load_mesh(starfish / f"frame{number}.ply") for number in (2, 10, 11)]
    tr.extract_spine(meshes, config=tr.SpineConfig(num_tips=5, num_samples=6)).save(place / "spine.safetensors")
    registered[1].save(place / "scan.safetensors")
    arm = tr.ArticulatedShape.from_urdf(folder / "arm.urdf")
    joints = torch.zeros(2)
    tr.BaseCalibration(
        torch.eye(4, dtype=torch.float64), joints, joints, torch.eye(6), torch.ones(3), torch.zeros(()), (),
        tr.Status.CONVERGED,
    ).save(place / "base.safetensors")  # fmt: skip
    scales = torch.zeros(arm.num_parts)
    rest = arm.rest_pose()
    poses = torch.stack([rest, rest + 0.1])
    tr.Calibration(arm, poses, scales, scales, torch.ones(()), tr.Status.CONVERGED).save(place / "size.safetensors")
    return place


def read_table(path):
    lines = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    return lines[0], lines[1:]


def read_picture(path):
    with Image.open(path) as file:
        return getattr(file, "n_frames", 1), np.asarray(file.convert("L")).std() > 1


def is_table_of_poses(found, path):
    names, (row,) = read_table(path)
    return names == list(found.shape.dof_names) and [float(value) for value in row] == found.pose.tolist()


def is_table_of_frames(found, path):
    names, rows = read_table(path)
    words = [status.value for status in found.statuses]
    numbers = torch.tensor([[float(value) for value in row[3:]] for row in rows])
    poses_agree = torch.equal(numbers, found.poses)
    return names[:3] == ["frame", "time", "status"] and [row[2] for row in rows] == words and poses_agree


def is_swc(found, path):
    """Whether numbered files hold trees whose ends are the tips."""
    for frame in range(3):
        rows = np.loadtxt(path.with_stem(f"a_{frame + 1}"))
        tips = found.tips[frame].numpy()
        distance = np.linalg.norm(rows[:, None, 2:5] - tips, axis=-1).min(0)
        if len(set(rows[:, 6]) & set(rows[:, 0])) < 2 or distance.max() > 1e-3:
            return False
    return True


def is_pose(found, path):
    return json.loads(path.read_text()) == dict(zip(found.shape.dof_names, found.pose.tolist(), strict=True))


def is_drawn(found, path):
    return read_picture(path) == (1, True)


def moves(found, path):
    """Return whether a glTF viewer finds nodes, and many triangles."""
    scene = trimesh.load_scene(path)
    return len(scene.graph.nodes) > 2 and sum(len(mesh.faces) for mesh in scene.geometry.values()) > 100


def holds(path, points):
    """Return whether a PLY file has vertices at points, and colors that differ."""
    mesh = trimesh.load(path, process=False)
    colors = getattr(mesh, "colors", None) if isinstance(mesh, trimesh.PointCloud) else mesh.visual.vertex_colors
    return np.allclose(mesh.vertices, points, atol=1e-5), len({tuple(row) for row in np.asarray(colors)}) > 1


def arrays(path):
    with np.load(path) as archive:
        return {name: archive[name] for name in archive.files}


@each_row(
    ("aligned0", "a.json", (), is_pose),
    ("aligned0", "a.csv", (), is_table_of_poses),
    ("aligned0", "a.ply", (), lambda found, path: holds(path, found.registered)[0]),
    ("aligned0", "a.glb", (), moves),
    ("aligned0", "a.png", ("cloud0.ply",), is_drawn),
    ("aligned0", "a.npz", (), lambda found, path: np.array_equal(arrays(path)["pose"], found.pose)),
    (
        "tracked",
        "a.json",
        (),
        lambda found, path: json.loads(path.read_text())["poses"]["base_x"] == found.poses[:, 0].tolist(),
    ),
    ("tracked", "a.csv", (), is_table_of_frames),
    ("tracked", "a.glb", (), moves),
    ("tracked", "a.bvh", (), lambda found, path: "Frames: 3" in path.read_text(encoding="utf-8")),
    ("tracked", "a.gif", ("cloud0.ply", "cloud1.ply", "cloud0.ply"), lambda f, path: read_picture(path) == (3, True)),
    ("tracked", "a.png", (), is_drawn),
    ("tracked", "a", ("cloud0.ply", "cloud1.ply", "cloud0.ply"), lambda found, path: len(list(path.iterdir())) == 3),
    ("spine", "a.swc", (), is_swc),
    ("spine", "a.npz", (), lambda found, path: np.array_equal(arrays(path)["tips"], found.tips)),
    ("spine", "a.csv", (), lambda found, path: read_table(path)[0][:2] == ["time", "length_0"]),
    ("spine", "a.png", (), is_drawn),
    ("spine", "a.glb", ("",), moves),
    ("spine", "a.gif", ("",), lambda found, path: read_picture(path) == (3, True)),
    ("spine", "a", ("",), lambda found, path: len(list(path.iterdir())) == 3),
    ("scan", "a.ply", (), lambda found, path: holds(path, found.deformed) == (True, True)),
    ("scan", "a.glb", (), moves),
    ("scan", "a.png", (), is_drawn),
    ("scan", "a.npz", (), lambda found, path: np.array_equal(arrays(path)["deformed"], found.deformed)),
    ("size", "a.glb", (), lambda found, path: len(trimesh.load_scene(path).geometry) == 3),
)
def test_every_ending_is_written(done, results, starfish, folder, tmp_path, name, file, options, check):
    place = starfish if name == "spine" else folder
    data = [word for option in options for word in ("--data", place / option)]
    output = done("export", results / name, "-o", tmp_path / file, *data)
    assert output.endswith(f"-> {tmp_path / file}\n")
    found = tr.load(results / f"{name}.safetensors")
    assert check(found, tmp_path / file)


def test_several_alignments_are_one_motion_and_colors_tell_distances(run, error_of, results, tmp_path):
    pair = results / "aligned0", results / "aligned1"
    assert run("export", *pair, "-o", tmp_path / "a.csv", "--quiet").output == ""
    assert len(read_table(tmp_path / "a.csv")[1]) == 2
    assert "takes one result, got 2" in error_of("export", *pair, "-o", tmp_path / "a.ply")
    assert "takes one result, got 2" in error_of("export", pair[0], results / "spine", "-o", tmp_path / "a.glb")
    for color in ("bones", "distance"):
        run("export", results / "scan", "-o", tmp_path / f"{color}.ply", "--color", color)
    assert (tmp_path / "bones.ply").read_bytes() != (tmp_path / "distance.ply").read_bytes()


def test_the_base_of_a_robot_is_written_for_ros(run, error_of, results, folder, tmp_path):
    command = "export", results / "base", "-o", tmp_path / "a.json"
    assert "a.json needs what the result does not hold; pass --shape" in error_of(*command)
    assert run(*command, "--shape", folder / "arm.urdf").exit_code == 0
    written = json.loads((tmp_path / "a.json").read_text())
    assert (written["T_camera_base"], list(written["offsets"])) == (torch.eye(4).tolist(), ["shoulder", "rail"])
    assert "--qw 1 " in written["ros2"]


def test_shapes_that_a_result_left_out_are_given(run, error_of, results, tmp_path):
    replace(tr.load(results / "tracked.safetensors"), shape=None).save(tmp_path / "bare.safetensors")
    command = "export", tmp_path / "bare", "-o", tmp_path / "a.bvh"
    assert "the result holds no shape; pass --shape" in error_of(*command)
    assert run(*command, "--shape", "hand").exit_code == 0
    run("export", results / "tracked", "-o", tmp_path / "b.bvh")
    assert (tmp_path / "a.bvh").read_bytes() == (tmp_path / "b.bvh").read_bytes()


@each_row(
    (("scan", "-o", "a.bvh"), "a ScanRegistration is not written as .bvh, but as .gif, .glb, .mp4, .npz, .pdf"),
    (("scan", "-o", "a"), "a ScanRegistration is not written as FOLDER"),
    (("tracked", "-o", "a.gif"), "a.gif needs what the result does not hold; pass --data with what was measured"),
    (("spine", "-o", "a.glb"), "a.glb needs what the result does not hold; pass --data"),
    (("aligned0", "-o", "a.png"), "a.png needs what the result does not hold; pass --data"),
    (("aligned0", "-o", "aligned0.json", "--force"), "aligned0.json is a part of the result"),
    (("aligned0", "-o", "a.csv", "--fps", "0"), "--fps must be positive"),
    (("scan", "-o", "a.ply", "--color", "red"), "--color must be one of bones, distance"),
    (("nothing", "-o", "a.csv"), "nothing.safetensors: No such file"),
    (("aligned0", "-o", "spine.json"), "spine.json exists; pass --force"),
)
def test_what_is_missing_is_named(error_of, results, words, message):
    before = sorted(results.iterdir())
    given = [results / words[0], "-o", results / words[2], *words[3:]]
    assert message in error_of("export", *given)
    assert sorted(results.iterdir()) == before
