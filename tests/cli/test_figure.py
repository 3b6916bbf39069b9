"""Pictures from the command line."""


def test_figures_are_drawn(run, error_of, tmp_path, monkeypatch):
    answer = run("figure", "bending", "-o", tmp_path / "fig2.png")
    assert answer.exit_code == 0, answer.output
    assert (tmp_path / "fig2.png").read_bytes().startswith(b"\x89PNG")
    assert "NAME must be one of bending, readme; got 'spine'" in error_of("figure", "spine")
    assert "fig2.png exists" in error_of("figure", "bending", "-o", tmp_path / "fig2.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torchreg.viz.figures.readme_picture", lambda path: path)
    assert run("figure", "readme").output == "wrote readme.png\n"
