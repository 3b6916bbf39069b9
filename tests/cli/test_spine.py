"""Spines from the command line: what is printed and written, order of frames, resumed runs, errors."""

import numpy as np
import pytest
import torch

from experiments.made_up.pictures import camera_ring
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.io.calibration import save_cameras
from torchreg.io.images import save_image
from torchreg.io.points import load_mesh, save_points
from torchreg.io.swc import load_swc
from torchreg.storage import load
from torchreg.viz.seen import model_mask


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A folder with three meshes of a starfish, the second of them number 10 to be last but one by name alone."""
    folder = tmp_path_factory.mktemp("starfish")
    for number, mesh in zip((2, 10, 11), creature_sequence(STARFISH, 3, resolution=32).meshes, strict=True):
        save_points(folder / f"frame{number}.ply", mesh.vertices, faces=mesh.faces)
    return folder


@pytest.fixture(scope="module")
def masks(tmp_path_factory):
    """Folders with the mask of a starfish, one per camera, and the calibration."""
    place = tmp_path_factory.mktemp("masks")
    mesh = creature_sequence(STARFISH, 1, resolution=32).meshes[0]
    ring = camera_ring(mesh.vertices.mean(0), 5.0, 10, focal=190.0, width=120, height=120)
    for camera in ring:
        (place / camera.name).mkdir()
        save_image(place / camera.name / "0.png", model_mask(mesh, camera))
    save_cameras(place / "calib.json", ring)
    return [place / name for name in ring.names], place / "calib.json"


def test_everything_is_written(run, frames, tmp_path):
    options = (
        "--swc",
        "a.swc",
        "--npz",
        "a.npz",
        "--table",
        "a.csv",
        "--plot",
        "a.png",
        "--movie",
        "a.gif",
        "--pictures",
        "pictures",
    )
    options = [tmp_path / option if not option.startswith("--") else option for option in options]
    answer = run("spine", frames, "-o", tmp_path / "a.glb", *options)
    assert answer.exit_code == 0, answer.output
    assert "5 tips, 1 junction, 5 limbs; 3 of 3 frames" in answer.output
    found = load(tmp_path / "a.safetensors")
    assert found.num_tips == 5
    trees = [load_swc(tmp_path / f"a_{number}.swc") for number in (1, 2, 3)]
    assert {tree.topology for tree in trees} == {"(()()()()())"}
    with np.load(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive["curves"], found.curves.numpy())
        assert archive["tips"].shape == (3, 5, 3)
    assert len(list((tmp_path / "pictures").glob("frame_*.png"))) == 3
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0].startswith("time,length_0,")
    assert [float(line.split(",")[1]) for line in lines[1:]] == pytest.approx(
        found.measurements().lengths[:, 0].tolist()
    )
    for name in ("a.glb", "a.json", "a.gif", "a.png"):
        assert (tmp_path / name).stat().st_size > 0


def test_the_table_below_is_left_out_with_one_sentence(run, error_of, frames, tmp_path):
    (tmp_path / "on_table").mkdir()
    table = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    for path in sorted(frames.iterdir()):
        mesh = load_mesh(path)
        table[:, 2] = mesh.vertices[:, 2].min() - 0.02
        faces = torch.cat((mesh.faces, mesh.num_vertices + torch.tensor([[0, 1, 2], [0, 2, 3]])))
        save_points(tmp_path / "on_table" / path.name, torch.cat((mesh.vertices, table.to(mesh.vertices))), faces=faces)
    told = run("spine", tmp_path / "on_table", "-o", tmp_path / "o.glb", "--workers", 1, "--quiet").output
    assert told.count("12 points in 3 of 3 frames lie on the plane") == 1
    assert "--support keep" in told
    plain = run("spine", frames, "-o", tmp_path / "plain.glb", "--workers", 1, "--quiet")
    assert plain.output == ""
    found, truth = (load(tmp_path / f"{name}.safetensors") for name in ("o", "plain"))
    torch.testing.assert_close(found.tips, truth.tips, atol=1e-4, rtol=0)
    kept = run("spine", tmp_path / "on_table", "-o", tmp_path / "kept.glb", "--workers", 1, "--support", "keep")
    assert "lie on the plane" not in kept.output
    assert load(tmp_path / "kept.safetensors").num_tips != 5  # it is the table
    assert "auto, keep" in error_of("spine", frames, "-o", tmp_path / "no.glb", "--support", "cut")


def test_what_cannot_be_drawn_or_written_loses_no_result(run, frames, tmp_path, failing):
    failing("torchreg.viz.spine_gltf.save_spine_animation", "torchreg.viz.spines.draw_measurements")
    beside = "--table", tmp_path / "a.csv", "--plot", tmp_path / "a.png", "--npz", tmp_path / "a.npz"
    answer = run("spine", frames, "-o", tmp_path / "a.glb", "--tips", 5, "--samples", 12, *beside)
    assert answer.exit_code == 1
    assert all(f"a.{end} is not written: ArithmeticError" in answer.output for end in ("glb", "png"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.json", "a.npz", "a.safetensors"]


def test_files_are_put_in_order_and_work_goes_on(run, frames, tmp_path):
    files = sorted(frames.iterdir())  # by name: frame10, frame11, frame2
    options = ("-o", tmp_path / "b", "--progress", tmp_path / "kept", "--tips", 5, "--samples", 12)
    assert run("spine", *files, *options).exit_code == 0
    whole = load(tmp_path / "b.safetensors")
    assert whole.curves.shape == (3, 5, 12, 3)
    assert run("spine", frames, *options, "--force", "--quiet").output == ""
    assert (load(tmp_path / "b.safetensors").curves == whole.curves).all()
    assert len(list((tmp_path / "kept").glob("*.safetensors"))) == 3


def test_nothing_is_overwritten_unasked(error_of, frames, tmp_path):
    (tmp_path / "a.glb").write_bytes(b"")
    assert "exists; pass --force" in error_of("spine", frames, "-o", tmp_path / "a.glb")


def test_errors_take_one_line(error_of, frames, tmp_path):
    out = ("-o", tmp_path / "a.glb")
    assert "x.npz: No such file" in error_of("spine", tmp_path / "x.npz", *out)
    assert "must end in .swc" in error_of("spine", frames, *out, "--swc", tmp_path / "a.txt")
    assert "num_tips must be what a frame shows" in error_of("spine", frames, *out, "--tips", 9)
    assert "--fps must be positive" in error_of("spine", frames, *out, "--fps", 0)


def test_masks_of_several_cameras_become_a_spine(run, error_of, masks, tmp_path):
    folders, calibration = masks
    command = ("spine", "--silhouettes", *folders, "--calibration", calibration, "--resolution", 48)
    answer = run(*command, "-o", tmp_path / "s.glb", "--progress", tmp_path / "kept")
    assert answer.exit_code == 0, answer.output
    assert "5 tips, 1 junction, 5 limbs" in answer.output
    whole = load(tmp_path / "s.safetensors")
    assert whole.num_tips == 5
    assert [path.name for path in (tmp_path / "s_seen").iterdir()] == ["hull_0000.png"]
    assert run(*command, "-o", tmp_path / "s.glb", "--progress", tmp_path / "kept", "--force").exit_code == 0
    assert (load(tmp_path / "s.safetensors").curves == whole.curves).all()
    out = ("-o", tmp_path / "t.glb")
    assert "--silhouettes takes --calibration" in error_of("spine", "--silhouettes", *folders, *out)
    assert "no meaning without --silhouettes" in error_of("spine", *folders, "--resolution", 64, *out)
    assert "holds pictures" in error_of(*command, *out, "--seen", tmp_path / "s_seen")
    assert "folders must be one per camera" in error_of("spine", "--silhouettes", tmp_path, *command[-4:], *out)


def test_a_prior_gives_the_names(run, frames, tmp_path):
    kept = ("--progress", tmp_path / "kept", "-o")
    assert run("spine", frames, *kept, tmp_path / "a.glb", "--swc", tmp_path / "a.swc").exit_code == 0
    spine = load(tmp_path / "a.safetensors")
    assert run("spine", frames, *kept, tmp_path / "b.glb", "--prior", tmp_path / "a.safetensors").exit_code == 0
    np.testing.assert_allclose(load(tmp_path / "b.safetensors").curves, spine.curves, atol=1e-5)
    prior = load_swc(tmp_path / "a_2.swc")
    assert run("spine", frames, *kept, tmp_path / "c.glb", "--prior", tmp_path / "a_2.swc").exit_code == 0
    distance = load(tmp_path / "c.safetensors").tips[1] - prior.nodes[prior.tips]
    assert float(distance.norm(dim=-1).max()) < 0.1
    for name in ("a.glb", "a.json"):
        answer = run("spine", frames, *kept, tmp_path / "d.glb", "--prior", tmp_path / name)
        assert answer.exit_code == 2
        assert "--prior must be a spine (.safetensors) or a skeleton (.swc)" in " ".join(answer.output.split())


def test_numbers_of_tips_do_not_go_with_growth(run, error_of, frames, tmp_path):
    for option in (("--tips", 5), ("--prior", tmp_path / "a.swc")):
        assert f"--growing cannot be used with {option[0]}" in error_of("spine", frames, "--growing", *option)
    answer = run("spine", frames, "-o", tmp_path / "a.glb", "--growing", "--swc", tmp_path / "a.swc", "--quiet")
    assert answer.exit_code == 0, answer.output
    assert load(tmp_path / "a.safetensors").births.tolist() == [0] * 5
    assert load_swc(tmp_path / "a_2.swc").topology == "(()()()()())"
