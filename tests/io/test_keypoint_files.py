"""Keypoints that a detector measured, from files."""

import torch

from tests.io.helpers import put
from tests.tables import refused, refusing
from torchreg.io.keypoints import load_keypoints


def test_one_frame_and_several_with_unseen_keypoints(tmp_path):
    one = load_keypoints(put(tmp_path, "k.json", [[1, 2.5], None, [3, 4]]))
    assert one.shape == (1, 3, 2)
    assert one[0, 1].isnan().all()
    torch.testing.assert_close(one[0, [0, 2]], torch.tensor([[1, 2.5], [3, 4]], dtype=torch.float64))
    several = load_keypoints(put(tmp_path, "k.json", [None, [[1, 2, 3], None], [None, None]]))
    assert several.shape == (3, 2, 3)
    assert several.isfinite().all(-1).tolist() == [[False, False], [True, False], [False, False]]


test_other_lists = refusing(lambda folder, content: load_keypoints(put(folder, "k.json", content)), file="k.json: ")(
    ("{", "cannot be read as JSON"),
    ([], "must hold a list of keypoints"),
    ({"keypoints": []}, "must hold a list of keypoints .* an object with keypoints"),
    ([None, None], "must hold a list of keypoints"),
    ([[1, 2], [1, 2, 3]], r"of \[2, 3\] numbers"),
    ([[[1, 2]], [[1, 2], [3, 4]]], r"lists of \[1, 2\] keypoints"),
    ([["a", 2]], "must hold numbers, got 'a'"),
    ([[True, 2]], "must hold numbers, got True"),
    ("[[1e999, 2]]", "must hold numbers, got inf"),
)


def openpose(right, left=()):
    return {"version": 1.3, "people": [{"hand_right_keypoints_2d": right, "hand_left_keypoints_2d": list(left)}]}


def mediapipe(*hands):
    """What the landmarker's result holds: shares of the picture, and the side of each hand."""
    return {
        "hand_landmarks": [[{"x": x, "y": y, "z": 0.0} for x, y in points] for points, _ in hands],
        "handedness": [[{"category_name": side, "score": 0.9}] for _, side in hands],
    }


def test_files_of_openpose_give_pixels_of_one_side_frame_by_frame(tmp_path):
    right = [float(number) for number in range(63)]
    right[5] = 0.0  # the second keypoint's confidence: not seen
    put(tmp_path, "v_000000000010_keypoints.json", openpose(right, [1.0] * 63))
    put(tmp_path, "v_000000000009_keypoints.json", {"version": 1.3, "people": []})
    frames = load_keypoints(tmp_path, side="right")
    assert frames.shape == (2, 21, 2)
    assert frames[0].isnan().all()
    assert frames[1].isfinite().all(-1).tolist() == [True, False] + [True] * 19
    assert frames[1, 2].tolist() == [6.0, 7.0]
    assert (load_keypoints(tmp_path, side="left")[1] == 1).all()


def test_files_of_mediapipe_give_pixels_of_the_picture(tmp_path):
    share = [(k / 21, 0.5) for k in range(21)]
    content = [mediapipe((share, "Left"), (share[::-1], "Right")), mediapipe((share, "Left")), mediapipe()]
    frames = load_keypoints(put(tmp_path, "k.json", content), side="right", picture=(640, 480))
    assert frames.shape == (3, 21, 2)
    torch.testing.assert_close(frames[0, 20], torch.tensor([-0.5, 239.5], dtype=torch.float64))
    torch.testing.assert_close(frames[1, 0], torch.tensor([-0.5, 239.5], dtype=torch.float64))
    assert frames[2].isnan().all()
    old = {"landmark": content[1]["hand_landmarks"][0]}
    torch.testing.assert_close(load_keypoints(put(tmp_path, "k.json", old), picture=(640, 480))[0], frames[1])


test_other_detections = refusing(
    lambda folder, content: load_keypoints(put(folder, "k.json", content), picture=(640, 480)), file="k.json: "
)(
    (openpose([1.0] * 62), "must hold 63 numbers"),
    (openpose(["a"] * 63), "must hold numbers, got 'a'"),
    (mediapipe(([(0, 0)] * 20, "Left")), "must have 21 landmarks"),
    ({"landmark": [{"x": 1}] * 21}, "must have x and y"),
    ({"boxes": []}, "or what MediaPipe .* got an object with boxes"),
)


def test_shares_of_a_picture_need_its_size_and_the_ending_is_json(tmp_path):
    path, text = put(tmp_path, "k.json", mediapipe()), put(tmp_path, "k.txt", [])
    refused(
        (lambda: load_keypoints(path), "shares of a picture whose size is not known"),
        (lambda: load_keypoints(text), r"must end in \.json"),
    )
