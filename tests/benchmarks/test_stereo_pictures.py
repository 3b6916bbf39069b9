def test_smoke_prints_every_figure(loaded_benchmark, capsys):
    with loaded_benchmark("stereo_pictures") as bench:
        results = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert list(results) == ["rotation, points by semi-global", "rotation, disparity, semi-global"]
    assert all(name in printed for figures in results.values() for name in figures)
    points = results["rotation, points by semi-global"]
    assert points["of them on the hand, mean"] > 0
    assert points["median 3-D error, mm (<= 3)"] < 5
