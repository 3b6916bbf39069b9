"""Spines from the command line: what is printed and written, order of frames, resumed runs, errors."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchreg as tr
from experiments.made_up.pictures import camera_ring
from tests.cli.conftest import depth_of, save_cameras, save_picture
from tests.tables import each_row
from torchreg.cli.writers import Source
from torchreg.io.points import save_points

SMALL = ("--tips", 5, "--samples", 12, "--workers", 1)
OLD = {"--swc": "a.swc", "--npz": "a.npz", "--table": "a.csv", "--plot": "a.png", "--movie": "a.gif"}


@pytest.fixture(scope="module")
def masks(starfish, tmp_path_factory):
    """Folders with the mask of a starfish, one per camera, and the calibration."""
    place = tmp_path_factory.mktemp("masks")
    mesh = tr.load_mesh(starfish / "frame2.ply")
    ring = camera_ring(mesh.vertices.mean(0), 5.0, 10, focal=190.0, width=120, height=120)
    for camera in ring:
        (place / camera.name).mkdir()
        save_picture(place / camera.name / "0.png", depth_of(mesh, camera)[1])
    save_cameras(place / "calib.json", *ring)
    return [place / name for name in ring.names], place / "calib.json"


def test_old_options_write_as_export_does_and_are_warned_of_once(run, done, starfish, tmp_path):
    given = [word if word in OLD else tmp_path / word for pair in OLD.items() for word in pair]
    output = done("spine", starfish, "-o", tmp_path / "a.glb", *given, "--pictures", tmp_path / "a", "--workers", 1)
    assert "5 tips, 1 junction, 5 limbs; 3 of 3 frames" in output
    assert tr.load(tmp_path / "a.safetensors").num_tips == 5
    (tmp_path / "new").mkdir()
    for option, name in {**OLD, "--pictures": "a", "-o": "a.glb"}.items():
        measured = ["--data", starfish] if name in ("a.gif", "a", "a.glb") else []
        assert output.count(f"{option} goes with the next release") == (option != "-o")
        run("export", tmp_path / "a", *measured, "-o", tmp_path / "new" / name)
    written = [path for path in sorted((tmp_path / "new").rglob("*")) if path.is_file()]
    assert len(written) == 3 + 4 + 3 + 1
    for path in written:
        assert path.read_bytes() == (tmp_path / path.relative_to(tmp_path / "new")).read_bytes(), path.name


def test_the_table_below_is_left_out_with_one_sentence(run, error_of, starfish, tmp_path):
    (tmp_path / "on_table").mkdir()
    table = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    for path in sorted(starfish.iterdir()):
        mesh = tr.load_mesh(path)
        table[:, 2] = mesh.vertices[:, 2].min() - 0.02
        faces = torch.cat((mesh.faces, mesh.num_vertices + torch.tensor([[0, 1, 2], [0, 2, 3]])))
        save_points(tmp_path / "on_table" / path.name, torch.cat((mesh.vertices, table.to(mesh.vertices))), faces=faces)
    common = "--workers", 1, "--quiet", "-o"
    shown = run("spine", tmp_path / "on_table", *common, tmp_path / "o.glb").output
    assert shown.count("12 points in 3 of 3 frames lie on the plane") == 1
    assert "--support keep" in shown
    assert run("spine", starfish, *common, tmp_path / "plain.glb").output == ""
    found, truth = (tr.load(tmp_path / f"{name}.safetensors") for name in ("o", "plain"))
    torch.testing.assert_close(found.tips, truth.tips, atol=1e-4, rtol=0)
    kept = run("spine", tmp_path / "on_table", "--support", "keep", *common, tmp_path / "kept.glb")
    assert "lie on the plane" not in kept.output
    assert tr.load(tmp_path / "kept.safetensors").num_tips != 5  # it is the table


def test_what_cannot_be_drawn_or_written_loses_no_result(run, starfish, tmp_path, failing):
    failing("torchreg.viz.spine_gltf.save_spine_animation", "torchreg.viz.spines.draw_measurements")
    others = "--table", tmp_path / "a.csv", "--plot", tmp_path / "a.png", "--npz", tmp_path / "a.npz"
    answer = run("spine", starfish, "-o", tmp_path / "a.glb", *SMALL, *others)
    assert answer.exit_code == 1
    assert all(f"a.{end} is not written: ArithmeticError" in answer.output for end in ("glb", "png"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.json", "a.npz", "a.safetensors"]


def test_files_are_put_in_order_and_work_goes_on(run, starfish, tmp_path):
    files = sorted(starfish.iterdir())  # by name: frame10, frame11, frame2
    options = ("-o", tmp_path / "b", "--progress", tmp_path / "kept", *SMALL)
    assert run("spine", *files, *options).exit_code == 0
    whole = tr.load(tmp_path / "b.safetensors")
    assert whole.curves.shape == (3, 5, 12, 3)
    assert run("spine", starfish, *options, "--force", "--quiet").output == ""
    assert (tr.load(tmp_path / "b.safetensors").curves == whole.curves).all()
    assert len(list((tmp_path / "kept").glob("*.safetensors"))) == 3


@each_row(
    (["x.npz"], "x.npz: No such file"),
    (["--swc", "a.txt"], "must end in .swc"),
    (["--movie", "a.txt"], "must end in .gif, .mp4"),
    (["--tips", 9], "num_tips must be what a frame shows"),
    (["--fps", 0], "--fps must be positive"),
    (["--support", "cut"], "auto, keep"),
    (["--growing", "--tips", 5], "--growing cannot be used with --tips"),
    (["--growing", "--prior", "a.swc"], "--growing cannot be used with --prior"),
    (["--resolution", 64], "--resolution has no meaning without --silhouettes"),
    (["--silhouettes"], "--silhouettes takes --calibration"),
    (["-o", "frame2.ply/a.glb"], "frame2.ply does not exist; create it first"),
)
def test_errors_take_one_line(error_of, starfish, tmp_path, options, message):
    given = [tmp_path / word if "." in str(word) else word for word in options]
    assert message in error_of("spine", starfish, "-o", tmp_path / "a.glb", *given)


def test_masks_of_several_cameras_become_a_spine(run, done, error_of, masks, tmp_path):
    folders, calibration = masks
    command = ("spine", "--silhouettes", *folders, "--calibration", calibration, "--resolution", 48)
    output = done(*command, "-o", tmp_path / "s.glb", "--progress", tmp_path / "kept")
    assert "5 tips, 1 junction, 5 limbs" in output
    whole = tr.load(tmp_path / "s.safetensors")
    assert [path.name for path in (tmp_path / "s_seen").iterdir()] == ["hull_0000.png"]
    assert run(*command, "-o", tmp_path / "s.glb", "--progress", tmp_path / "kept", "--force").exit_code == 0
    assert (tr.load(tmp_path / "s.safetensors").curves == whole.curves).all()
    out = ("-o", tmp_path / "t.glb")
    assert "holds pictures" in error_of(*command, *out, "--seen", tmp_path / "s_seen")
    assert "folders must be one per camera" in error_of("spine", "--silhouettes", tmp_path, *command[-4:], *out)


def test_a_prior_gives_the_names(run, error_of, starfish, tmp_path):
    kept = ("--progress", tmp_path / "kept", "--workers", 1, "-o")
    assert run("spine", starfish, *kept, tmp_path / "a.glb", "--swc", tmp_path / "a.swc").exit_code == 0
    spine = tr.load(tmp_path / "a.safetensors")
    assert run("spine", starfish, *kept, tmp_path / "b.glb", "--prior", tmp_path / "a.safetensors").exit_code == 0
    np.testing.assert_allclose(tr.load(tmp_path / "b.safetensors").curves, spine.curves, atol=1e-5)
    assert run("spine", starfish, *kept, tmp_path / "c.glb", "--prior", tmp_path / "a_2.swc").exit_code == 0
    rows = np.loadtxt(tmp_path / "a_2.swc")  # its ends give the names, in their order
    ends = [row[2:5] for row in rows if (rows[:, 6] == row[0]).sum() + (row[6] > 0) == 1]
    distance = tr.load(tmp_path / "c.safetensors").tips[1].numpy() - np.array(ends)
    assert np.linalg.norm(distance, axis=-1).max() < 0.1
    for name in ("a.glb", "a.json"):
        message = error_of("spine", starfish, *kept, tmp_path / "d.glb", "--prior", tmp_path / name)
        assert "--prior must be a spine (.safetensors) or a skeleton (.swc)" in message


def test_tips_that_may_grow(done, starfish, tmp_path):
    done("spine", starfish, "-o", tmp_path / "a.glb", "--growing", "--quiet", "--workers", 1)
    assert tr.load(tmp_path / "a.safetensors").births.tolist() == [0] * 5


def test_mesh_of_a_picture_begins_at_the_origin():
    near, origin = torch.eye(3, dtype=torch.float64), torch.tensor([4.0e5, -5.0e6, 30.0], dtype=torch.float64)
    for begin, vertices in ((None, near), (origin, near + origin)):
        mesh = Source([SimpleNamespace(origin=begin)]).about_origin(tr.TriangleMesh(vertices, [[0, 1, 2]]))
        torch.testing.assert_close(mesh.vertices, near, atol=1e-8, rtol=0.0)
