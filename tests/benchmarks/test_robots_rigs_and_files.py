"""Benchmarks of robots, rigs and users' files on small files made here."""

import json
import math
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from tests.rigging.conftest import bending_arm, posed
from torchreg.io.gltf_write import save_animated_skin


def link(name, x, z, solid):
    origin = f'<origin xyz="{x} 0 {z}"/>'
    return f'<link name="{name}"><visual>{origin}<geometry>{solid}</geometry></visual></link>'


def joint(name, kind, parent, child, xyz, axis, lower, upper):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
    limit = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}</joint>'


# A box on a hinge whose limits exclude zero, a box that slides, and a round cap that turns about its own axis.
ARM = [
    link("base", 0, 0, '<box size="0.2 0.16 0.1"/>'), link("upper", 0.15, 0, '<box size="0.3 0.06 0.08"/>'),
    link("slide", 0.08, 0, '<box size="0.16 0.04 0.05"/>'), link("cap", 0, 0, '<sphere radius="0.04"/>'),
    joint("hinge", "revolute", "base", "upper", "0.1 0 0", "0 0 1", 0.4, 1.6),
    joint("rail", "prismatic", "upper", "slide", "0.3 0 0", "1 0 0", 0, 0.05),
    joint("flange", "revolute", "slide", "cap", "0.2 0 0", "1 0 0", -3, 3),
]  # fmt: skip
# A box on the ground, and one that turns on it.
TOWER = [
    link("base", 0, 0, '<box size="0.3 0.3 0.2"/>'), link("upper", 0, 0.3, '<box size="0.1 0.08 0.6"/>'),
    joint("hinge", "revolute", "base", "upper", "0 0 0.1", "0 1 0", -1.6, 1.6),
]  # fmt: skip
TENSOR = {"dtype": torch.float64}


def written(path, lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<?xml version="1.0"?><robot name="arm">{"".join(lines)}</robot>', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory):
    return written(tmp_path_factory.mktemp("robot") / "robots" / "arm" / "urdf" / "arm.urdf", ARM)


@pytest.fixture
def sphere():
    """A ball of radius 1 as vertices and faces."""
    ball = trimesh.creation.icosphere(3)
    return torch.tensor(np.array(ball.vertices)), torch.tensor(np.array(ball.faces)).long()


def test_starts_of_robots_are_off_by_twenty_degrees_and_stay_inside_the_limits(load, arm_file):
    bench, shape = load("robot"), tr.ArticulatedShape.from_urdf(arm_file, free_base=False)
    assert bench.turning_joints(shape).tolist() == [True, False, True]
    for seed in range(5):
        truth, start = bench.random_poses(shape, 1.0, torch.Generator().manual_seed(seed))
        torch.testing.assert_close(truth, shape.clamp(truth))
        off = (start - truth).abs()
        expected = torch.tensor([math.radians(20), 0.01, math.radians(20)])
        torch.testing.assert_close(off[6:], expected, atol=1e-5, rtol=0)
        assert not off[:6].any()


def test_a_hinge_whose_limits_exclude_zero_is_found_and_a_round_flange_is_not_determined(load, arm_file):
    bench, shape = load("robot"), tr.ArticulatedShape.from_urdf(arm_file, free_base=False)
    with torch.no_grad():
        trial = bench.make_trial(shape, shape.file_skin(), 0, 900)
        outcome = bench.measure("arm", shape, 3, tr.AlignConfig(search="never"), 500)
    hinge, _, flange = trial.bound.tolist()
    assert (len(trial.data), hinge < math.radians(0.1), flange > bench.DETERMINED_BELOW) == (1000, True, True)
    assert outcome.names == ("hinge", "flange")
    assert float(outcome.errors[:, 0].median()) < 1.0
    assert outcome.passed()


def test_a_small_robot_gives_a_table_and_a_size(load, arm_file, monkeypatch, capsys):
    bench = load("robot")
    monkeypatch.setattr(bench, "ROBOTS", {"Allegro hand": "arm/urdf/arm.urdf"})
    assert bench.main(["--data", str(arm_file.parents[2]), "--smoke", "--search", "never"]) == 0
    printed = capsys.readouterr().out
    assert "Allegro hand, free base" in printed
    assert "flange 100%" in printed
    box = written(arm_file.with_name("box.urdf"), TOWER[:1])
    monkeypatch.setattr(sys, "argv", ["gltf_sizes.py", str(box)])
    load("gltf_sizes").main()
    assert capsys.readouterr().out.split() == ["box", "12", "triangles", "0.00", "MB"]


@pytest.fixture
def robots(load, tmp_path, monkeypatch):
    bench = load("scan_robots")
    written(tmp_path / "robots" / "arm.urdf", TOWER)
    monkeypatch.setattr(bench, "ROBOTS", {"arm": "arm.urdf", "missing": "missing.urdf"})
    monkeypatch.setattr(bench, "SCANNER", bench.DepthScanner(num_points=600, noise=0.0, num_holes=0))
    return tmp_path / "robots"


def test_truths_of_robots_are_where_the_target_was_scanned(load, robots, capsys):
    bench = load("scan_robots")
    (thing,) = bench.robots(robots)
    with torch.no_grad():
        pair = bench.make_pair(thing, 2, 0)
    moved = (pair.truth - pair.source.points).norm(dim=-1)
    # The upper box moves; the ground does not.
    assert float((moved < 1e-6).double().mean()) > 0.2
    assert float((moved > 0.01).double().mean()) > 0.2
    assert float(torch.cdist(pair.truth, pair.target.points).amin(1).median()) < float(pair.target.spacing)
    assert bench.main(["--robots", str(robots), "--smoke"]) == 0
    assert "1 /   1" in capsys.readouterr().out


@pytest.mark.parametrize("up", [1, 2])
def test_the_camera_has_up_up(load, up):
    frame, tilted = (load("scan_robots").camera_frame(0.7, math.radians(tilt), up) for tilt in (0, 20))
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, **TENSOR))
    assert float(torch.linalg.det(frame)) == pytest.approx(1)
    torch.testing.assert_close(frame[:, up], torch.tensor([0.0, -1.0, 0.0], **TENSOR))
    assert float(tilted[1, up]) == pytest.approx(-math.cos(math.radians(20)))


