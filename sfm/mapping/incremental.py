"""Incremental mapping: grow a model from two images, one image at a time.

    start from a good pair → adjust
    while an image sees enough points:
        resect it → triangulate what it adds → adjust its neighbourhood
        when the model has grown by a tenth: adjust everything, complete tracks, drop what does not fit
    while an image sees half as many, and nothing speaks against it (see `leftovers`):
        resect it → triangulate → adjust its neighbourhood → keep it or undo all this → go on above
    adjust everything to convergence

Images that are left start the next model. Models that prove to lie in one world are joined (see `joining`). A model
that folds two places onto each other (see `ambiguity`) is grown anew without the matches that mistake one for the
other.

Reference:
    Schönberger & Frahm, Structure-from-Motion Revisited, CVPR 2016.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from sfm.bundle import BundleConfig
from sfm.core.arrays import FloatArray, Points2D
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import SILENT, ImageRegistered, Note, Observer
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import PairKind, Reconstruction, ViewGraph
from sfm.mapping.adjustment import adjust_globally, adjust_locally, has_bogus_params, neighbourhood
from sfm.mapping.ambiguity import unfolded
from sfm.mapping.initialization import InitialPair, acceptable_pairs, rank_initial_pairs
from sfm.mapping.joining import find_join, join_doubt, merged
from sfm.mapping.leftovers import chance_doubt, loss_doubt, match_doubt
from sfm.mapping.registration import Resection, next_images, resect
from sfm.mapping.state import Scene, State
from sfm.mapping.tracks import build_tracks


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingConfig:
    """How models grow; angles in degrees, errors in px of the full image."""

    min_track_length: int = 3
    """Views that a track must have to make a point: no third view checks a shorter one. Shorter ones are used where
    the images at hand have fewer than `init_min_inliers` of the others."""
    init_min_inliers: int = 100
    """Matches of the first pair; halved and quartered where no pair has them."""
    init_min_angle_deg: float = 16.0
    """Median angle between the rays of the first pair; relaxed before the matches are."""
    init_max_forward: float = 0.95
    """Largest part of the first pair's motion along the optical axis."""
    init_trials: int = 200
    """First pairs that may fail before mapping ends."""
    resection_max_error_px: float = 12.0
    """Reprojection error of a point that agrees with a new pose; wide, as the model is not yet adjusted to it."""
    resection_min_inliers: int = 30
    """Points that must agree with a new pose."""
    resection_min_inlier_ratio: float = 0.25
    """Share of the visible points that must agree."""
    leftover_min_inliers: int = 15
    """Points that must agree with the pose of an image when no other can be registered any more; it then is held
    against its matches with others and against chance, too. From `resection_min_inliers` on there is no such round."""
    join_min_tracks: int = 20
    """Common tracks that must agree with how one model lies in another, so that both become one."""
    resection_trials: int = 3
    """Attempts for an image; it is tried again only when it sees more points than before."""
    min_observations: int = 10
    """Observations below which an image is taken out of the model again."""
    min_agreeing_share: float = 0.15
    """Share of the model's points on its tracks that an image must agree with, or it is taken out again."""
    triangulation_max_error_px: float = 8.0
    """Reprojection error for a view to join a new point, before adjustment."""
    max_error_px: float = 4.0
    """Reprojection error above which an adjusted observation is dropped."""
    min_angle_deg: float = 1.5
    """Points whose widest pair of rays is narrower are dropped: their depth is not known."""
    local_images: int = 5
    """Neighbours adjusted with a new image."""
    global_growth: float = 1.1
    """Everything is adjusted when images or points have grown by this factor."""
    loss_scale_px: float = 1.0
    """Residual at which the soft-L1 loss of the adjustments turns from squared to linear."""
    principal_point_min_images: int = 5
    """Images that a camera must have for its principal point to be adjusted at the end, held by a prior of 1 % of the
    longer side. With it at the centre, the rotations of fountain-P11 and Herz-Jesus-P8 are wrong by 0.4°."""
    min_model_images: int = 3
    """Later models with fewer images are not kept; the first is."""
    max_models: int = 20
    """Models tried for at most."""
    max_unfoldings: int = 3
    """How often mapping starts anew because two places that look alike were laid on top of each other; 0: never."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            # Not `value <= 0`: NaN must fail, too.
            if not (value > 0 or (field.name == "max_unfoldings" and value == 0)):
                raise ConfigError(f"{field.name} must be positive, got {value}")
        if not self.global_growth > 1:
            raise ConfigError(f"global_growth must be above 1, got {self.global_growth}")


def map_incrementally(
    view_graph: ViewGraph,
    keypoints: Mapping[int, Points2D],
    cameras: Mapping[int, Camera],
    image_cameras: Mapping[int, int],
    image_names: Mapping[int, str],
    config: MappingConfig = MappingConfig(),
    *,
    keypoint_scales: Mapping[int, FloatArray] | None = None,
    seed: int = 0,
    threads: int = 1,
    refine_intrinsics: bool = True,
    observer: Observer = SILENT,
) -> list[Reconstruction]:
    """Models of all images that hang together, the one with most images first; empty where no pair starts one.

    Args:
        keypoints: by image id, in px; the rows are what the matches of `view_graph` count.
        cameras: by camera id. Their focal lengths and distortions are refined unless `refine_intrinsics` is false.
        image_cameras: camera id of each image id.
        keypoint_scales: by image id, in px, row by row with `keypoints`: how precise each scale is will be learnt.
        seed: of the resections' random samples.
        threads: changes the time, not the result.
    """

    # Logos and time stamps would chain photos of different places together.
    view_graph = ViewGraph({k: g for k, g in view_graph.pairs.items() if g.kind != PairKind.WATERMARK})

    def grow(graph: ViewGraph) -> list[Reconstruction]:
        tracks = build_tracks(graph, keypoints, min_length=2)
        scene = Scene.build(tracks, keypoints, cameras, image_cameras, image_names, keypoint_scales)
        return _Mapper(scene, graph, config, seed, threads, refine_intrinsics, observer).grow_models()

    models = grow(view_graph)
    for attempt in range(config.max_unfoldings):
        graphs = (unfolded(view_graph, model, suspected=attempt > 0) for model in models)
        if (graph := next((g for g in graphs if g is not None), None)) is None:
            break
        dropped = len(view_graph) - len(graph)
        observer(Note(message=f"two places look alike: leaving out {dropped} pairs that mistake one for the other"))
        view_graph, models = graph, grow(graph)
    return models


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Mapper:
    """The inputs of one mapping, so that its steps read as sentences."""

    scene: Scene
    view_graph: ViewGraph
    config: MappingConfig
    seed: int
    threads: int
    refine_intrinsics: bool
    observer: Observer

    def grow_models(self) -> list[Reconstruction]:
        """Models of all images that hang together, the one with most images first."""
        states: list[State] = []
        used = np.zeros(len(self.scene.image_ids), bool)
        failed: set[tuple[int, int]] = set()
        while len(states) < self.config.max_models and (start := self.start_from_best_pair(used, failed)) is not None:
            state, pair = start
            self.grow_model(state, used)
            if state.registered.sum() >= 2:
                used |= state.registered
                states.append(state)
            else:  # grown from a wrong pair, nothing in it agreed in the end
                failed.add((pair.image1, pair.image2))
        states.sort(key=lambda s: (-s.registered.sum(), -s.has_point.sum()))
        states = self.joined(states)
        states.sort(key=lambda s: (-s.registered.sum(), -s.has_point.sum()))
        kept = [s for k, s in enumerate(states) if k == 0 or s.registered.sum() >= self.config.min_model_images]
        return [state.to_reconstruction() for state in kept]

    def grow_model(self, state: State, used: np.ndarray) -> None:
        """Adds all images that fit and are not `used` to a model of two; what does not hold may fall apart again."""
        tried_at: dict[int, list[int]] = {}
        refused_at: dict[int, int] = {}
        self.add_images(state, used, tried_at)
        if self.leftovers(state, used, refused_at):
            self.refine(state, rounds=2)
            self.add_images(state, used, tried_at)
            while self.register_leftover(state, used, refused_at):
                self.add_images(state, used, tried_at)
        self.refine(state, rounds=5, final=True)

    def add_images(self, state: State, used: np.ndarray, tried_at: dict[int, list[int]]) -> None:
        """Registers image after image with adjustments in between, until no more fits."""
        images_then, points_then = int(state.registered.sum()), int(state.has_point.sum())
        registered = self.register_next(state, used, tried_at)
        while registered is not None:
            images, points = int(state.registered.sum()), int(state.has_point.sum())
            growth = self.config.global_growth
            if images >= growth * images_then or points >= growth * points_then:
                self.refine(state, rounds=2)
                images_then, points_then = images, int(state.has_point.sum())
            else:
                self.adjust_around(state, registered)
            registered = self.register_next(state, used, tried_at)
            if registered is None and self.drop_misplaced_images(state):
                registered = self.register_next(state, used, tried_at)

    def start_from_best_pair(self, used: np.ndarray, failed: set[tuple[int, int]]) -> tuple[State, InitialPair] | None:
        """A model of two images that are not `used`, by a pair that has not `failed`; None where no pair starts one.

        Pairs that do not start a model are added to `failed`; `init_trials` may be there.
        """
        config = self.config
        blank = State.start(self.scene)
        blank.registered |= used
        candidates = rank_initial_pairs(blank, self.view_graph)
        acceptable = acceptable_pairs(
            candidates, config.init_min_inliers, np.deg2rad(config.init_min_angle_deg), config.init_max_forward
        )
        for pair in acceptable:
            if len(failed) >= config.init_trials:
                break
            rows = (pair.image1, pair.image2)
            if rows in failed:
                continue
            state = self.start_from(pair)
            if state is not None:
                return state, pair
            failed.add(rows)
        return None

    def start_from(self, pair: InitialPair) -> State | None:
        """The two-image model of a pair, if enough of its points survive adjustment."""
        state = State.start(self.scene)
        state.set_pose(pair.image1, Rigid3.identity())
        state.set_pose(pair.image2, pair.cam2_from_cam1)
        self.triangulate_seen_by(state, np.array([pair.image1, pair.image2]))
        self.refine(state, rounds=2)
        points = int(state.has_point.sum())
        if points < self.config.resection_min_inliers:
            return None
        for image in (pair.image1, pair.image2):
            self.tell(state, image, Resection(points, points))
        return state

    def register_next(self, state: State, used: np.ndarray, tried_at: dict[int, list[int]]) -> int | None:
        """Registers the image that sees the points best; None when no image can be registered any more."""
        config = self.config
        for image, visible in next_images(state, config.resection_min_inliers):
            attempts = tried_at.setdefault(image, [])
            if used[image] or len(attempts) >= config.resection_trials or (attempts and visible <= attempts[-1]):
                continue
            camera_row = self.scene.image_camera[image]
            is_new = not np.any(state.registered & (self.scene.image_camera == camera_row))
            outcome = resect(
                state,
                image,
                max_error_px=config.resection_max_error_px,
                min_inliers=config.resection_min_inliers,
                min_inlier_ratio=config.resection_min_inlier_ratio,
                refine_focal=self.refine_intrinsics
                and is_new
                and not self.scene.cameras[camera_row].has_prior_focal_length,
                rng=np.random.default_rng([self.seed, int(self.scene.image_ids[image]), len(attempts)]),
            )
            attempts.append(visible)
            self.tell(state, image, outcome)
            if isinstance(outcome, Resection):
                self.triangulate_seen_by(state, np.array([image]))
                return image
        return None

    def leftovers(self, state: State, used: np.ndarray, refused_at: dict[int, int]) -> list[tuple[int, int]]:
        """Images with the number of points that they see, enough for the last round and more than when refused."""
        config = self.config
        if config.leftover_min_inliers >= config.resection_min_inliers:
            return []
        candidates = next_images(state, config.leftover_min_inliers)
        return [(image, n) for image, n in candidates if not used[image] and n > refused_at.get(image, 0)]

    def register_leftover(self, state: State, used: np.ndarray, refused_at: dict[int, int]) -> bool:
        """Registers an image that sees few points if nothing speaks against it; False where there is none."""
        config = self.config
        for image, visible in self.leftovers(state, used, refused_at):
            outcome = resect(
                state,
                image,
                max_error_px=config.resection_max_error_px,
                min_inliers=config.leftover_min_inliers,
                min_inlier_ratio=config.resection_min_inlier_ratio,
                refine_focal=False,  # which so few points do not determine
                rng=np.random.default_rng([self.seed, int(self.scene.image_ids[image]), visible, 1]),
            )
            if isinstance(outcome, Resection):
                before = state.copy()
                doubt = self.settle_leftover(state, image)
                if doubt is not None:
                    state.become(before)
                    state.unregister(image)
                    outcome = doubt
            self.tell(state, image, outcome, config.leftover_min_inliers)
            if isinstance(outcome, Resection):
                return True
            refused_at[image] = visible
        return False

    def settle_leftover(self, state: State, image: int) -> Rejected | None:
        """Triangulates and adjusts what a newly registered image sees; why it had better be undone, if it had."""
        config = self.config
        doubt = chance_doubt(state, image, config.resection_max_error_px)
        if doubt is None:
            self.triangulate_seen_by(state, np.array([image]))
            self.adjust_around(state, image)
            doubt = loss_doubt(state, image, config.leftover_min_inliers)
        if doubt is None:
            alone = np.arange(len(state.registered)) == image
            doubt = match_doubt(state, alone, ~alone, self.view_graph, config.max_error_px)
        return doubt

    def joined(self, states: list[State]) -> list[State]:
        """The models, where one of them lies in another's world as one of both, with the images that now fit."""
        states, first = list(states), 0
        while first < len(states):
            for second in range(first + 1, len(states)):
                both = self.join(states[first], states[second])
                if both is None:
                    continue
                others = np.zeros(len(both.registered), bool)
                for k, state in enumerate(states):
                    others |= state.registered & (k not in (first, second))
                self.grow_model(both, others)
                if both.registered.sum() >= 2:  # else it fell apart, and two models are better than none
                    states[first] = both
                    del states[second]
                    break
            else:
                first += 1
        return states

    def join(self, a: State, b: State) -> State | None:
        """One model of two that have enough tracks in common, adjusted; None where they do not fit."""
        config, ids = self.config, self.scene.image_ids
        rng = np.random.default_rng([self.seed, int(ids[a.registered][0]), int(ids[b.registered][0]), 2])
        found = find_join(a, b, config.resection_max_error_px, config.join_min_tracks, rng)
        if isinstance(found, Rejected):
            return None
        both = merged(a, b, found.a_from_b)
        self.refine(both, rounds=3)
        doubt = join_doubt(both, a.registered, b.registered, config.join_min_tracks)
        if doubt is None:
            doubt = match_doubt(both, a.registered, b.registered, self.view_graph, config.max_error_px)
        sizes = f"models of {a.registered.sum()} and {b.registered.sum()} images"
        if doubt is not None:
            self.observer(Note(message=f"{sizes} stay apart: {doubt.detail}"))
            return None
        self.observer(Note(message=f"{sizes} joined by {found.agreeing} common tracks"))
        return both

    def triangulate_seen_by(self, state: State, images: np.ndarray) -> None:
        """Makes and completes points on the tracks of these images."""
        config, tracks = self.config, state.tracks_seen_by(images)
        # A point needs two registered images.
        tracks = tracks[state.registered_views()[tracks] >= 2]
        if len(tracks):
            long = np.diff(self.scene.offsets)[tracks] >= config.min_track_length
            tracks = tracks[long] if long.sum() >= config.init_min_inliers else tracks
            state.triangulate(tracks, config.triangulation_max_error_px, np.deg2rad(config.min_angle_deg))

    def adjust_around(self, state: State, image: int) -> None:
        """Local adjustment after a registration."""
        config = self.config
        images = neighbourhood(state, image, config.local_images, np.deg2rad(6.0))
        bundle = BundleConfig(
            loss="soft_l1", loss_scale_px=config.loss_scale_px, max_iterations=15, relative_cost_tolerance=1e-4
        )
        fixed = np.zeros((len(self.scene.cameras), MAX_PARAMS), bool)
        adjust_locally(state, images, bundle, free_params=fixed, threads=self.threads, observer=self.observer)
        tracks = state.tracks_seen_by(images)
        state.filter(tracks, config.max_error_px, np.deg2rad(config.min_angle_deg))

    def refine(self, state: State, *, rounds: int, final: bool = False) -> None:
        """Adjusts everything, then completes tracks and drops what does not fit, until little changes."""
        config = self.config
        min_angle = np.deg2rad(config.min_angle_deg)
        bundle = BundleConfig(
            loss="soft_l1",
            loss_scale_px=config.loss_scale_px,
            max_iterations=100 if final else 30,
            relative_cost_tolerance=1e-6 if final else 1e-4,
        )
        for _ in range(rounds):
            before = state.on.copy()
            self.adjust_all(state, bundle)
            all_tracks = np.arange(len(state.has_point))
            state.filter(all_tracks, config.max_error_px, min_angle)
            self.triangulate_seen_by(state, np.flatnonzero(state.registered))
            state.filter(all_tracks, config.max_error_px, min_angle)
            self.drop_lost_images(state)
            self.drop_misplaced_images(state)
            if np.sum(state.on != before) <= 0.0005 * np.sum(before):
                break
        if final:
            exact = dataclasses.replace(bundle, relative_cost_tolerance=1e-8)
            self.adjust_all(state, bundle, principal_points=True)
            for _ in range(2):  # better poses show the noise better
                self.adjust_all(state, exact, principal_points=True, weighted=True)
            state.filter(np.arange(len(state.has_point)), config.max_error_px, min_angle)

    def drop_lost_images(self, state: State) -> None:
        """Takes out images whose pose hardly any observation supports any more; they may be tried again."""
        views = np.bincount(self.scene.image[state.on], minlength=len(state.registered))
        for image in np.flatnonzero(state.registered & (views < self.config.min_observations)).tolist():
            state.unregister(image)
            self.tell(state, image, Rejected("lost_observations", f"{views[image]} of its observations still fit"))

    def drop_misplaced_images(self, state: State) -> bool:
        """Takes out images that disagree with most points of the model that they should see; True if there are any.

        A wrong pose can hold itself up by the few false matches that it comes from, e.g. that of the first pair.
        """
        on, observed = np.zeros(len(state.registered)), np.zeros(len(state.registered))
        np.add.at(on, self.scene.image[state.on], 1)
        np.add.at(observed, self.scene.image[state.has_point[self.scene.track_of]], 1)
        share = on / np.maximum(observed, 1)
        misplaced = np.flatnonzero(state.registered & (share < self.config.min_agreeing_share))
        if state.registered.sum() - len(misplaced) < 2:
            return False
        for image in misplaced.tolist():
            state.unregister(image)
            detail = f"agrees with {100 * share[image]:.0f} % of the points that it should see"
            self.tell(state, image, Rejected("misplaced", detail))
        return len(misplaced) > 0

    def adjust_all(
        self, state: State, bundle: BundleConfig, *, principal_points: bool = False, weighted: bool = False
    ) -> None:
        """Adjusts everything; a camera that this drives out of bounds goes back and is held."""
        free = self.free_params(state, principal_points)
        before = state.copy()

        def adjust() -> None:
            adjust_globally(
                state, bundle, free_params=free, threads=self.threads, observer=self.observer, weighted=weighted
            )

        adjust()
        bogus = [row for row in np.flatnonzero(free.any(1)).tolist() if has_bogus_params(state, row)]
        if bogus:
            for name in ("params", "ray", "R", "t", "points"):
                setattr(state, name, getattr(before, name))
            free[bogus] = False
            adjust()

    def free_params(self, state: State, principal_points: bool) -> np.ndarray:
        """Which parameters (C, K) are adjusted.

        Two images show little of a lens: then only a guessed focal length is. The principal point, which a rotation
        imitates, is left to the end and to cameras with several images.
        """
        free = np.zeros((len(self.scene.cameras), MAX_PARAMS), bool)
        if not self.refine_intrinsics:
            return free
        images = np.bincount(self.scene.image_camera[state.registered], minlength=len(free))
        enough = images.sum() > 2
        for row in np.flatnonzero(images):
            camera = self.scene.cameras[row]
            if enough or not camera.has_prior_focal_length:
                free[row, list(camera.model_info.focal_indices)] = True
            if enough:
                free[row, list(camera.model_info.extra_indices)] = True
            if principal_points and images[row] >= self.config.principal_point_min_images:
                free[row, list(camera.model_info.principal_point_indices)] = True
        return free

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
