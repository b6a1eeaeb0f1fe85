import numpy as np
import pytest

from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.mapping import build_tracks


def _graph(matches):
    return ViewGraph(
        {
            pair: TwoViewGeometry(PairKind.CALIBRATED, np.array(m, np.int32).reshape(-1, 2))
            for pair, m in matches.items()
        }
    )


def _grid(count):
    return np.stack([np.arange(count) * 50.0, np.zeros(count)], 1)


def _as_sets(tracks):
    return {
        frozenset(zip(tracks.image_ids[a:b].tolist(), tracks.feature_ids[a:b].tolist(), strict=True))
        for a, b in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True)
    }


def _twin(matches, keypoints, near=2.0):
    """Sets that are merged edge by edge unless that would put two distant keypoints of an image together."""
    group = {}
    for (i, j), pairs in sorted(matches.items(), key=lambda item: (-len(item[1]), item[0])):
        for a, b in pairs:
            one, two = group.setdefault((i, a), {(i, a)}), group.setdefault((j, b), {(j, b)})
            clash = any(
                p[0] == q[0] and np.linalg.norm(keypoints[p[0]][p[1]] - keypoints[q[0]][q[1]]) > near
                for p in one
                for q in two
            )
            if one is not two and not clash:
                one |= two
                for member in two:
                    group[member] = one
    result = set()
    for members in group.values():
        first = {}
        for image, feature in sorted(members):
            first.setdefault(image, feature)
        result.add(frozenset(first.items()))
    return {track for track in result if len(track) > 1}


def test_matches_chain_into_one_track():
    tracks = build_tracks(_graph({(1, 2): [(0, 1)], (2, 3): [(1, 2)]}), {i: _grid(3) for i in (1, 2, 3)})
    assert _as_sets(tracks) == {frozenset({(1, 0), (2, 1), (3, 2)})}


def test_a_wrong_match_does_not_merge_two_points():
    good = {(1, 2): [(0, 0), (1, 1)], (1, 3): [(0, 0), (1, 1)], (2, 3): [(0, 1)]}
    tracks = build_tracks(_graph(good), {i: _grid(2) for i in (1, 2, 3)})
    assert _as_sets(tracks) == {frozenset({(1, k), (2, k), (3, k)}) for k in (0, 1)}


def test_a_corner_found_twice_is_one_observation():
    twice = np.array([[10.0, 10.0], [10.5, 10.0]])
    tracks = build_tracks(_graph({(1, 2): [(0, 0), (0, 1)]}), {1: _grid(1), 2: twice})
    assert _as_sets(tracks) == {frozenset({(1, 0), (2, 0)})}


@pytest.mark.parametrize("seed", range(5))
def test_random_graphs_agree_with_merging_sets(seed):
    rng = np.random.default_rng(seed)
    keypoints = {i: rng.uniform(0, 40, (12, 2)) for i in range(1, 6)}
    matches = {
        (i, j): [(a, int(b)) for a, b in enumerate(rng.integers(0, 12, 12)) if rng.random() < 0.6]
        for i in keypoints
        for j in keypoints
        if i < j
    }
    tracks = build_tracks(_graph(matches), keypoints)
    assert _as_sets(tracks) == _twin(matches, keypoints)
    assert all(
        len(set(tracks.image_ids[a:b])) == b - a for a, b in zip(tracks.offsets, tracks.offsets[1:], strict=False)
    )


def test_short_tracks_can_be_left_out():
    graph = _graph({(1, 2): [(0, 0), (1, 1)], (2, 3): [(1, 1)]})
    assert build_tracks(graph, {i: _grid(2) for i in (1, 2, 3)}, min_length=3).lengths.tolist() == [3]


def test_no_matches_make_no_tracks():
    assert len(build_tracks(_graph({}), {1: _grid(2)})) == 0
    assert len(build_tracks(_graph({(1, 2): []}), {1: _grid(2), 2: _grid(2)})) == 0
