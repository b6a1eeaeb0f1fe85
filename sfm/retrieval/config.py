"""The settings of the choice of pairs."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

from sfm.core.errors import ConfigError

Method = Literal["auto", "exhaustive", "vocabulary", "look", "sequential", "spatial", "list"]
Similarity = Literal["votes", "tfidf", "vlad", "fisher"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetrievalConfig:
    """Which pairs are matched in full."""

    method: Method = "auto"
    """All pairs (exhaustive), those that share visual words (vocabulary) or large features (look), neighbours in the
    order of the names with loop closures (sequential), neighbours by GPS (spatial), those of a file (list); or what
    number, order and GPS of the images suggest (auto)."""
    pair_list: str = ""
    """File with two names of images a line; of the method `list`."""
    exhaustive_up_to: int = 20
    """Images up to which `auto` takes all pairs. Finding the promising pairs takes a second or two, as long as the full
    match of some 50 pairs."""

    similarity: Similarity = "votes"
    """What the method `vocabulary` compares. `votes` of single features, the default, finds most; the others are
    vectors for a whole image (see `sfm.retrieval.bag_of_words`, `vlad` and `fisher`)."""
    indexed_features: int = 4096
    """Features of largest scale of each image that become visual words."""
    max_postings: int = 16_000_000
    """Features that become visual words of all images together, which bounds memory (13 bytes each) and the time of a
    query; from 4,000 images on each gets fewer, and at 10,000 images with 1,600 features each still 97 % of the best 20
    partners are right."""
    max_hamming: int = 16
    """Bits of 64 in which the signatures of two features differ that vote for each other. Random ones differ in 32."""
    candidates: int = 100
    """Images of most votes that are kept for each image."""
    min_votes: int = 10
    """Votes that make a pair promising; less, down to two fifths, where features are few for the size of the
    vocabulary (see `sfm.retrieval.voting`). Of 2,840 pairs with 30 verified matches in a pool of 20 sets (370 images,
    68,265 pairs) this and `partners` keep 99.8 % among 6,654."""

    probes: int = 300
    """Features of largest scale of each image that the method `look` compares."""
    probe_ratio: float = 0.85
    """Largest ratio of the distances to the nearest and the second nearest for a match between probes."""
    min_score: int = 6
    """Matches of probes that make a pair promising. Nine in ten pairs of different places have no more by chance."""

    partners: int = 12
    """Partners of each image with most votes or matches of probes that are promising in any case, if there are two."""
    neighbors: int = 2
    """Images before and after in the order of the names that are promising in any case."""
    retries: int = 4
    """Missing links tried in one round, for each image."""

    overlap: int = 10
    """Images before and after that the method `sequential` compares, and those at twice, four times … that distance
    up to `overlap` doublings away."""
    loop_partners: int = 5
    """Partners with most votes, far away in the order, that `sequential` adds for each image where a loop closes."""

    spatial_partners: int = 30
    """Nearest images by GPS that the method `spatial` compares with each."""
    max_distance_m: float = 0.0
    """Farthest of them; 0 for any distance."""

    def __post_init__(self) -> None:
        for name, known in (("method", Method), ("similarity", Similarity)):
            if getattr(self, name) not in get_args(known):
                raise ConfigError(f"{name} must be one of {', '.join(get_args(known))}, got {getattr(self, name)!r}")
        if not 0 < self.probe_ratio <= 1:
            raise ConfigError(f"probe_ratio must be in (0, 1], got {self.probe_ratio}")
        if not 0 <= self.max_hamming <= 64:
            raise ConfigError(f"max_hamming must be in [0, 64], got {self.max_hamming}")
        for name, least in _AT_LEAST.items():
            if getattr(self, name) < least:
                raise ConfigError(f"{name} must be at least {least}, got {getattr(self, name)}")


_AT_LEAST = {
    **dict.fromkeys(("exhaustive_up_to", "min_score", "min_votes", "partners", "neighbors", "retries"), 0),
    **dict.fromkeys(("loop_partners", "max_distance_m"), 0),
    **dict.fromkeys(("indexed_features", "max_postings", "candidates", "overlap", "spatial_partners"), 1),
    "probes": 2,
}
