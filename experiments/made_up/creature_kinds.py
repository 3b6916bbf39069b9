"""Kinds of made-up creatures and machines, each different at every draw: what a matcher of scans is trained on.

A kind draws the parts of one creature from a generator; a further kind is one function and one row of a table.
`TRAINING_KINDS` are for training; `HELD_OUT_KINDS` for telling how well training carries over to kinds never seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchreg.datasets.solids import RoundBox, RoundCone

from ..made_up.creature_parts import LEFT_RIGHT, Builder, Creature, Draw, as_tuple, at, cone_of, towards

X, Y, Z = torch.eye(3, dtype=torch.float64)


def draw_quadruped(draw: Draw) -> Creature:
    """Draw a four-legged animal: anything between a mouse, a giraffe and an elephant."""
    u, body = draw.uniform, Builder(draw)
    length, girth, fat = u(0.6, 1.2), u(0.1, 0.25), u(0.8, 1.3)
    rump, middle = body.add(-1, at(0, 0, -length / 2), Z, length / 2, (girth, girth * fat), limit=20)
    chest, front = body.add(rump, middle, towards(u(-12, 17)), length / 2, (girth * fat, girth * u(0.8, 1.2)), limit=30)
    if draw.chance(0.25):  # a hump or a loose belly
        body.blob(rump, middle + at(0, draw.uniform(-0.8, 0.8) * girth, 0), girth * u(0.7, 1.1))
    _neck_and_head(draw, body, chest, front, girth)
    _tail(draw, body, rump, at(0, 0.5 * girth, -length / 2))
    height, thick, foot = u(0.3, 1.0), u(0.04, 0.13), u(0.05, 0.18)
    for part, z in ((rump, -length / 2 * u(0.7, 1.0)), (chest, length / 2 * u(0.7, 1.0))):
        bend, split, width = u(-25, 25), u(0.4, 0.6), thick * u(0.8, 1.3)
        hoof = draw.chance(0.4)
        for side in LEFT_RIGHT:
            hip = at(side * 0.75 * girth, -0.3 * girth, z)
            steps = [towards(-90 + bend, side * 5), towards(-90 - bend), towards(-60 if hoof else -9)]
            body.chain(part, hip, steps, [height * split, height * (1 - split), foot],
                       [1.4 * width, 0.8 * width, 0.6 * width, 0.6 * width])  # fmt: skip
    return body.finish()


def _neck_and_head(draw: Draw, body: Builder, chest: int, front: Tensor, girth: float) -> None:
    u = draw.uniform
    rise, thick = u(0, 80), girth * u(0.4, 0.8)
    count, span = draw.count(1, 3), u(0.1, 0.6)
    steps = [towards(rise - index * u(0, 15)) for index in range(count)]
    neck, nape = body.chain(chest, front, steps, [span / count] * count,
                            torch.linspace(1.3 * thick, thick, count + 1).tolist(), limit=40)  # fmt: skip
    size, tilt = thick * u(0.8, 1.6), u(-60, 20)
    head, nose = body.add(neck[-1], nape, towards(tilt), u(0.12, 0.35), (size, size * u(0.35, 0.9)), limit=45)
    if draw.chance(0.3):  # a jaw that opens
        body.add(head, nape + 0.3 * (nose - nape), towards(tilt - 25), 0.6 * float((nose - nape).norm()),
                 (0.5 * size, 0.3 * size), flat=0.5, normal=Y, limit=35)  # fmt: skip
    if draw.chance(0.15):  # a trunk
        body.chain(head, nose, [towards(-40), towards(-70), towards(-85)], [u(0.1, 0.2)] * 3,
                   [0.5 * size, 0.4 * size, 0.3 * size, 0.25 * size], limit=50)  # fmt: skip
    if draw.chance(0.8):
        _pairs_on_head(draw, body, head, nape, size)


def _pairs_on_head(draw: Draw, body: Builder, head: int, nape: Tensor, size: float) -> None:
    """Draw ears, and horns or antlers."""
    u = draw.uniform
    rise, out, length, width, flat = u(10, 100), u(30, 90), u(0.05, 0.3), u(0.025, 0.09), u(0.25, 1)
    for side in LEFT_RIGHT:
        base = nape + at(side * 0.6 * size, 0.5 * size, 0)
        body.add(
            head, base, towards(rise, side * out), length, (width, width * u(0.3, 1)), flat=flat, normal=Z, limit=40
        )
    if draw.chance(0.3):
        rise, length, width, bend = u(40, 90), u(0.08, 0.3), u(0.02, 0.045), u(-60, 60)
        for side in LEFT_RIGHT:
            base = nape + at(side * 0.35 * size, 0.8 * size, 0.3 * size)
            tip = base + length * towards(rise, side * 40)
            body.attach(head, RoundCone(as_tuple(base), as_tuple(tip), width, 0.8 * width))
            end = tip + length * towards(rise + bend, side * 90)
            body.attach(head, RoundCone(as_tuple(tip), as_tuple(end), 0.8 * width, 0.4 * width))


def _tail(draw: Draw, body: Builder, rump: int, start: Tensor) -> None:
    count = draw.count(0, 5)
    if count == 0:
        return
    u = draw.uniform
    sink, thick, length = u(-80, 50), u(0.02, 0.09), u(0.06, 0.25)
    radii = torch.linspace(thick, thick * u(0.3, 1.3), count + 1).tolist()
    body.chain(rump, start, [towards(sink + 12 * index, 180) for index in range(count)], [length] * count, radii,
               limit=45)  # fmt: skip


def draw_person(draw: Draw) -> Creature:
    """Draw somebody who stands on two legs: a person, a child, a bear or a doll, with clothes, hair and bags."""
    u, body = draw.uniform, Builder(draw)
    width, height, girth, flat = u(0.1, 0.22), u(0.35, 0.7), u(0.1, 0.22), u(0.5, 1.0)
    hips, waist = body.add(-1, at(0, 0, 0), at(0, 1, u(-0.1, 0.1)), height / 2, (girth, girth * u(0.75, 1.15)),
                           flat=flat, normal=Z, limit=25)  # fmt: skip
    chest, top = body.add(hips, waist, at(0, 1, u(-0.15, 0.15)), height / 2, (girth, girth * u(0.9, 1.35)),
                          flat=flat, normal=Z, limit=35)  # fmt: skip
    _persons_head(draw, body, chest, top)
    _arms(draw, body, chest, top, width, girth)
    leg = _legs(draw, body, hips, width)
    _clothes(draw, body, (hips, chest), (waist, top), girth, leg)
    if draw.chance(0.1):
        _tail(draw, body, hips, at(0, 0, -girth))
    return body.finish()


def draw_mannequin(draw: Draw) -> Creature:
    """Draw a bare doll of few, round parts, of which nothing but their places tells left from right."""
    u, body = draw.uniform, Builder(draw)
    girth, height, limb = u(0.08, 0.16), u(0.3, 0.6), u(0.035, 0.08)
    hips, waist = body.add(-1, at(0, 0, 0), Y, height / 2, (girth, girth), limit=20)
    chest, top = body.add(hips, waist, Y, height / 2, (girth, girth * u(0.9, 1.2)), limit=25)
    size = u(0.07, 0.13)
    body.add(chest, top + at(0, 0.05, 0), Y, size, (size, size), limit=35)
    arm, leg, foot = u(0.4, 0.8), u(0.5, 1.0), draw.chance(0.6)
    for side in LEFT_RIGHT:
        shoulder = top + at(side * (girth + limb), -limb, 0)
        body.chain(chest, shoulder, [towards(u(-75, -30), side * 90)] * 2, [arm / 2] * 2, [limb] * 3)
        steps, lengths = [at(side * 0.1, -1, 0)] * 2, [leg / 2] * 2
        if foot:
            steps, lengths = [*steps, at(0, -0.2, 1)], [*lengths, u(0.1, 0.2)]
        body.chain(hips, at(side * 0.7 * girth, -0.3 * girth, 0), steps, lengths, [1.1 * limb] * (len(steps) + 1))
    return body.finish()


def _persons_head(draw: Draw, body: Builder, chest: int, top: Tensor) -> None:
    u = draw.uniform
    neck, chin = body.add(chest, top, at(0, 1, 0.1), u(0.06, 0.2), (0.07, 0.06), limit=35)
    size = u(0.08, 0.16)
    head, crown = body.add(neck, chin, at(0, 1, u(0, 0.6)), u(0.06, 0.2), (size, size * u(0.8, 1.1)), limit=40)
    face = chin + at(0, 0.4 * size, 0.9 * size)
    if draw.chance(0.6):  # a nose
        body.attach(
            head,
            RoundCone(as_tuple(face), as_tuple(face + at(0, -0.2 * size, u(0.1, 0.8) * size)), 0.2 * size, 0.15 * size),
        )
    if draw.chance(0.5):  # hair, a hat or a hood
        body.blob(head, crown + at(0, u(-0.3, 0.6) * size, -u(0, 0.8) * size), size * u(0.7, 1.3))
    if draw.chance(0.2):  # a ponytail
        body.chain(head, crown + at(0, 0, -size), [towards(-50, 180), towards(-80, 180)], [u(0.1, 0.2)] * 2,
                   [0.05, 0.04, 0.02], limit=50)  # fmt: skip
    if draw.chance(0.3):
        rise, length = u(0, 90), u(0.04, 0.2)
        for side in LEFT_RIGHT:
            body.add(head, chin + at(side * 0.7 * size, size, 0), towards(rise, side * 90), length, (0.035, 0.02),
                     flat=u(0.4, 1), normal=Z, limit=30)  # fmt: skip


def _arms(draw: Draw, body: Builder, chest: int, top: Tensor, width: float, girth: float) -> None:
    u = draw.uniform
    length, thick, rise, forward = u(0.45, 0.95), u(0.03, 0.085), u(-80, 20), u(-30, 40)
    fingers, size = draw.chance(0.4), u(0.06, 0.16)
    for side in LEFT_RIGHT:
        shoulder = top + at(side * (width + 0.4 * girth), -0.03, 0)
        steps = [towards(rise, side * 90), towards(rise, side * (90 - forward)), towards(rise, side * (90 - forward))]
        numbers, end = body.chain(chest, shoulder, steps, [length / 2, length / 2, size],
                                  [1.3 * thick, thick, 0.8 * thick, 0.8 * thick])  # fmt: skip
        if fingers:
            for spread in (-35, -12, 12, 35):
                step = towards(rise + spread, side * (90 - forward))
                body.attach(
                    numbers[-1], RoundCone(as_tuple(end), as_tuple(end + 0.6 * size * step), 0.3 * thick, 0.25 * thick)
                )


def _legs(draw: Draw, body: Builder, hips: int, width: float) -> float:
    """Draw both legs and return their length."""
    u = draw.uniform
    length, thick, foot, spread = u(0.5, 1.1), u(0.045, 0.12), u(0.1, 0.24), u(0, 15)
    for side in LEFT_RIGHT:
        steps = [towards(-88, side * 30) + at(side * math.tan(math.radians(spread)), 0, 0), at(0, -1, -0.05),
                 at(side * 0.15, -0.15, 1)]  # fmt: skip
        body.chain(hips, at(side * 0.8 * width, 0, 0), steps, [length / 2, length / 2, foot],
                   [1.4 * thick, thick, 0.7 * thick, 0.6 * thick])  # fmt: skip
    return length


def _clothes(
    draw: Draw, body: Builder, parts: tuple[int, int], ends: tuple[Tensor, Tensor], girth: float, leg: float
) -> None:
    """Draw a skirt or coat over the legs, a rucksack, a loose jacket."""
    u = draw.uniform
    (hips, chest), (waist, top) = parts, ends
    if draw.chance(0.25):
        hem = at(0, -leg * u(0.25, 0.8), 0)
        body.attach(hips, cone_of(waist - at(0, 0.1, 0), hem, (girth, girth * u(1.2, 2.2)), u(0.6, 1), Z))
    if draw.chance(0.2):
        body.attach(
            chest,
            RoundBox(
                as_tuple((waist + top) / 2 + at(0, 0, -1.3 * girth)), (u(0.08, 0.16), u(0.1, 0.2), u(0.05, 0.1)), 0.03
            ),
        )
    if draw.chance(0.25):
        body.attach(chest, cone_of(top, waist - at(0, 0.15, 0), (girth, girth * u(1.1, 1.5)), u(0.7, 1), Z))


def draw_hand(draw: Draw) -> Creature:
    """Draw a hand of four or five fingers with its forearm."""
    u, body = draw.uniform, Builder(draw)
    width, length, thick = u(0.25, 0.45), u(0.35, 0.55), u(0.07, 0.11)
    wrist, base = body.add(-1, at(0, 0, -u(0.3, 0.8)), Z, 0.5, (1.3 * thick, 1.1 * thick), flat=0.8, normal=Y, limit=40)
    count, wave, total, fan, thin = draw.count(3, 4), u(0, 0.25), u(0.35, 0.7), u(0, 14), u(0.035, 0.06)
    for index in range(count):
        share = index / (count - 1) - 0.5
        palm, tip = body.add(wrist, base + at(0.4 * share * width, 0, 0), at(0.8 * share * width, 0, length), length,
                             (thick, 0.8 * thick), flat=0.7, normal=Y, limit=6)  # fmt: skip
        size = total * (1 - wave * (2 * share - 0.2) ** 2)
        steps = [towards(-u(0, 15) * bone, 2 * share * fan) for bone in range(3)]
        body.chain(palm, tip, steps, [0.45 * size, 0.3 * size, 0.25 * size],
                   torch.linspace(1.2 * thin, 0.8 * thin, 4).tolist(), limit=60)  # fmt: skip
    if draw.chance(0.9):
        side, spread = (1 if draw.chance(0.5) else -1), u(25, 75)
        steps = [
            towards(-u(0, 30), side * spread),
            towards(-5, side * (spread - 15)),
            towards(-5, side * (spread - 30)),
        ]
        body.chain(wrist, base + at(side * 0.35 * width, 0, 0.05), steps, [u(0.15, 0.3), 0.2, 0.15],
                   torch.linspace(1.5 * thin, thin, 4).tolist(), limit=50)  # fmt: skip
    return body.finish()


def draw_plant(draw: Draw) -> Creature:
    """Draw a branching plant with leaves."""
    u, body = draw.uniform, Builder(draw)
    leafy = u(0, 1)

    def grow(parent: int, start: Tensor, direction: Tensor, length: float, thick: float, level: int) -> None:
        for _ in range(draw.count(1, 3) if level == 0 else draw.count(1, 2)):
            direction = direction + 0.2 * draw.normal(3)
            parent, start = body.add(parent, start, direction, length * u(0.7, 1.2), (thick, 0.85 * thick), limit=30)
            thick *= 0.85
            if level < 2 and parent < 24 and draw.chance(0.85):
                aside = torch.nn.functional.normalize(direction, dim=0) * u(0.2, 1) + 0.6 * draw.normal(3)
                grow(parent, start, aside, length * u(0.5, 0.9), thick * u(0.6, 0.9), level + 1)
        if draw.chance(leafy) and parent < 28:
            aside = torch.nn.functional.normalize(direction, dim=0) + 0.4 * draw.normal(3)
            radii, flat = (u(0.05, 0.12), 0.02), u(0.25, 0.5)
            body.add(parent, start, aside, u(0.1, 0.35), radii, flat=flat, normal=draw.normal(3), limit=50)

    grow(-1, at(0, 0, 0), Y, u(0.25, 0.45), u(0.04, 0.1), 0)
    grow(0, at(0, 0.15, 0), at(u(-1, 1), 0.6, u(-1, 1)), u(0.2, 0.4), u(0.04, 0.07), 1)
    return body.finish()


def draw_arm(draw: Draw) -> Creature:
    """Draw a robot arm: links of boxes and cylinders between knobs, with a gripper."""
    u, body = draw.uniform, Builder(draw, rigid=draw.chance(0.5))
    parent, end = body.add(
        -1, at(0, 0, 0), Y, u(0.1, 0.3), (u(0.15, 0.3), u(0.1, 0.2)), flat=u(0.6, 1), normal=X, limit=1
    )
    if draw.chance(0.5):
        body.attach(parent, RoundBox((0, 0, 0), (u(0.15, 0.3), u(0.04, 0.1), u(0.15, 0.3)), 0.02))
    step, thick = Y, u(0.06, 0.12)
    for _ in range(draw.count(3, 6)):
        step = torch.nn.functional.normalize(step + 0.5 * draw.normal(3) + at(0, 0, 0.3), dim=0)
        across = torch.linalg.cross(step, draw.normal(3))
        knob, end = body.add(parent, end, across, thick * u(0.5, 1.5), (thick * u(0.9, 1.3), thick * u(0.9, 1.3)))
        parent, end = body.add(knob, end, step, u(0.2, 0.5), (thick, thick * u(0.6, 1)), flat=u(0.5, 1),
                               normal=draw.normal(3))  # fmt: skip
        if draw.chance(0.4):
            half = (thick * u(0.6, 1.5), thick * u(0.6, 1.5), thick * u(0.6, 1.5))
            body.attach(parent, RoundBox(as_tuple(end - 0.1 * step), half, 0.2 * thick))
        thick *= u(0.75, 1)
    aside = torch.linalg.cross(step, draw.normal(3))
    for side in LEFT_RIGHT:
        body.chain(parent, end, [step + side * u(0.5, 1) * aside, step], [u(0.08, 0.2), u(0.08, 0.2)],
                   [0.6 * thick, 0.5 * thick, 0.4 * thick], limit=40)  # fmt: skip
    return body.finish()


def draw_bug(draw: Draw) -> Creature:
    """Draw an insect, a spider or a crab: segments with pairs of legs."""
    u, body = draw.uniform, Builder(draw)
    parent, end, thick = -1, at(0, 0, -0.5), u(0.1, 0.2)
    segments = []
    for _ in range(draw.count(2, 4)):
        radius, length = thick * u(0.6, 1.3), u(0.15, 0.4)
        start = end
        parent, end = body.add(parent, start, at(0, u(-0.2, 0.2), 1), length, (radius, radius * u(0.6, 1.3)),
                               flat=u(0.6, 1), normal=Y, limit=40)  # fmt: skip
        segments.append((parent, start, radius))
    for _ in range(draw.count(1, 4)):
        part, start, radius = segments[draw.count(0, len(segments) - 1)]
        rise, turn, count, width, length = u(-80, 60), u(30, 150), draw.count(2, 3), u(0.025, 0.07), u(0.15, 0.4)
        for side in LEFT_RIGHT:
            steps = [towards(rise - 35 * bone, side * turn) for bone in range(count)]
            body.chain(part, start + at(side * 0.6 * radius, 0, 0), steps, [length] * count,
                       torch.linspace(1.2 * width, 0.7 * width, count + 1).tolist())  # fmt: skip
    return body.finish()


def draw_snake(draw: Draw) -> Creature:
    """Draw a long body without legs: a snake, a worm or a rope, thick in the middle or not."""
    u, body = draw.uniform, Builder(draw)
    count, thick, length = draw.count(6, 14), u(0.04, 0.12), u(0.12, 0.22)
    radii = [thick * (0.6 + 0.6 * math.sin(math.pi * (index + 0.5) / (count + 1))) for index in range(count + 1)]
    steps = [towards(u(-10, 10), u(-15, 15)) for _ in range(count)]
    numbers, end = body.chain(-1, at(0, 0, 0), steps, [length] * count, radii, limit=35)
    body.add(numbers[-1], end, Z, u(0.08, 0.2), (thick * u(0.7, 1.4), 0.4 * thick), flat=u(0.5, 1), normal=Y, limit=30)
    return body.finish()


def draw_furniture(draw: Draw) -> Creature:
    """Draw a jointed thing of boxes: a lamp, a cupboard, a folding chair."""
    u, body = draw.uniform, Builder(draw, rigid=True)
    parent, end = body.add(-1, at(0, 0, 0), Y, u(0.05, 0.3), (u(0.04, 0.1), u(0.04, 0.1)), limit=1)
    body.attach(parent, RoundBox((0, 0, 0), (u(0.1, 0.4), u(0.02, 0.3), u(0.1, 0.4)), 0.02))
    for _ in range(draw.count(2, 5)):
        step = draw.direction() + 0.6 * Y
        part, tip = body.add(parent, end, step, u(0.15, 0.5), (u(0.02, 0.06), u(0.02, 0.06)), limit=70)
        half = (u(0.02, 0.2), u(0.02, 0.2), u(0.02, 0.2))
        body.attach(part, RoundBox(as_tuple(tip), half, 0.3 * min(half)))
        if draw.chance(0.6):
            parent, end = part, tip
    return body.finish()


def draw_chimera(draw: Draw) -> Creature:
    """Draw something like nothing: a trunk with limbs, fins and knobs anywhere, single, in pairs or around it."""
    u, body = draw.uniform, Builder(draw)
    count, thick, length, rise = draw.count(1, 5), u(0.07, 0.25), u(0.4, 1.2), u(-20, 90)
    start, parent, trunk = at(0, 0, 0), -1, []
    for _ in range(count):
        rise += u(-30, 30)
        radii, begin = (thick * u(0.6, 1.2), thick * u(0.6, 1.2)), start
        parent, start = body.add(parent, begin, towards(rise), length / count, radii, flat=u(0.4, 1),
                                 normal=X if draw.chance(0.5) else Y, limit=30)  # fmt: skip
        trunk.append((parent, begin, start, min(radii)))
    for _ in range(draw.count(2, 6)):
        _limbs_of_chimera(draw, body, trunk[draw.count(0, count - 1)])
    return body.finish()


def _limbs_of_chimera(draw: Draw, body: Builder, segment: tuple[int, Tensor, Tensor, float]) -> None:
    """Draw one limb in the middle plane, a pair of them, or several around a segment of the trunk."""
    u = draw.uniform
    part, start, end, thick = segment
    base = start + u(0, 1) * (end - start)
    bones, length, width = draw.count(1, 4), u(0.1, 0.9), u(0.02, 0.6 * thick + 0.03)
    elevation, bend, flat, normal = u(-90, 90), u(-50, 50), u(0.25, 1), draw.normal(3)
    radii = [width * u(0.5, 1.4) for _ in range(bones + 1)]
    azimuths = {0: [u(0, 1) // 0.5 * 180.0], 1: [u(10, 170)] * 2, 2: [u(20, 160)] * 2}[draw.count(0, 2)]
    if draw.chance(0.1):  # like a star
        around = draw.count(3, 6)
        azimuths = [360.0 * index / around for index in range(around)]
    knob = width * u(1.2, 2.5) if draw.chance(0.25) else 0.0
    for number, azimuth in enumerate(azimuths):
        mirrored = len(azimuths) == 2 and number == 1
        turn, facing = (-azimuth, normal * at(-1, 1, 1)) if mirrored else (azimuth, normal)
        steps = [towards(elevation + bone * bend, turn) for bone in range(bones)]
        numbers, tip = body.chain(part, base + 0.8 * thick * steps[0], steps, [length / bones] * bones, radii,
                                  flat=flat, normal=facing, limit=60)  # fmt: skip
        if knob:
            body.blob(numbers[-1], tip, knob)


def draw_bird(draw: Draw) -> Creature:
    """Draw a bird: a body, two wings of two parts, a tail fan, two thin legs, a beak."""
    u, body = draw.uniform, Builder(draw)
    girth, length = u(0.1, 0.18), u(0.3, 0.5)
    trunk, front = body.add(-1, at(0, 0, -length / 2), towards(u(0, 40)), length, (girth, girth * u(0.7, 1)), limit=10)
    neck, nape = body.add(trunk, front, towards(u(20, 80)), u(0.08, 0.4), (0.06, 0.045), limit=50)
    head, face = body.add(neck, nape, towards(u(-20, 30)), u(0.06, 0.1), (0.07, 0.05), limit=45)
    body.attach(head, RoundCone(as_tuple(face), as_tuple(face + u(0.06, 0.2) * towards(-10)), 0.03, 0.01))
    span, chord, flat = u(0.3, 0.7), u(0.1, 0.2), u(0.12, 0.3)
    for side in LEFT_RIGHT:
        shoulder = at(side * 0.7 * girth, 0.4 * girth, 0.1 * length)
        body.chain(trunk, shoulder, [towards(5, side * 90), towards(5, side * 120)], [span / 2, span / 2],
                   [chord, chord, 0.4 * chord], flat=flat, normal=Y, limit=60)  # fmt: skip
        body.chain(trunk, at(side * 0.4 * girth, -0.7 * girth, 0), [towards(-80), towards(-100), towards(0)],
                   [u(0.1, 0.3), u(0.1, 0.3), 0.1], [0.045, 0.025, 0.02, 0.02], limit=50)  # fmt: skip
    body.add(trunk, at(0, 0, -length / 2), towards(u(-20, 20), 180), u(0.15, 0.4), (0.06, u(0.08, 0.16)), flat=0.25,
             normal=Y, limit=35)  # fmt: skip
    return body.finish()


def draw_fish(draw: Draw) -> Creature:
    """Draw a fish: a body that bends sideways, a tail fin, fins on the back and in pairs."""
    u, body = draw.uniform, Builder(draw)
    count, girth, flat = draw.count(3, 5), u(0.12, 0.28), u(0.4, 0.8)
    radii = [girth * math.sin(math.pi * (0.2 + 0.7 * index / count)) + 0.03 for index in range(count + 1)]
    numbers, tail = body.chain(-1, at(0, 0, 0.5), [towards(0, 180)] * count, [1 / count] * count, radii, flat=flat,
                               normal=X, limit=30)  # fmt: skip
    for rise in (u(20, 60), -u(20, 60)):
        body.add(numbers[-1], tail, towards(rise, 180), u(0.15, 0.35), (0.06, 0.03), flat=0.25, normal=X, limit=35)
    body.add(
        numbers[1], at(0, 0.7 * girth, 0.1), towards(u(40, 90), 180), u(0.1, 0.25), (0.1, 0.04), flat=0.25, normal=X
    )
    rise = u(-70, 0)
    for side in LEFT_RIGHT:
        body.add(numbers[0], at(side * 0.5 * flat * girth, -0.2 * girth, 0.3), towards(rise, side * 110), u(0.12, 0.3),
                 (0.06, 0.03), flat=0.3, normal=Y, limit=60)  # fmt: skip
    return body.finish()


def draw_squid(draw: Draw) -> Creature:
    """Draw an octopus, a starfish or a squid: arms around a middle."""
    u, body = draw.uniform, Builder(draw)
    size, count = u(0.12, 0.25), draw.count(4, 8)
    core, _ = body.add(-1, at(0, 0, 0), Y, u(0.02, 0.35), (size, size * u(0.6, 1.2)), limit=10)
    bones, length, thick, sink = draw.count(3, 4), u(0.5, 0.9), u(0.05, 0.09), u(-50, 10)
    for index in range(count):
        turn = 360 * index / count
        steps = [towards(sink + 10 * bone, turn) for bone in range(bones)]
        body.chain(core, 0.7 * size * towards(0, turn), steps, [length / bones] * bones,
                   torch.linspace(thick, 0.4 * thick, bones + 1).tolist(), limit=45)  # fmt: skip
    return body.finish()


def draw_dinosaur(draw: Draw) -> Creature:
    """Draw a heavy animal on two legs with a long tail, small arms and a large head, or a kangaroo."""
    u, body = draw.uniform, Builder(draw)
    girth, length, lean = u(0.14, 0.24), u(0.5, 0.8), u(5, 70)
    hips, middle = body.add(-1, at(0, 0, 0), towards(lean), length / 2, (girth, girth), limit=15)
    chest, front = body.add(hips, middle, towards(lean + u(-10, 20)), length / 2, (girth, 0.6 * girth), limit=30)
    _tail_of_dinosaur(draw, body, hips, girth)
    neck, nape = body.add(chest, front, towards(u(20, 80)), u(0.1, 0.3), (0.5 * girth, 0.4 * girth), limit=40)
    head, _ = body.add(neck, nape, towards(u(-20, 10)), u(0.2, 0.35), (0.6 * girth, 0.35 * girth), limit=45)
    if draw.chance(0.5):
        for side in LEFT_RIGHT:
            body.add(
                head, nape + at(side * 0.3 * girth, 0.4 * girth, 0), towards(80, side * 40), u(0.08, 0.2), (0.03, 0.02)
            )
    leg, thick = u(0.5, 0.8), u(0.07, 0.12)
    for side in LEFT_RIGHT:
        body.chain(hips, at(side * 0.8 * girth, 0, 0), [towards(-60), towards(-110), towards(-20)],
                   [leg / 2, leg / 2, u(0.12, 0.3)], [1.5 * thick, 0.8 * thick, 0.6 * thick, 0.5 * thick])  # fmt: skip
        body.chain(chest, front + at(side * 0.6 * girth, -0.3 * girth, 0), [towards(-60, side * 20), towards(-10)],
                   [u(0.1, 0.2), u(0.1, 0.2)], [0.05, 0.04, 0.03])  # fmt: skip
    return body.finish()


def _tail_of_dinosaur(draw: Draw, body: Builder, hips: int, girth: float) -> None:
    count = draw.count(3, 5)
    radii = torch.linspace(0.9 * girth, 0.15 * girth, count + 1).tolist()
    steps = [towards(-30 + 8 * index, 180) for index in range(count)]
    body.chain(hips, at(0, 0, -0.5 * girth), steps, [draw.uniform(0.15, 0.28)] * count, radii, limit=35)


def draw_crane(draw: Draw) -> Creature:
    """Draw a vehicle with a boom: rigid boxes, wheels or tracks, an arm of two or three links."""
    u, body = draw.uniform, Builder(draw, rigid=True)
    base, top = body.add(-1, at(0, 0, 0), Y, 0.1, (0.08, 0.08), limit=1)
    for side in LEFT_RIGHT:
        body.attach(base, RoundBox((side * u(0.12, 0.2), -0.02, 0), (0.05, 0.07, u(0.2, 0.35)), 0.04))
    cab, _ = body.add(base, top, Y, 0.08, (0.1, 0.1), limit=120)
    body.attach(cab, RoundBox(as_tuple(top + at(0, 0.12, -0.05)), (u(0.1, 0.18), u(0.08, 0.15), u(0.12, 0.25)), 0.03))
    body.attach(cab, RoundBox(as_tuple(top + at(-0.08, 0.3, 0.05)), (0.06, 0.08, 0.07), 0.02))
    rise, thick = u(30, 70), u(0.035, 0.06)
    steps = [towards(rise), towards(rise - 50), towards(rise - 120)]
    numbers, end = body.chain(cab, top + at(0.06, 0.12, 0.15), steps, [u(0.3, 0.5), u(0.25, 0.4), u(0.08, 0.15)],
                              [thick, thick, 0.8 * thick, 0.8 * thick], limit=50)  # fmt: skip
    body.attach(numbers[-1], RoundBox(as_tuple(end), (u(0.06, 0.12), u(0.04, 0.08), u(0.04, 0.08)), 0.015))
    return body.finish()


Kind = Callable[[Draw], Creature]
# With the share of each in what is drawn: most of what is scanned are people and animals.
TRAINING_KINDS: dict[str, tuple[Kind, float]] = {
    "quadruped": (draw_quadruped, 0.24),
    "person": (draw_person, 0.2),
    "mannequin": (draw_mannequin, 0.06),
    "hand": (draw_hand, 0.06),
    "plant": (draw_plant, 0.04),
    "arm": (draw_arm, 0.05),
    "bug": (draw_bug, 0.07),
    "snake": (draw_snake, 0.03),
    "furniture": (draw_furniture, 0.05),
    "chimera": (draw_chimera, 0.2),
}
HELD_OUT_KINDS: dict[str, tuple[Kind, float]] = {
    "bird": (draw_bird, 0.2),
    "fish": (draw_fish, 0.2),
    "squid": (draw_squid, 0.2),
    "dinosaur": (draw_dinosaur, 0.2),
    "crane": (draw_crane, 0.2),
}
