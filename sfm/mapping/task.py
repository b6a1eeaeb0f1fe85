"""What one mapping is given, and stays as it is while models grow."""

from __future__ import annotations

import dataclasses

from sfm.core.errors import Rejected
from sfm.core.events import ImageRegistered, Observer
from sfm.core.scene import ViewGraph
from sfm.mapping.config import MappingConfig
from sfm.mapping.registration import Resection
from sfm.mapping.state import Scene, State


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MappingTask:
    """Images, what is known of their pairs, and how to map them; see `map_incrementally`."""

    scene: Scene
    view_graph: ViewGraph
    config: MappingConfig
    seed: int
    threads: int
    refine_intrinsics: bool
    observer: Observer

    def tell(self, state: State, image: int, outcome: Resection | Rejected, needed: int | None = None) -> None:
        """Tells the observer how a registration went that needed so many inliers."""
        ok = isinstance(outcome, Resection)
        self.observer(
            ImageRegistered(
                name=self.scene.image_names[image],
                registered=int(state.registered.sum()),
                points=int(state.has_point.sum()),
                inliers=outcome.inliers if ok else 0,
                needed=self.config.resection_min_inliers if needed is None else needed,
                visible=outcome.visible if ok else 0,
                reason="" if ok else f"{outcome.reason}: {outcome.detail}",
            )
        )
