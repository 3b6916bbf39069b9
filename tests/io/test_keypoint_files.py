"""Keypoints that a detector measured, from files."""

import json

import pytest
import torch

from torchreg.errors import FormatError
from torchreg.io.keypoints import load_keypoints


@pytest.fixture
def written(tmp_path):
    def write(content, name="k.json"):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
        return path

    return write


def test_one_frame_and_several_with_unseen_keypoints(written):
    one = load_keypoints(written([[1, 2.5], None, [3, 4]]))
    assert one.shape == (1, 3, 2)
    assert one[0, 1].isnan().all()
    torch.testing.assert_close(one[0, [0, 2]], torch.tensor([[1, 2.5], [3, 4]], dtype=torch.float64))
    several = load_keypoints(written([None, [[1, 2, 3], None], [None, None]]))
    assert several.shape == (3, 2, 3)
    assert several.isfinite().all(-1).tolist() == [[False, False], [True, False], [False, False]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read as JSON"),
        ([], "must hold a list of keypoints"),
        ({"keypoints": []}, "must hold a list of keypoints"),
        ([None, None], "must hold a list of keypoints"),
        ([[1, 2], [1, 2, 3]], r"of \[2, 3\] numbers"),
        ([[[1, 2]], [[1, 2], [3, 4]]], r"lists of \[1, 2\] keypoints"),
        ([["a", 2]], "must hold numbers, got 'a'"),
        ([[True, 2]], "must hold numbers, got True"),
        ("[[1e999, 2]]", "must hold numbers, got inf"),
    ],
)
def test_other_content_is_refused_by_the_name_of_the_file(written, content, message):
    with pytest.raises(FormatError, match=rf"k\.json: .*{message}"):
        load_keypoints(written(content))


def test_other_endings_are_refused(written):
    with pytest.raises(FormatError, match=r"must end in \.json"):
        load_keypoints(written([], "k.txt"))
