"""Tracks: keypoints of several images that are thought to show one point.

Tracks are the connected components of the verified matches, built by union-find with the most trustworthy pairs
first. A match that would put two distant keypoints of one image into one track contradicts earlier, better ones and
is left out, so each track sees a point at most once an image and a wrong match does not chain two points together.

Reference:
    Moulon & Monasse, Unordered feature tracking made fast and easy, CVMP 2012 (for tracks by union-find).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm.core.arrays import Points2D
from sfm.core.scene import Tracks, ViewGraph
from sfm.mapping._kernels import join_matches

_DUPLICATE_PX = 2.0
"""Keypoints of one image this near are the same corner found twice (SIFT repeats one for each orientation)."""


def build_tracks(view_graph: ViewGraph, keypoints: Mapping[int, Points2D], *, min_length: int = 2) -> Tracks:
    """All tracks of at least `min_length` images; observations sorted by image id within a track.

    Args:
        keypoints: of each image id, in px; match indices are rows of it.
    """
    image_ids = np.array(sorted(keypoints), np.int32)
    counts = np.array([len(keypoints[i]) for i in image_ids.tolist()], np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)])
    row = {image_id: k for k, image_id in enumerate(image_ids.tolist())}
    by_trust = sorted(view_graph.pairs, key=lambda pair: (-len(view_graph.pairs[pair]), pair))
    edges = [view_graph.pairs[i, j].matches + np.array([starts[row[i]], starts[row[j]]]) for i, j in by_trust]
    if not edges:
        return Tracks.empty()
    image_of = np.repeat(np.arange(len(image_ids), dtype=np.int32), counts)
    xy = np.concatenate([keypoints[i] for i in image_ids.tolist()])
    labels = join_matches(np.concatenate(edges), image_of, xy, len(image_ids), _DUPLICATE_PX)
    return _collect(labels, image_of, image_ids, starts, min_length)


def _collect(
    labels: np.ndarray, image_of: np.ndarray, image_ids: np.ndarray, starts: np.ndarray, min_length: int
) -> Tracks:
    """Sorts labelled keypoints into tracks, one keypoint an image."""
    members = np.flatnonzero(labels >= 0)
    members = members[np.lexsort((members, labels[members]))]
    label, image = labels[members], image_of[members]
    again = np.zeros(len(members), bool)
    again[1:] = (label[1:] == label[:-1]) & (image[1:] == image[:-1])
    members = members[~again]
    label = labels[members]
    _, lengths = np.unique(label, return_counts=True)
    keep = np.repeat(lengths >= min_length, lengths)
    members, lengths = members[keep], lengths[lengths >= min_length]
    image = image_of[members]
    return Tracks(
        np.concatenate([[0], np.cumsum(lengths)]), image_ids[image], (members - starts[image]).astype(np.int32)
    )
