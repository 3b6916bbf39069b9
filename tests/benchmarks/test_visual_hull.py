def test_smoke_prints_every_figure(loaded_benchmark, capsys):
    with loaded_benchmark("visual_hull") as bench:
        figures = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in figures)
    assert 0.93 < figures["volume over exact hull"] < 1.07
    assert figures["exact hull over body"] > 1
    assert (figures["tips (5)"], figures["limbs (5)"], figures["junctions (1)"]) == (5, 5, 1)
    assert figures["tips off, mean share of an arm"] < 0.15
