def test_smoke_prints_every_figure(loaded_benchmark, capsys):
    with loaded_benchmark("depth_pictures") as bench:
        results = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert list(results) == ["reprojection", "normals"]
    assert all(name in printed for figures in results.values() for name in figures)
    assert results["reprojection"]["farthest from its pixel, px (<= 0.5)"] < 0.5
    assert all(degrees < 5 for degrees in results["normals"].values())
