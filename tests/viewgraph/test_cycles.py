"""Wrong pairs among right ones: planted, then found by the rotations around their triplets."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.viewgraph import CycleConfig, cycle_consistency, without_contradictions

Pair = tuple[int, int]


def geometry(rotation: Rotation3, inliers: int = 100, kind: PairKind = PairKind.CALIBRATED) -> TwoViewGeometry:
    return TwoViewGeometry(kind, np.zeros((inliers, 2), np.int32), Rigid3(rotation, np.array([1.0, 0, 0])))


def graph(
    images: int, wrong_share: float, *, reach: int = 99, noise_deg: float = 1.0, seed: int = 0
) -> tuple[ViewGraph, set[Pair]]:
    """Cameras that look anywhere, pairs of those within `reach` of each other, a share of which has any rotation.

    Wrong pairs have as few matches as such pairs have.
    """
    rng = np.random.default_rng(seed)
    cameras = Rotation3.exp(rng.normal(size=(images, 3)))
    pairs = [(i, j) for i, j in itertools.combinations(range(images), 2) if j - i <= reach]
    wrong = {pairs[k] for k in rng.permutation(len(pairs))[: round(wrong_share * len(pairs))]}
    geometries = {}
    for i, j in pairs:
        turn = Rotation3.exp(np.deg2rad(noise_deg) * rng.normal(size=3))
        right = turn @ cameras[j] @ cameras[i].inverse()
        anything = Rotation3(rng.normal(size=4))
        geometries[i, j] = geometry(anything, int(rng.integers(15, 40))) if (i, j) in wrong else geometry(right)
    return ViewGraph(geometries), wrong


def flagged(view_graph: ViewGraph, config: CycleConfig = CycleConfig()) -> set[Pair]:
    return {pair for pair, found in cycle_consistency(view_graph, config).items() if found.contradicts}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("wrong_share", "recall"), [(0.05, 0.97), (0.2, 0.95), (0.4, 0.9)])
def test_wrong_pairs_are_found_and_right_ones_left(wrong_share, recall, seed):
    view_graph, wrong = graph(25, wrong_share, seed=seed)
    found = flagged(view_graph)
    assert len(found & wrong) >= recall * len(wrong)
    assert len(found - wrong) <= 0.01 * len(view_graph)


@pytest.mark.parametrize("seed", range(3))
def test_a_walk_whose_pairs_reach_four_images_is_judged_too(seed):
    view_graph, wrong = graph(60, 0.1, reach=4, seed=seed)
    found = flagged(view_graph)
    assert len(found & wrong) >= 0.7 * len(wrong)
    assert len(found - wrong) <= 0.02 * len(view_graph)


@pytest.mark.parametrize("noise_deg", [0.0, 1.0, 4.0])
def test_noise_is_no_contradiction(noise_deg):
    view_graph, _ = graph(20, 0.0, noise_deg=noise_deg)
    assert flagged(view_graph) == set()
    consistency = [found.consistency for found in cycle_consistency(view_graph).values()]
    assert min(consistency) > (0.9 if noise_deg <= 1 else 0.3)


def test_rotations_that_are_all_off_flag_nobody():
    """As under focal lengths that are far off: nobody is to be trusted, hence nobody to be blamed."""
    view_graph, _ = graph(12, 0.0, noise_deg=20.0)
    assert len(flagged(view_graph)) <= 0.02 * len(view_graph)


def test_partners_of_a_wrong_pair_keep_their_trust():
    view_graph, _ = graph(6, 0.0)
    pairs = dict(view_graph.pairs)
    pairs[2, 4] = geometry(Rotation3.exp(np.array([1.5, 0, 0])), 20)
    found = cycle_consistency(ViewGraph(pairs))
    assert [pair for pair, one in found.items() if one.contradicts] == [(2, 4)]
    assert found[2, 4].consistency < 0.01
    assert min(one.consistency for pair, one in found.items() if pair != (2, 4)) > 0.95
    kept = without_contradictions(ViewGraph(pairs), found)
    assert set(kept.pairs) == set(pairs) - {(2, 4)}


def test_one_triplet_cannot_tell_which_pair_is_wrong():
    view_graph, _ = graph(3, 0.0)
    pairs = dict(view_graph.pairs)
    pairs[0, 1] = geometry(Rotation3.exp(np.array([2.0, 0, 0])))
    found = cycle_consistency(ViewGraph(pairs))
    assert not any(one.contradicts for one in found.values())
    assert all(one.evidence < 1.5 for one in found.values())


def test_a_pair_stronger_than_those_against_it_is_not_blamed():
    view_graph, _ = graph(6, 0.0)
    weak, strong = ({**view_graph.pairs, (2, 4): geometry(Rotation3.exp(np.array([1.5, 0, 0])), n)} for n in (99, 101))
    assert flagged(ViewGraph(weak)) == {(2, 4)}
    assert flagged(ViewGraph(strong)) == set()


def test_pairs_without_triplets_and_those_that_link_nothing_are_not_judged():
    turn = Rotation3.exp(np.array([0.1, 0.2, 0.3]))
    pairs = {(1, 2): geometry(turn), (2, 3): geometry(turn), (5, 9): geometry(turn)}
    pairs[1, 3] = geometry(turn, kind=PairKind.WATERMARK)
    pairs[3, 5] = TwoViewGeometry(PairKind.PLANAR_OR_PANORAMIC, np.zeros((50, 2), np.int32))
    found = cycle_consistency(ViewGraph(pairs))
    assert list(found) == [(1, 2), (2, 3), (5, 9)]
    assert all(np.isnan(one.consistency) and one.evidence == 0 and not one.contradicts for one in found.values())
    assert cycle_consistency(ViewGraph({})) == {}


def test_the_frame_of_the_world_and_the_ids_of_the_images_do_not_matter():
    view_graph, _ = graph(12, 0.2)
    shifted = ViewGraph({(i + 100, j + 100): one for (i, j), one in view_graph.pairs.items()})
    moved = {(i - 100, j - 100) for i, j in flagged(shifted)}
    assert moved == flagged(view_graph) != set()


def test_many_common_partners_are_judged_by_some_of_them(monkeypatch):
    view_graph, wrong = graph(25, 0.2)
    monkeypatch.setattr("sfm.viewgraph.cycles._MAX_TRIPLETS_OF_A_PAIR", 8)
    found = flagged(view_graph)
    assert len(found & wrong) >= 0.9 * len(wrong)
    assert len(found - wrong) <= 0.01 * len(view_graph)
