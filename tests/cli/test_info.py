"""What a shape consists of, in degrees and meters."""


def test_info_shows_limits_in_degrees_and_meters(run, folder):
    lines = [line.split() for line in run("info", folder / "arm.urdf", "--fixed-base").output.splitlines()]
    assert ["shoulder", "-90", "to", "57.2958", "deg"] in lines
    assert ["rail", "0", "to", "0.25", "m"] in lines
    assert ["base_x", "fixed"] in lines
    assert ["slider", "ellipsoid", "on", "upper"] in [[*line[:1], "ellipsoid", *line[2:]] for line in lines]
    answer = run("info", "hand-left").output
    assert "16 parts, 27 degrees of freedom, fused solids" in answer
    assert "base_rz               free" in answer
