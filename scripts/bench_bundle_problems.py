"""Problems for `bench_bundle`: read from files, synthesized by pycolmap, or made up here.

All arrive as a `BundleProblem`, in which poses, points and, if wished, focal lengths and distortion are free.
"""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import KDTree

from sfm.bundle import BundleProblem, free_params_of, problem_from_reconstruction, squared_errors
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras.models import model_by_id, model_by_name
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.io.colmap_model import read_model

ARRAYS = (
    "model_ids", "camera_params", "image_cameras", "points3D", "obs_images", "obs_points", "obs_points2D",
    "free_params", "free_poses", "free_points",
)  # fmt: skip
_VERSION = 1
"""Of what `synthesize` and `street` make: a cached problem of another version is not used."""
_STREET_VIEWS = 6
_LATERAL_M, _FAR_M, _NEAR_M = (6.0, 14.0), 45.0, 4.0


def make_problem(
    model: str, params: np.ndarray, image_cameras: np.ndarray, cams_from_world: Rigid3, points3D: np.ndarray,
    images: np.ndarray, points: np.ndarray, points2D: np.ndarray,
) -> BundleProblem:  # fmt: skip
    """All of one camera model, everything free but the principal points."""
    padded = np.zeros((len(params), MAX_PARAMS))
    padded[:, : params.shape[1]] = params
    info = model_by_name(model)
    return BundleProblem(
        model_ids=np.full(len(params), info.model_id, np.int32),
        camera_params=padded,
        image_cameras=image_cameras.astype(np.int32),
        cams_from_world=cams_from_world,
        points3D=np.ascontiguousarray(points3D),
        obs_images=images.astype(np.int32),
        obs_points=points.astype(np.int32),
        obs_points2D=np.ascontiguousarray(points2D),
        free_params=np.tile(free_params_of(info, ("focal", "extra")), (len(params), 1)),
        free_poses=np.ones(len(image_cameras), bool),
        free_points=np.ones(len(points3D), bool),
    )


def with_fixed_intrinsics(problem: BundleProblem) -> BundleProblem:
    """The same with constant cameras."""
    return dataclasses.replace(problem, free_params=np.zeros_like(problem.free_params))


# --- files ---


def read_problem(path: Path) -> BundleProblem:
    """A COLMAP model (a folder), or a file of Bundle Adjustment in the Large, of GBP, or of sba (its …pts.txt)."""
    if path.is_dir():
        return problem_from_reconstruction(read_model(path))
    with path.open(encoding="utf-8") as file:
        first = file.readline()
    if first.startswith("# X Y Z"):
        return read_sba(path)
    return read_gbp(path) if first.startswith("# Dataset") else read_bal(path)


def read_bal(path: Path) -> BundleProblem:
    """Cameras that look along −z with y up, each with f, k1, k2 of its own, as RADIAL cameras."""
    numbers = np.array(path.read_text().split(), float)
    count, _, observations = numbers[:3].astype(int)
    table = numbers[3 : 3 + 4 * observations].reshape(-1, 4)
    rest = numbers[3 + 4 * observations :]
    cameras, points3D = rest[: 9 * count].reshape(-1, 9), rest[9 * count :].reshape(-1, 3)
    flip = Rotation3(np.tile([0.0, 1.0, 0.0, 0.0], (count, 1)))
    params = np.zeros((count, 5))
    params[:, [0, 3, 4]] = cameras[:, 6:]
    poses = Rigid3(flip @ Rotation3.exp(cameras[:, :3]), flip @ cameras[:, 3:6])
    points2D = table[:, 2:] * [1.0, -1.0]
    return make_problem("RADIAL", params, np.arange(count), poses, points3D, table[:, 0], table[:, 1], points2D)


def read_gbp(path: Path) -> BundleProblem:
    """A file of Ortiz' Gaussian belief propagation: one PINHOLE camera, poses as translation and rotation vector."""
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    images, points, observations = map(int, lines[0].split())
    table = np.array([line.split() for line in lines[2 : 2 + observations]], float)
    rest = np.array(lines[2 + observations :], float)
    poses, points3D = rest[: 6 * images].reshape(-1, 6), rest[6 * images :].reshape(points, 3)
    return make_problem(
        "PINHOLE", np.array([lines[1].split()], float), np.zeros(images, int),
        Rigid3(Rotation3.exp(poses[:, 3:]), np.ascontiguousarray(poses[:, :3])), points3D,
        table[:, 0], table[:, 1], table[:, 2:],
    )  # fmt: skip