@pytest.fixture
def bar(load, sphere, monkeypatch):
    """An upright bar, the upper half of which turns by so many radians."""
    bench, (vertices, faces) = load("scan_animals"), sphere
    first = vertices * torch.tensor([0.1, 0.1, 0.6])

    def poses(share, generator):
        turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0, share], [0, 0, 0], [-share, 0, 0]], **TENSOR))
        return first, torch.lerp(first, first @ turn, (first[:, 2:] / 0.1).sigmoid())

    scanner = load("scan_robots").DepthScanner(600, noise=0.0, num_holes=0)
    monkeypatch.setitem(bench.scan_pair.__globals__, "SCANNER", scanner)
    return bench.Animal("bar", faces, poses)


def test_truths_of_animals_are_where_the_target_was_scanned(load, bar, monkeypatch, capsys):
    bench = load("scan_animals")
    pair, other = (bench.make_pair(bar, 0.5, number, 0) for number in (1, 2))
    assert float(torch.cdist(pair.truth, pair.target.points).amin(1).median()) < float(pair.target.spacing)
    assert float((pair.truth - pair.source.points).norm(dim=-1).max()) > 0.05
    assert len(other.source) != len(pair.source) or not torch.equal(other.source.points, pair.source.points)
    for name, value in (("APART", (0.05,)), ("animals_folder", lambda: "x"), ("animals", lambda folder: [bar])):
        monkeypatch.setattr(bench, name, value)
    assert bench.main(["--pairs", "1"]) == 0
    assert "bar, 5%" in (printed := capsys.readouterr().out)
    assert "all" in printed


