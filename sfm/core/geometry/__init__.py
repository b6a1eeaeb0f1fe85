"""Geometry of points, rays, motions and pairs of views; pure functions on arrays."""
