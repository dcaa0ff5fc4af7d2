"""Any triangle mesh as watertight blocks of points, for which it is resampled.

The steps, each a module:

1. `cleaning`: vertices at the same place are merged, what is no surface is refused, long edges are halved.
2. `cells`: the mesh is cut into discs round sites that lie evenly.
3. `rims`, `maps`: each cell is mapped to the unit disc, one at the border to half of it.
4. `layout`: the triangles between the centres of three cells are joined in pairs, which are the blocks.
5. `samples`: points of the blocks are numbered once, so that neighbours share those on their sides.
6. `relaxation`, `sharp_edges`: the points move over the mesh until they lie evenly, and onto its sharp edges.
7. `distances`: the distance to the mesh is measured both ways, and folds are counted.

`remeshing` has them in order, and puts more sites where the distance is largest. `surfaces` makes a surface of the
result, with the `attributes` of the mesh. The libraries of the extra ``remesh`` are imported on use (`libraries`).
"""

from __future__ import annotations

from .surfaces import KEY, RemeshOptions, remesh

__all__ = ["KEY", "RemeshOptions", "remesh"]
