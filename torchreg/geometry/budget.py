"""The memory budget: how large tables, grids and pictures may become, whatever the input."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """Sizes held at a time, and largest sizes of what is made."""

    # Entries of a table of pairs that is worked on in place: what a CPU's caches hold.
    table_entries: int = 1_000_000
    # Entries of a table of distances, which is written once and searched for its minima.
    distance_entries: int = 16_000_000
    # Pixels covered by the triangles that are rasterized together; about 100 MB.
    raster_pixels: int = 1_000_000
    # Points at which a scalar field is evaluated together.
    field_points: int = 65_536
    # Samples of a volume: 370 along each side of a cube.
    volume_samples: int = 50_000_000
    # Samples of the volume around a shape whose surface is meshed at no given spacing.
    surface_samples: int = 1_500_000
    # Pixels of a picture and of each of its sides; more is a damaged file rather than a camera.
    picture_pixels: int = 64_000_000
    # Pixels along a side of a rasterized view.
    view_side: int = 4096
    # Times that the faces of an icosahedron are split: 655,362 vertices.
    subdivisions: int = 8
    # Points whose nearest neighbors give the spacing of all.
    spacings: int = 20_000


BUDGET = Budget()
