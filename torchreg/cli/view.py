"""``torchreg view``: results of all systems, shapes and scans in the browser, or as one HTML file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchreg.cli.align_options import Scale, cloud_files
from torchreg.cli.outputs import Force, Quiet, check_outputs, result_file, with_ending
from torchreg.cli.reporting import reporting
from torchreg.cli.shape_argument import HANDS, PEOPLE, ShapeOptions, near_shape
from torchreg.cli.upright import Up, known_up, remembering
from torchreg.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchreg.geometry.mesh import TriangleMesh
    from torchreg.viz.scene import Scene

Port = Annotated[int, typer.Option(min=0, max=65535, help="Where to listen on 127.0.0.1; if taken, a later one.")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Whether to open a window of the browser.")]


@reporting
def view(
    result: Annotated[
        Path,
        typer.Argument(
            metavar="WHAT",
            help="A result (.safetensors); or hand, hand-left, anny-body, a robot (.urdf), a rig or mesh (.glb, "
            ".gltf), a scan or cloud of any format that `torchreg formats` shows, or a folder of them.",
        ),
    ],
    *,
    shape: Annotated[
        str | None,
        typer.Option(
            help="What was aligned or tracked: hand, hand-left, a robot (.urdf) or a rig (.glb, .gltf); by default the "
            "one that the result keeps."
        ),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="What was measured, once per frame, or a folder: clouds, the target scan, the meshes."),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html",
            "--output",
            "-o",
            metavar="OUT.html",
            help="Write one file that needs no network, instead of serving.",
        ),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(metavar="OUT.rrd", help="Write a recording for the viewer rerun instead (extra rerun)."),
    ] = None,
    port: Port = 8080,
    browser: Browser = True,
    up: Up = None,
    scale: Scale = 1.0,
    options: ShapeOptions,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Show a result, a shape or a scan in the browser: with layers to switch, and a timeline where something moves.

    The page is served to this machine alone, until Ctrl-C. Needs the extra: pip install 'torchreg-articulated[viewer]'.

    Exit codes: 0, also after Ctrl-C; 2 for an error.
    """
    if result.suffix:
        result.stat()  # a missing file is reported before all else
    html, rerun = with_ending(html, (".html",)), with_ending(rerun, (".rrd",))
    check_outputs([html, rerun], force)
    up_direction = known_up(up, [] if is_result(result) else [result, *(data or [])])
    if shape is None and is_result(result) and options.given():
        raise InputError("--parents, --package-dir, --skin and --free-base are about a --shape, which was not given")
    from torchreg.storage import load
    from torchreg.viz.rerun_log import import_rerun, scene_rrd
    from torchreg.viz.result_scenes import result_scene
    from torchreg.viz.viewer import scene_html
    from torchreg.viz.viser_server import import_viser

    if rerun is not None:
        import_rerun()
    if rerun is None or html is not None:
        import_viser()
    found = load(result_file(result)) if is_result(result) else _shown(result, scale, options)
    model = None if shape is None else options.load(shape)
    scene = remembering(result_scene(found, shape=model, data=read_frames(data or [], scale)), up_direction)
    if rerun is not None:
        scene_rrd(rerun, scene)
    if html is not None:
        scene_html(html, scene)
    written = [str(path) for path in (html, rerun) if path is not None]
    if not written:
        _serve(scene, port, browser, quiet)
    elif not quiet:
        typer.echo(f"{scene.title} -> {', '.join(written)}")


def is_result(name: Path) -> bool:
    """Return whether a name is that of a result, with or without its ending."""
    if name.suffix.lower() in (".safetensors", ".json"):
        return True
    return not name.exists() and name.with_suffix(".safetensors").exists()


def _shown(name: Path, scale: float, options: ShapeOptions) -> Any:
    """Return a shape, mesh or cloud by name or file, or the meshes or clouds of a folder."""
    from torchreg.errors import FormatError, ModelError
    from torchreg.io.points import load_points

    ending = name.suffix.lower()
    if name.is_dir() or ending == ".npz":
        return read_frames([name], scale)
    if str(name) in HANDS or str(name) in PEOPLE or ending == ".urdf":
        return options.load(str(name))
    if ending in (".glb", ".gltf"):
        try:
            return options.load(str(name))
        except (FormatError, ModelError):  # no rig, but maybe a mesh
            if options.parents is not None or options.skin is not None:
                raise
    if not name.exists() and not ending:
        raise InputError(f"there is no result {name}.safetensors, and no file {name}; {near_shape(str(name))}")
    return load_points(name, scale=scale)


def tell_url(url: str, browser: bool, quiet: bool) -> None:
    """Print the address of a page, and open it if ``browser``."""
    if not quiet:
        typer.echo(f"{url} (Ctrl-C ends)")
    if browser:
        import webbrowser

        webbrowser.open(url)


def wait_for_interrupt(url: str, browser: bool, quiet: bool) -> None:
    """Print the address of a page, open it if ``browser``, and wait until Ctrl-C."""
    tell_url(url, browser, quiet)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return


def _serve(scene: Scene, port: int, browser: bool, quiet: bool) -> None:
    from torchreg.viz.viewer import SceneViewer

    with SceneViewer(scene, port=port) as viewer:
        wait_for_interrupt(viewer.url, browser, quiet)


def read_frames(paths: list[Path], scale: float = 1.0) -> list[Tensor | TriangleMesh]:
    """Return the meshes or clouds of files, or the frames of a folder or one .npz, in their order."""
    from torchreg.io.frames import load_frames

    if not paths:
        return []
    return [
        cloud.points if cloud.faces is None or not len(cloud.faces) else cloud.to_mesh()
        for cloud in load_frames(cloud_files(paths), scale=scale).clouds()
    ]
