"""Pure mathematics and the values that stages share: no files, no plots, no clock, no global random state.

Conventions, everywhere in Parallax:

| matter | rule |
|---|---|
| points | rows: `points2D (N, 2)` px, `points3D (N, 3)`, `rays (N, 3)` of unit length; float64 |
| pixels | x right, y down; image corner (0, 0), centre of the first pixel (0.5, 0.5), as in COLMAP |
| images | `(H, W)` or `(H, W, 3)` RGB; uint8 at the edge, float32 in [0, 1] inside; `image[y, x]` |
| axes, transforms | camera: x right, y down, z forward. `b_from_a`, `x_in_b`; a pose is `cam_from_world` |
| tangent | (ω, υ); updates on the left: `exp(δ) @ cam_from_world` |
| units | radians and scene units; a suffix wherever that is not so: `_px _deg _m _s` |
| residual, mask, gap | projected − observed; `True` keeps; NaN for missing depth, −1 for missing index |
| letters | paper letters (`R t K E F H`) inside a function, never in a public signature |
"""
