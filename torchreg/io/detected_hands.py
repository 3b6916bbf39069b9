"""Keypoints of hands as detectors write them: the JSON of MediaPipe and OpenPose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from torchreg.errors import FormatError

# MediaPipe's names, of its Python, JavaScript and older interfaces.
_HANDS = ("hand_landmarks", "landmarks", "handLandmarks", "multi_hand_landmarks", "multiHandLandmarks")
_SIDES = ("handedness", "handednesses", "multi_handedness", "multiHandedness")
_LABELS = ("category_name", "categoryName", "label")


@dataclass(frozen=True)
class _Found:
    """A hand in a picture."""

    points: list[list[Any]]  # 21 of [column, row] in pixels, or [None, None] where a keypoint was not seen
    side: str | None  # "left" or "right"; None where the detector did not say
    score: float  # how sure of it the detector is
    count: ClassVar[int] = 21  # of keypoints: the wrist, and four of each finger


def is_detection(frame: Any) -> bool:
    """Return whether a frame of a JSON file is what a detector writes, not a list of keypoints."""
    return isinstance(frame, Mapping)


def detected_keypoints(
    frame: Mapping[str, Any], file: object, side: str | None, picture: tuple[int, int] | None
) -> list[list[Any]] | None:
    """Return the 21 keypoints of a frame in pixels, each [column, row], or of Nones; None if no such hand was found.

    The surest of several hands of a side counts; a single hand of MediaPipe is taken whatever its side, which a
    mirrored picture swaps. MediaPipe's keypoints are shares of the picture (width, height), pixels.
    """
    if isinstance(frame.get("people"), list):
        hands = _of_openpose(frame["people"], file)
    elif "landmark" in frame or any(name in frame for name in _HANDS):
        hands = _of_mediapipe(frame, file, picture)
        side = side if len(hands) > 1 else None
    else:
        raise FormatError(
            f"{file}: must hold a list of keypoints for each frame, or what MediaPipe (hand_landmarks or landmarks) or "
            f"OpenPose (people) writes, got an object with {', '.join(map(str, frame)) or 'nothing'}"
        )
    chosen = [hand for hand in hands if side is None or hand.side in (None, side)]
    return max(chosen, key=lambda hand: hand.score).points if chosen else None


def _of_openpose(people: Sequence[Any], file: object) -> list[_Found]:
    """Return the hands of people, each of 21 times column, row and confidence, which is zero where nothing is."""
    found = []
    for person in people:
        for side in ("left", "right"):
            numbers = person.get(f"hand_{side}_keypoints_2d") if isinstance(person, Mapping) else None
            if not numbers:
                continue
            if not isinstance(numbers, list) or len(numbers) != 3 * _Found.count:
                raise FormatError(f"{file}: hand_{side}_keypoints_2d must hold 63 numbers, 21 times x, y, confidence")
            rows = [numbers[k : k + 3] for k in range(0, len(numbers), 3)]
            sureness = [_plain(row[2], file) for row in rows]
            points = [row[:2] if sure > 0 else [None, None] for row, sure in zip(rows, sureness, strict=True)]
            if any(sure > 0 for sure in sureness):
                found.append(_Found(points, side, sum(sureness)))
    return found


def _of_mediapipe(frame: Mapping[str, Any], file: object, picture: tuple[int, int] | None) -> list[_Found]:
    """Return the hands of a result, whose keypoints are shares of the picture's width and height."""
    if picture is None:
        raise FormatError(
            f"{file}: holds MediaPipe's keypoints, shares of a picture whose size is not known; give --depth pictures, "
            "or keypoints in pixels"
        )
    hands = [frame] if "landmark" in frame else next((frame[name] for name in _HANDS if name in frame), None)
    sides = next((frame[name] for name in _SIDES if name in frame), None) or []
    found = []
    for number, hand in enumerate(hands or []):
        landmarks = hand.get("landmark") if isinstance(hand, Mapping) else hand
        if not isinstance(landmarks, list) or len(landmarks) != _Found.count:
            raise FormatError(f"{file}: a hand of MediaPipe must have 21 landmarks")
        side, score = _side(sides[number] if number < len(sides) else None)
        found.append(_Found([_in_picture(mark, file, picture) for mark in landmarks], side, score))
    return found


def _in_picture(mark: Any, file: object, picture: tuple[int, int]) -> list[Any]:
    """Return [column, row] of a landmark, a whole number in the middle of a pixel."""
    if not isinstance(mark, Mapping) or "x" not in mark or "y" not in mark:
        raise FormatError(f"{file}: a landmark of MediaPipe must have x and y")
    return [_plain(mark[axis], file) * size - 0.5 for axis, size in zip("xy", picture, strict=True)]


def _side(category: Any) -> tuple[str | None, float]:
    """Return the side that a category, or the first of several, names, and its score."""
    if isinstance(category, Mapping) and "classification" in category:
        category = category["classification"]
    if isinstance(category, list):
        category = category[0] if category else None
    if not isinstance(category, Mapping):
        return None, 0.0
    label = next((str(category[name]).lower() for name in _LABELS if name in category), None)
    score = category.get("score", 0.0)
    return label if label in ("left", "right") else None, score if isinstance(score, int | float) else 0.0


def _plain(value: Any, file: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FormatError(f"{file}: must hold numbers, got {value!r}")
    return float(value)
