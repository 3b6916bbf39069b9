"""Sizes of files of robots are printed."""

import pytest

ARM = """<robot name='arm'><link name='base'><visual><geometry><box size='1 1 1'/></geometry></visual></link></robot>"""


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("gltf_sizes") as module:
        yield module


def test_a_robot_has_a_size(bench, tmp_path, monkeypatch, capsys):
    (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["gltf_sizes.py", str(tmp_path / "arm.urdf")])
    bench.main()
    assert capsys.readouterr().out.split() == ["arm", "12", "triangles", "0.00", "MB"]
    monkeypatch.setattr(bench, "robots_folder", lambda: None)
    monkeypatch.setattr("sys.argv", ["gltf_sizes.py"])
    bench.main()
    assert "no robots" in capsys.readouterr().out