def read_sba(path: Path) -> BundleProblem:
    """…pts.txt of Lourakis' sba with …cams.txt and calib.txt beside it: one PINHOLE camera."""
    K = np.loadtxt(path.with_name("calib.txt"))
    poses = np.loadtxt(path.with_name(path.name.replace("pts", "cams")))
    rows = [np.array(line.split(), float) for line in path.read_text().splitlines() if not line.startswith("#")]
    seen = np.concatenate([row[4:].reshape(-1, 3) for row in rows])
    return make_problem(
        "PINHOLE", np.array([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]]), np.zeros(len(poses), int),
        Rigid3(Rotation3(poses[:, :4]), np.ascontiguousarray(poses[:, 4:])), np.array([row[:3] for row in rows]),
        seen[:, 0], np.repeat(np.arange(len(rows)), [int(row[3]) for row in rows]), seen[:, 1:],
    )  # fmt: skip


def disturbed(problem: BundleProblem, part: float, seed: int = 0) -> BundleProblem:
    """Centres and points moved by `part` of the median distance between points and cameras, rotations by `part` rad.

    Observations whose point falls behind its camera remain, and take no part on either side.
    """
    rng = np.random.default_rng(seed)
    poses = problem.cams_from_world
    distances = np.linalg.norm(poses.center[problem.obs_images] - problem.points3D[problem.obs_points], axis=1)
    size = part * float(np.median(distances))
    rotation = Rotation3.exp(part * rng.normal(size=(len(problem.free_poses), 3))) @ poses.rotation
    center = poses.center + size * rng.normal(size=(len(problem.free_poses), 3))
    return dataclasses.replace(
        problem,
        cams_from_world=Rigid3(rotation, -np.einsum("iab,ib->ia", rotation.matrix, center)),
        points3D=problem.points3D + size * rng.normal(size=problem.points3D.shape),
    )


# --- synthetic ---


def synthesize(images: int, points: int, track_length: int = -1) -> BundleProblem:
    """pycolmap's: one shared SIMPLE_RADIAL camera, 0.5 px noise, poses and points displaced.

    Tracks are of random images; −1 is all that see the point. The matrix of the reduced system is thus nearly full
    with any number of points, which is the worst case for sparse solvers. Meanwhile pycolmap holds the projections of
    all points into all images: 40 bytes each, 4 GB and two minutes for 2000x50000.
    """
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, images
    options.num_points3D, options.track_length = points, track_length
    options.num_points2D_without_point3D = 0
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = 0.5, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    with tempfile.TemporaryDirectory() as folder:  # element by element would take a hundred times longer
        reconstruction.write_binary(folder)
        return problem_from_reconstruction(read_model(folder))


def street(images: int, points: int, seed: int = 0) -> BundleProblem:
    """A drive through a town: two laps of a course that crosses itself 17 times, facades on both sides.

    Frames are 2 m apart, in metres, looking ahead with 90° of view. A point is seen by up to 6 of the frames that can
    see it: consecutive ones of one lap mostly, of the other lap and of crossing streets where these come by. Pixels
    have 0.5 px of noise; poses and points start from a drift, a random walk of 1 m and 0.2° at its farthest.
    """
    rng = np.random.default_rng(seed)
    centers, headings = _course(images)
    poses = _level_cameras(centers, headings)
    lateral = rng.choice([-1.0, 1.0], points) * rng.uniform(*_LATERAL_M, points)
    anchor = rng.integers(0, images, points)
    across = np.stack([-np.sin(headings), np.cos(headings), np.zeros(images)], axis=1)
    along = np.stack([np.cos(headings), np.sin(headings), np.zeros(images)], axis=1)
    points3D = centers[anchor] + lateral[:, None] * across[anchor] + rng.uniform(5, 25, (points, 1)) * along[anchor]
    points3D[:, 2] += rng.uniform(-1.5, 8, points)
    params = np.array([[640.0, 640.0, 360.0, -0.05]])  # 90° over 1280 px
    rows_image, rows_point = _street_sightings(centers, along, points3D, anchor, rng)
    blank = np.zeros((len(rows_image), 2))
    problem = make_problem(
        "SIMPLE_RADIAL", params, np.zeros(images, int), poses, points3D, rows_image, rows_point, blank
    )
    measured = _projections(problem) + 0.5 * rng.normal(size=blank.shape)
    problem = dataclasses.replace(problem, obs_points2D=measured)
    return _drifted(problem, anchor, rng)


