"""Writes the page of file formats from the table of readers: `python docs/formats.py`."""

from pathlib import Path

from torchreg.io.formats import KINDS, table_rows

PAGE = Path(__file__).with_name("formats.md")
HEAD = """# File formats

`torchreg formats` prints this table, which is made from the readers themselves (`python docs/formats.py`).

The content of a file decides its format, and the ending only if the content is ambiguous. So a PLY file with the name
`scan.obj` is read as PLY. Clouds, meshes and tables may be compressed by gzip (`scan.ply.gz`). Byte order marks and
UTF-16 text from Windows are accepted.

"""
TAIL = """
## Tables

The first line of a table of points may name its columns (`X,Y,Z,R,G,B`, `x [m];y [m];z [m]`, `Points:0,...`, also
after `//` or `#`), or hold only the number of points. Without names x, y, z come first, and their values identify the
other columns: unit vectors are normals; integers up to 255 or 65535, or numbers from 0 to 1, are colors; others, such
as intensity and time, are ignored. Decimal commas are accepted if semicolons, tabs or blanks separate the columns.
The same holds for tables of poses.

## Corrections and warnings

* Coordinates far from the origin, as in maps, are read in double precision. Every system computes relative to an
  origin near them (`origin` of the result) and returns the coordinates of the file.
* `scale=0.001` (`--scale 0.001`) converts millimeters to metres. A warning names the factor if the sizes of data and
  shape differ by more than thirtyfold, those of two scans by more than sevenfold, or if links, joints or slides of a
  robot have another unit than the rest.
* A skinned glTF mesh is posed as viewers show it: by its nodes, or at `time=` or `frame=` of its animation.
* Files are sorted by the numbers in their names: `0.5, 1.25, 1.5, 10`, and `5e-05` before `0.0001`.
* Depth cameras, scanners and padded stacks write rows `0 0 0` where nothing was measured. Such rows of clouds are
  removed, with one warning that counts them. A single such row stays, because a point may be the origin, and so do
  corners of faces.
* In a mask of two values the brighter one is set. Varying transparency is the mask. In a picture of labels everything
  but zero is set. Soft edges are cut at half of the white; so are halos of one value around it, with a warning.
* Integers in depth images are millimeters, floating-point numbers metres, unless the file of the camera has a unit:
  `depth_scale`, `depth_units` (metres per unit), `depth_factor`, `png_depth_scale`, `DepthMapFactor` (units per
  metre). 65535 is no depth.
* Lenses other than a pinhole camera's (fisheye, equidistant, Kannala-Brandt, omnidirectional) are refused under every
  name that programs use for them. So are four numbers without a model that are implausible as k1 k2 p1 p2.
* In ROS's camera_info, K and D belong to the raw picture; if D is zero, P is used. P holds the position of the right
  camera of a pair: a folder with `left.yaml` and `right.yaml` is a pair.
* Unusable parts of a file are left out, with a warning that counts them: faces with two corners, normals that are not
  finite or of length zero, vertices without skin weights, links with a missing mesh.
* Files of scanners, recordings and CAD programs that torchreg does not read (E57, LAS, ROS bags, FBX, STEP and
  others) are refused, and the error names a way to convert them.
"""


def page() -> str:
    """Return the text of the page."""
    parts = []
    for kind in KINDS:
        rows = [
            f"| {name} | {' '.join(f'`{ending}`' for ending in endings.split())} | {holds} | `{loader}` |"
            for row_kind, name, endings, holds, loader in table_rows()
            if row_kind == kind
        ]
        parts.append(
            f"## {kind.capitalize()}\n\n| format | endings | what is read | by |\n|---|---|---|---|\n" + "\n".join(rows)
        )
    return HEAD + "\n\n".join(parts) + "\n" + TAIL


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
