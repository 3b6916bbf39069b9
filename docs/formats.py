"""Writes the page of file formats from the table of readers: `python docs/formats.py`."""

from pathlib import Path

from torchreg.io.formats import KINDS, table_rows

PAGE = Path(__file__).with_name("formats.md")
HEAD = """# File formats

`torchreg formats` prints this table, which is made from the readers themselves (`python docs/formats.py`).

A format is told by what a file holds; where that does not tell, by its ending. So a PLY file that is called
`scan.obj` is read as what it is. Clouds, meshes and tables may be packed by gzip (`scan.ply.gz`). Byte order marks
do no harm, nor does text that Windows wrote in UTF-16.

"""
TAIL = """
## What is read out of tables

The first line of a table of points may name its columns (`X,Y,Z,R,G,B`, `x [m];y [m];z [m]`, `Points:0,...`, also
behind `//` or `#`), or hold the number of points alone. Without names x, y, z come first, and what follows is told
by its numbers: unit vectors are normals; whole numbers up to 255 or 65535, or numbers from 0 to 1, are colors; the
rest is passed over, as intensity and time are. Numbers may have decimal commas where semicolons, tabs or blanks
stand between the columns, in tables of poses too.

## What is put right, and what is told

* Coordinates far from the origin, as in maps, are read in double precision, and every system computes about an
  origin near them, which results tell as `origin`. What they return is in the coordinates of the file.
* `scale=0.001` (`--scale 0.001`) reads millimeters as metres. Data and shape whose sizes differ by more than
  thirtyfold, two scans by more than sevenfold, and links, joints or slides of a robot that are in another unit than
  the rest give a warning that names the factor.
* A skinned glTF mesh stands as viewers show it: in the pose of its nodes, or at `time=` or `frame=` of its
  animation.
* Files sort by the numbers in their names: `0.5, 1.25, 1.5, 10`, and `5e-05` before `0.0001`.
* Rows `0 0 0` of clouds, as depth cameras, scanners and padded stacks leave where nothing was measured, are left out
  with a warning that counts them, once for a sequence. A single one stays, as a point may be the origin, and so do
  corners of faces.
* In a mask the brighter of two values is set, whatever they are; transparency that varies is the mask; in a picture
  of labels all but zero is set; soft edges are cut at half of the white, and so are halos of one value around it,
  with a warning.
* Whole numbers in depth images are millimeters, floating-point ones metres, unless the camera's file says otherwise:
  `depth_scale`, `depth_units` (metres per unit), `depth_factor`, `png_depth_scale`, `DepthMapFactor` (units per
  metre); 65535 is no depth.
* Lenses of other kinds than a pinhole camera's (fisheye, equidistant, Kannala-Brandt, omnidirectional) are refused
  under every name that programs have for them; so are four numbers without a model that are hardly k1 k2 p1 p2.
* Of ROS's camera_info K and D are those of the raw picture; where D is zero P holds. P tells where the right camera
  of a pair stands: a folder with `left.yaml` and `right.yaml` is a pair.
* A piece of a file that cannot be used is left out with a warning that counts it: faces of two corners, normals
  that are not finite or of length zero, vertices without skin weight, links whose mesh is missing.
* Files of scanners, recordings and CAD programs that are not read (E57, LAS, ROS bags, FBX, STEP and others) are
  refused with a way to convert them.
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