def test_skins_follow_their_bones_as_mujoco_draws_them(load):
    mujoco, bench, data = pytest.importorskip("mujoco"), load("scan_animals"), []
    folder = bench.animals_folder() or pytest.skip("dm_control is not installed")
    with pytest.MonkeyPatch.context() as patch:
        made = mujoco.MjData
        patch.setattr(mujoco, "MjData", lambda model: data.append((model, made(model))) or data[-1][1])
        found = list(bench.animals(folder))
    assert {each.name for each in found} == set(bench.ANIMALS)
    for animal, (model, state) in zip(found, data, strict=True):
        first, second = animal.poses(0.1, torch.Generator().manual_seed(0))
        assert int(animal.faces.max()) == len(second) - 1
        assert float((second - first).norm(dim=-1).max()) > 0.01
        scene, view = mujoco.MjvScene(model, maxgeom=1000), (mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(model, state, mujoco.MjvOption(), None, *view, scene)
        drawn = torch.from_numpy(np.array(scene.skinvert)).reshape(-1, 3).double()
        # MuJoCo draws in single precision, and may inflate a skin.
        torch.testing.assert_close(second, drawn, atol=1e-5 + float(model.skin_inflate[0]), rtol=0)


@pytest.fixture
def finger(sphere):
    """A stretched sphere of 12 cm along y with a palm and two phalanges."""
    vertices = sphere[0].float() * torch.tensor([0.01, 0.06, 0.008])
    along = vertices[:, 1]
    split = torch.stack([torch.sigmoid((along + 0.02) / 0.002), torch.sigmoid((along - 0.02) / 0.002)], dim=-1)
    weights = torch.stack([1 - split[:, 0], split[:, 0] - split[:, 1], split[:, 1]], dim=-1).clamp_min(0)
    joints = torch.tensor([[0.0, -0.06, 0.0], [0.0, -0.02, 0.0], [0.0, 0.02, 0.0]])
    names = ["wrist", "index-finger-phalanx-proximal", "index-finger-phalanx-distal"]
    return tr.ArticulatedShape.from_skinned_mesh(
        vertices, sphere[1], weights, joints, [-1, 0, 1], joint_names=names, axes={name: ["x"] for name in names[1:]}
    )


def test_a_small_rigged_hand_gives_a_table(load, finger, capsys):
    bench = load("rig_hand")
    parents = bench.hand_parents()
    assert len(parents) == 25
    assert [name for name, parent in parents.items() if parent is None] == ["wrist"]
    assert parents["thumb-phalanx-distal"] == "thumb-phalanx-proximal"
    pose = bench.flexed_pose(finger, 15)
    torch.testing.assert_close(pose[6:], torch.full((2,), -math.radians(15)))
    with torch.no_grad():
        assert bench.make_problem(finger.file_skin(), pose, 0, 450).data.shape == (500, 3)
        rows = bench.compare(finger, (15,), 1, rivals=False, count=450)
    by_name = {row.method: row for row in rows}
    assert by_name["torchreg, file skin"].mean[0] < 0.3 * by_name["not aligned"].mean[0]
    assert [row.method for row in rows if not row.judged] == ["not aligned", "bending skin on the true pose"]
    bench.print_table(rows)
    assert len(capsys.readouterr().out.splitlines()) == len(rows) + 2


@pytest.mark.parametrize(("rival", "package"), [("rigid_icp", "small_gicp"), ("coherent_point_drift", "pycpd")])
def test_rivals_return_none_where_they_are_not_installed(load, finger, monkeypatch, rival, package):
    monkeypatch.setitem(sys.modules, package, None)
    with torch.no_grad():
        problem = load("rig_hand").make_problem(finger.file_skin(), finger.rest_pose(), 0, 90)
    assert getattr(load("rig_hand"), rival)(problem) is None


@pytest.fixture
def bar_file(sphere, tmp_path):
    """A bar of two bones whose second moves up in its clip, and two files that are no rigs."""
    vertices = sphere[0] * torch.tensor([0.3, 0.05, 0.05])
    second = torch.sigmoid(40 * vertices[:, 0])
    rest = torch.eye(4, **TENSOR).repeat(2, 1, 1)
    rest[0, 0, 3] = -0.3
    moving = rest.repeat(2, 1, 1, 1)
    moving[1, :, 1, 3] = 0.1
    weights, times = torch.stack([1 - second, second], dim=-1), torch.tensor([0.0, 1.0])
    save_animated_skin(tmp_path / "bar.glb", vertices, sphere[1], weights, ["a", "b"], [-1, 0], rest, moving, times)
    for name in "cd":
        (tmp_path / f"{name}.gltf").write_text("{}", encoding="utf-8")
    return tmp_path / "bar.glb"


def test_a_folder_of_rigs_is_summed_up(load, bar_file, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["public_rigs.py", "--data", str(bar_file.parent)])
    load("public_rigs").main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("1 of 3 opened")
    assert [row.split()[:2] for row in lines[1:]] == [["loaded", "1"], ["refined", "1"], ["refused", "2"]]
    assert "no node carries both a mesh and a skin" in lines[3]


def test_rigs_from_starts_are_near_their_poses(load, bar_file, capsys):
    load("rig_starts").main([str(bar_file), "--count", "1"])
    alone, searched = capsys.readouterr().out.splitlines()
    assert "search never" in alone
    assert "search auto" in searched
    assert all(float(re.search(r"error +([\d.]+)%", row)[1]) < 1 for row in (alone, searched))


def test_bones_of_rigs_are_measured_grown_and_written(load, bar_file):
    bench = load("shape_fit")
    ((lengths, moved),) = bench.clip_lengths(bar_file)
    torch.testing.assert_close(lengths, torch.full((10, 1), 0.3, **TENSOR))
    assert moved == pytest.approx(0.09, abs=1e-6)
    rig = tr.ArticulatedShape.from_gltf(bar_file)
    person = rig.with_bone_coefficients()
    truth, _, points = bench.grown_scan(person, 0.0, 0)
    assert points.shape == (bench.NUM_POINTS, 3)
    assert bench.bone_lengths(person, truth).tolist() == pytest.approx([0.3 * 1.12])
    grown, placed = person.with_coefficients(truth), rig.rest_pose()
    placed[0] = 0.1
    report = bench.file_report(bar_file, SimpleNamespace(to_gltf=grown.to_gltf, pose=placed, shape=grown))
    assert "joints move in 1 of 1 clips (before 1)" in report
    assert "vertices read back within 0.000 mm" in report


def test_a_split_rig_has_the_same_surface_and_coefficients(load, sphere):
    vertices, faces = sphere
    shape = tr.ArticulatedShape.from_skinned_mesh(
        vertices, faces, torch.ones(len(vertices), 1), torch.zeros(1, 3), [-1], shape_dirs=vertices.unsqueeze(-1),
        joint_dirs=torch.zeros(1, 3, 1), dtype=torch.float64,
    )  # fmt: skip
    finer, grown = load("shape_fit").split(shape), torch.ones(1, **TENSOR)
    assert len(finer.surface.vertices) == len(vertices) + len(faces) * 3 // 2
    assert len(finer.surface.faces) == 4 * len(faces)
    meshes = [tr.TriangleMesh(one.vertices(one.rest_pose(), grown), one.surface.faces) for one in (shape, finer)]
    assert float(meshes[0].face_areas().sum()) == pytest.approx(float(meshes[1].face_areas().sum()))
    assert float((meshes[0].vertices.norm(dim=-1) - 2).abs().max()) < 1e-9


def test_cases_of_users_files_are_counted(load, tmp_path, monkeypatch, capsys):
    command = "python: import torchreg; print(len(torchreg.load_points('{dir}/cloud.xyz')), 'points')"
    cases = []
    for name, content in (("new_bom_xyz", "1 0 0\n" * 50), ("numpy_array", "1 0 0\n" * 49)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cloud.xyz").write_text(content)
        cases.append({"name": name, "kind": "C3", "command": command, "expected": "50 points"})
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    monkeypatch.setattr(sys, "argv", ["users_files.py", "--cases", str(tmp_path)])
    load("users_files").main()
    printed = capsys.readouterr().out
    assert printed.endswith("1 of 2 cases are right\n")
    assert "WRONG C3 numpy_array: exit 0: 49 points" in printed


def test_judges_of_users_files_read_errors_warnings_and_numbers(load, tmp_path):
    bench = load("users_files")
    script = "python: import warnings; warnings.warn('T is in millimetres: 60 m apart'); print(1.5, -2e-3)"
    loud = bench.run(script, tmp_path)
    assert (loud.code, loud.numbers[:2], loud.warned) == (0, [1.5, -2e-3], True)
    assert bench.JUDGES["stereo_T_mm"](loud)
    assert bench.near([1.5, -0.002])(loud)
    assert not bench.near([1.5, 0.2])(loud)
    refused = bench.run("python: import torchreg; torchreg.load_points('{dir}/none.ply')", tmp_path)
    assert (refused.code, "none.ply" in refused.text) == (1, True)
    assert bench.run("info hand", tmp_path).code == 0


def test_reading_is_timed(load, capsys, monkeypatch):
    reading = load("reading")
    monkeypatch.setattr(reading, "REPEATS", 1)
    monkeypatch.setattr(reading, "time_rigs", lambda folder, data: print("rigs", data))
    monkeypatch.setattr(sys, "argv", ["reading.py", "--points", "500"])
    reading.main()
    printed = capsys.readouterr().out
    assert all(f"500 points .{ending}: torchreg" in printed for ending in ("ply", "xyz", "csv", "npz"))
    assert printed.endswith("rigs None\n")


def test_a_rig_of_a_sequence_is_nearer_than_what_stands_still(load, tmp_path, capsys):
    arm = bending_arm()
    stored = torch.stack([posed(arm, angle) for angle in (0.0, 0.4, 0.8)])
    np.savez(tmp_path / "arm.npz", vertices=stored.numpy(), faces=arm.mesh.faces.numpy())
    load("rig_sequence").main(["--data", str(tmp_path), "--captured", "arm"])
    (row,) = capsys.readouterr().out.splitlines()
    moved, still = (float(re.search(rf"{word} +([\d.]+)%", row)[1]) for word in ("rig", "still"))
    assert moved < 0.3 * still
    load("rig_sequence").main([])
    assert "--data" in capsys.readouterr().out
