"""Each benchmark runs in a version of seconds and prints its figures; without its data it says so."""

import re
import sys

import pytest

# Script, arguments, and what the whole output must contain in this order (a dot matches line breaks too).
RUNS = [
    (
        "big_scans",
        "--smoke",
        r"hand, no start  .*12000 points.*pass\n.* with a start  .*pass\nregister.*pass\nskel.*pass$",
    ),
    (
        "bones",
        "--smoke --threads 1",
        r"grid .*moments .*deform .*T-step, binary .*blended .*refine .*joints .*far .*drag ",
    ),
    (
        "calibrate_confidence",
        "--smoke --only presence",
        r"PresenceModel\(bias=\S+, weights=\(.+\)\)",
    ),
    ("company", "--smoke", r"beside +1 clouds: right .*touching +1 .*all +2 .*sure and wrong.*sure of what is right"),
    ("depth_frames", "--smoke", r"cut: left out .*whole: left out.*clouds: 1 cases.*landmarks, both.*track, .*track, "),
    ("depth_pairs", "--smoke", r"made up: 1 pairs, overlap 0\.[5-9].*whole .*moved .*true masks +registered"),
    ("depth_pictures", "--smoke", r"reprojection.*farthest from its pixel, px \(<= 0.5\) +(0\.[0-4]|\d\S*e-).*normals"),
    ("experiments", "--smoke --part overhead", r"overhead per trial.*finished, s +0.*pass"),
    ("experiments", "--smoke --part many", r"collect, s.*report, s.*both, s.*pass"),
    ("find_pose", "--smoke --threads 1", r"whole .*right >= 95%: .*front .*right >= 80%: .*confidence"),
    ("grid_lbs", "--smoke", r"random +\S+e-.*zero.*negative.*large.*all corners +(0.9|1.00).*energy, toy: "),
    ("growing_spines", "--smoke", r"births 100.0%, ends 100.0%, right 100.0%, shown 100.0%  pass"),
    ("kills", "--smoke", r"lost 0, repeated 0"),
    ("modules", "--smoke", r"sizes, poses known .*sizes, poses learnt .*nu .*sharpness "),
    ("outliers", "--smoke", r"whole.*both >= 0.95: .*one side.*both >= 0.95: "),
    ("own_hand", "--smoke --case exact", r"align.*mean <= 1.5 mm: .*least squares.*align.*mean <= 1.5 mm: .*bound"),
    ("pose_initializer", "--smoke --threads 1", r"gradient within 1e-05: pass"),
    (
        "rivals",
        "--smoke --threads 1 --output {folder}",
        r"EM c / 10.*claims, whole(.*(CONFIRM|CONTRAD|NOT DEC)\w*){9}.*png",
    ),
    ("scan_alignment", "--smoke --pairs 1", r"skipped: pairs from files.*person, 1 apart.*1 of 1"),
    (
        "scan_registration",
        "--smoke --verbose",
        r"default.*toy, moved.*last over the mean pair.*last over the first.*animal",
    ),
    (
        "skeletonize",
        "--smoke",
        r"topology starfish.*100.0% of 1 frames alike, 1 topologies; 5 tips, junctions \[5\].*sequence",
    ),
    ("speed", "--smoke --threads 1", r"(alignments/s.*){5}operations per alignment"),
    ("spines", "--smoke", r"captured: left out.*starfish .* 100.00%  pass.*hands.*100.0% right"),
    (
        "stereo_pictures",
        "--smoke",
        r"rotation, points by semi-global.*median 3-D error, mm \(<= 3\) +[0-4]\..*disparity",
    ),
    ("threads", "--smoke", r"other bits than alone: 0 of 6.*threads of torch: 1 before, 1 after, 1 in a new thread"),
    ("tracking", "--smoke --case long --threads 1", r"^long.*of \d+ bars met$"),
    ("untrusted_files", "--smoke", r"leaks 0, hangs 0"),
    ("visual_hull", "--smoke", r"volume over exact hull +(0.9[3-9]|1.0[0-6]).*tips \(5\) +5\b.*limbs \(5\) +5\b"),
]

# Script, arguments, a function of the script that finds nothing, and what is printed.
SKIPPED = [
    ("base_calibration", "--data {folder}", None, "skipped: no xarm7/truth.json in --data"),
    ("company", "", None, "skipped: needs --data with library"),
    ("gltf_sizes", "", "robots_folder", "no robots"),
    ("pose_initializer", "--device cuda --smoke", "torch.cuda.is_available", "no CUDA device"),
    ("rig_hand", "", None, "skipped: webxr_hand_right.glb"),
    ("rig_hand", "--data {folder} --smoke", None, "skipped: webxr_hand_right.glb"),
    ("robot", "--data {folder}", None, "skipped: no robots found"),
    ("scan_animals", "", "animals_folder", "skipped: no animals found"),
    ("scan_registration", "--pairs 0", None, "skipped: pairs from files"),
    ("scan_robots", "--data {folder}", "robots_folder", "skipped: no robots found"),
    ("shape_confidence", "", "find_spec", "skipped: anny is not installed"),
    ("shape_fit", "", "find_spec", "skipped: anny is not installed"),
    ("shape_fit", "--part bones --data {folder}", None, r"skipped: --data must be a folder with rigs/\*.glb"),
    ("users_files", "", None, "nothing is counted"),
]

REFUSED = [
    ("behavior", "--only algin", "unknown cases: algin"),
    ("confidence", "--only arm", "--only arm needs --data"),
    ("scan_registration", "--sequences 2", "--sequences needs --frames"),
    ("tracking", "--case rig --data {folder}", r"webxr_hand_right.glb in it"),
]


@pytest.fixture
def printed(load, monkeypatch, capsys, tmp_path):
    """Return the function that runs a script and returns what it prints."""

    def run(script, arguments):
        monkeypatch.setattr(sys, "argv", [script, *arguments.format(folder=tmp_path).split()])
        assert load(script).main() != 1
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize(("script", "arguments", "pattern"), RUNS)
def test_smoke_runs_print_their_figures(printed, script, arguments, pattern):
    assert re.search(pattern, printed(script, arguments), re.DOTALL)


@pytest.mark.parametrize(("script", "arguments", "absent", "words"), SKIPPED)
def test_without_its_data_a_benchmark_says_so_and_succeeds(
    load, printed, monkeypatch, script, arguments, absent, words
):
    if absent:
        owner, name = load(script), absent
        while "." in name:
            first, _, name = name.partition(".")
            owner = getattr(owner, first)
        monkeypatch.setattr(owner, name, lambda *_: None)
    assert re.search(words, printed(script, arguments))


@pytest.mark.parametrize(("script", "arguments", "words"), REFUSED)
def test_wrong_arguments_are_refused(printed, capsys, script, arguments, words):
    with pytest.raises(SystemExit):
        printed(script, arguments)
    assert re.search(words, capsys.readouterr().err)