def _course(images: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres (I, 3) in metres and headings (I,) of frames at equal distances on a Lissajous curve, run twice."""
    theta = np.linspace(0, 4 * np.pi, 40 * images + 1)
    lap = np.stack([np.sin(3 * theta), np.sin(4 * theta + 0.4)], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lap, axis=0), axis=1))])
    at = np.interp(np.arange(images) * length[-1] / images, length, theta)
    size = 2.0 * images / length[-1]
    plane = size * np.stack([np.sin(3 * at), np.sin(4 * at + 0.4)], axis=1)
    heading = np.arctan2(4 * np.cos(4 * at + 0.4), 3 * np.cos(3 * at))
    plane += 0.5 * np.where(at < 2 * np.pi, 1, -1)[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    return np.column_stack([plane, np.full(images, 1.5)]), heading


def _level_cameras(centers: np.ndarray, headings: np.ndarray) -> Rigid3:
    """Cameras that look along the heading, y down; the world's z is up."""
    zero, one = np.zeros(len(headings)), np.ones(len(headings))
    z = np.stack([np.cos(headings), np.sin(headings), zero], axis=1)
    x = np.stack([np.sin(headings), -np.cos(headings), zero], axis=1)
    R = np.stack([x, np.stack([zero, zero, -one], axis=1), z], axis=1)
    return Rigid3(Rotation3.from_matrix(R), -np.einsum("iab,ib->ia", R, centers))


def _street_sightings(
    centers: np.ndarray, along: np.ndarray, points3D: np.ndarray, anchor: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Images and points of up to 6 sightings of each point, chosen among the nearest 64 frames.

    Two in three points are seen by frames that follow each other, the others by any that can see them.
    """
    tree = KDTree(centers)
    images, points = [], []
    for first in range(0, len(points3D), 100_000):
        here = points3D[first : first + 100_000]
        near = tree.query(here, k=min(64, len(centers)), distance_upper_bound=_FAR_M)[1]
        found = near < len(centers)
        near = np.where(found, near, 0)
        offset = here[:, None] - centers[near]
        depth = np.einsum("pka,pka->pk", offset, along[near])
        sideways = np.sqrt(np.maximum(np.einsum("pka,pka->pk", offset[..., :2], offset[..., :2]) - depth**2, 0))
        upright = np.abs(offset[..., 2])
        seen = found & (depth > _NEAR_M) & (sideways < 0.95 * depth) & (upright < 0.53 * depth)
        apart = np.abs(near - anchor[first : first + len(here), None])
        priority = np.where(rng.random((len(here), 1)) < 2 / 3, apart, rng.random(near.shape))
        chosen = np.argsort(np.where(seen, priority, np.inf), axis=1, kind="stable")[:, :_STREET_VIEWS]
        kept = np.take_along_axis(seen, chosen, axis=1)
        kept &= kept.sum(axis=1, keepdims=True) >= 2
        images.append(np.take_along_axis(near, chosen, axis=1)[kept])
        points.append(first + np.nonzero(kept)[0])
    return np.concatenate(images), np.concatenate(points)


def _projections(problem: BundleProblem) -> np.ndarray:
    """Pixels (n, 2) of the observed points, all by the one SIMPLE_RADIAL camera."""
    f, cx, cy, k = problem.camera_params[0, :4]
    R, t = problem.cams_from_world.rotation.matrix, problem.cams_from_world.translation
    x = np.einsum("nab,nb->na", R[problem.obs_images], problem.points3D[problem.obs_points]) + t[problem.obs_images]
    x = x[:, :2] / x[:, 2:]
    return f * x * (1 + k * np.sum(x**2, axis=1, keepdims=True)) + [cx, cy]


def _drifted(problem: BundleProblem, anchor: np.ndarray, rng: np.random.Generator) -> BundleProblem:
    """Poses off by a random walk, and points by that of the frame from which they were placed."""
    images = len(problem.free_poses)
    walk = np.cumsum(rng.normal(size=(images, 6)), axis=0)
    walk *= [*[np.deg2rad(0.2)] * 3, *[1.0] * 3] / np.abs(walk).max(axis=0)
    turn, center = Rotation3.exp(walk[:, :3]), problem.cams_from_world.center
    rotation = problem.cams_from_world.rotation @ turn.inverse()
    moved = center + walk[:, 3:]
    points3D = turn[anchor] @ (problem.points3D - center[anchor]) + moved[anchor]
    return dataclasses.replace(
        problem,
        cams_from_world=Rigid3(rotation, -np.einsum("iab,ib->ia", rotation.matrix, moved)),
        points3D=points3D + 0.05 * rng.normal(size=points3D.shape),
    )


# --- to and from pycolmap ---


def reconstruction_of(problem: BundleProblem) -> pycolmap.Reconstruction:
    """The same numbers for Ceres; the ids of images, cameras and points are their rows plus one."""
    reconstruction = pycolmap.Reconstruction()
    images, order = len(problem.free_poses), np.argsort(problem.obs_images, kind="stable")
    offsets = np.searchsorted(problem.obs_images[order], np.arange(images + 1))
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order)) - offsets[problem.obs_images[order]]
    for row, (number, params) in enumerate(zip(problem.model_ids, problem.camera_params, strict=True)):
        info = model_by_id(int(number))
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model=info.name, width=2000, height=2000, params=params[: len(info.param_names)],
                            camera_id=row + 1)
        )  # fmt: skip
    for row, matrix in enumerate(problem.cams_from_world.matrix):
        reconstruction.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{row}.jpg", keypoints=problem.obs_points2D[order[offsets[row] : offsets[row + 1]]],
                           camera_id=int(problem.image_cameras[row]) + 1, image_id=row + 1),
            pycolmap.Rigid3d(matrix[:3]),
        )  # fmt: skip
    by_point = np.argsort(problem.obs_points, kind="stable")
    ends = np.searchsorted(problem.obs_points[by_point], np.arange(len(problem.points3D) + 1))
    image_ids, place = (problem.obs_images[by_point] + 1).tolist(), place[by_point].tolist()
    for row, xyz in enumerate(problem.points3D):
        mine = range(ends[row], ends[row + 1])
        elements = [pycolmap.TrackElement(image_ids[o], place[o]) for o in mine]
        reconstruction.add_point3D(xyz, pycolmap.Track(elements))
    return reconstruction


def with_parameters_of(problem: BundleProblem, reconstruction: pycolmap.Reconstruction) -> BundleProblem:
    """`problem` with cameras, poses and points from what was made of it by `reconstruction_of`."""
    params = problem.camera_params.copy()
    for row in range(len(params)):
        theirs = reconstruction.cameras[row + 1].params
        params[row, : len(theirs)] = theirs
    return dataclasses.replace(
        problem,
        camera_params=params,
        cams_from_world=_poses_of(reconstruction, range(1, len(problem.free_poses) + 1)),
        points3D=np.array([reconstruction.points3D[k].xyz for k in range(1, len(problem.points3D) + 1)]),
    )


def _poses_of(reconstruction: pycolmap.Reconstruction, images) -> Rigid3:
    poses = [reconstruction.images[k].cam_from_world() for k in images]
    return Rigid3(
        Rotation3(np.array([p.rotation.quat for p in poses])[:, [3, 0, 1, 2]]),
        np.array([p.translation for p in poses]),
    )


# --- keeping ---


def save(problem: BundleProblem, path: Path) -> None:
    """Writes the columns as .npz."""
    poses = problem.cams_from_world
    columns = {name: getattr(problem, name) for name in ARRAYS}
    np.savez(path, allow_pickle=False, wxyz=poses.rotation.wxyz, translations=poses.translation, **columns)


def load(path: Path) -> BundleProblem:
    """What `save` wrote."""
    with np.load(path, allow_pickle=False) as columns:
        poses = Rigid3(Rotation3(columns["wxyz"]), columns["translations"])
        return BundleProblem(cams_from_world=poses, **{name: columns[name] for name in ARRAYS})


def remembered(kind: str, size: str, cache: Path | None) -> BundleProblem:
    """The synthetic problem `kind` of a size like 100x20000x10, made or taken from the folder `cache`."""
    path = None if cache is None else cache / f"{kind}-{size}-v{_VERSION}.npz"
    if path is not None and path.is_file():
        return load(path)
    problem = (street if kind == "street" else synthesize)(*map(int, size.split("x")))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(problem, path)
    return problem


def start_error_px(problem: BundleProblem) -> float:
    """Root mean square residual at the start."""
    return float(np.sqrt(np.nanmean(squared_errors(problem))))
