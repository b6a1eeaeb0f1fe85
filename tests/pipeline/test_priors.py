import dataclasses

import numpy as np
import pytest
from PIL import ExifTags, Image

from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.cameras import Camera
from sfm.core.errors import InputError
from sfm.core.geometry.geodesy import earth_from_geodetic, geodetic_from_earth, local_from_earth
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import Frame, Reconstruction, Rig, Tracks
from sfm.core.scene.transformation import transformed
from sfm.io.measurements import ControlPoints, MeasuredDirections, MeasuredDistances, MeasuredPositions
from sfm.pipeline.frame import frame_from_model
from sfm.pipeline.priors import Measurements, ModelPriors, PriorConfig, deviations, positions_of_photos, priors_of

IMAGES, POINTS = 6, 5
SURE = PriorConfig(position_sigma=0.1, distance_sigma=0.1, control_sigma=0.1)


@pytest.fixture
def model(rng):
    """Images a0.jpg, a1.jpg, … in a folder, and points 10, 11, …, in some frame."""
    return Reconstruction(
        cameras={1: Camera("PINHOLE", 100, 80, np.array([90.0, 90, 50, 40]))},
        image_ids=np.arange(1, IMAGES + 1, dtype=np.int32),
        image_names=tuple(f"photos/a{k}.jpg" for k in range(IMAGES)),
        image_camera_ids=np.ones(IMAGES, np.int32),
        cams_from_world=Rigid3.exp(rng.normal(size=(IMAGES, 6))),
        keypoint_offsets=np.zeros(IMAGES + 1, np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=rng.normal(size=(POINTS, 3)),
        point_ids=np.arange(10, 10 + POINTS),
        colors=np.zeros((POINTS, 3), np.uint8),
        errors=np.ones(POINTS),
        tracks=Tracks(np.zeros(POINTS + 1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32)),
    )


@pytest.fixture
def new_from_world(rng):
    zeta = rng.normal(size=7)
    return Sim3.exp(zeta)


def unknown(*shape):
    return np.full(shape, np.nan)


def positions(model, places, geodetic=False):
    return MeasuredPositions(model.image_names[: len(places)], places, unknown(len(places), 3), geodetic)


def directions(model, new_from_world):
    """What accelerometers would say: down is −z of the new world."""
    cams_from_new = new_from_world.transform_pose(model.cams_from_world)
    return MeasuredDirections(model.image_names, -cams_from_new.rotation.matrix[:, :, 2], unknown(len(model.image_ids)))


def labels(model):
    return tuple(str(point_id) for point_id in model.point_ids)


def moved(model, new_from_world):
    return new_from_world @ model.cams_from_world.center


def test_measurements_become_priors_of_the_rows_of_their_names(model):
    names = ("a3.jpg", "photos/a1.jpg", "b.jpg")
    places = np.arange(9.0).reshape(3, 3)
    sigmas = np.array([[1.0, 2.0, np.nan], [np.nan] * 3, [1.0] * 3])
    measured = Measurements(
        positions=MeasuredPositions(names, places, sigmas),
        directions=MeasuredDirections(names, np.eye(3), np.array([2.0, np.nan, 1.0])),
        distances=MeasuredDistances((("a0.jpg", "a2.jpg"), ("b.jpg", "a1.jpg")), np.ones(2), np.array([np.nan, 1.0])),
        control_points=ControlPoints(("12", "99"), np.array([[1.0, 2.0, np.nan]] * 2), unknown(2, 3)),
    )
    found = priors_of(model, measured, dataclasses.replace(SURE, position_bias=3.0))
    place, gravity, distance = found.of_poses
    assert isinstance(place, PositionPrior)
    assert place.images.tolist() == [1, 3] or place.images.tolist() == [3, 1]
    order = np.argsort(place.images)
    np.testing.assert_array_equal(place.positions[order], places[[1, 0]])
    np.testing.assert_allclose(np.einsum("kaa->ka", place.covariances)[order], [[0.01] * 3, [1.0, 4.0, 0.01]])
    assert place.bias_sigma == 3.0
    assert isinstance(gravity, GravityPrior)
    np.testing.assert_allclose(np.rad2deg(gravity.sigmas_rad[np.argsort(gravity.images)]), [1.0, 2.0])
    assert isinstance(distance, DistancePrior)
    assert (distance.first.tolist(), distance.second.tolist(), distance.sigmas.tolist()) == ([0], [2], [0.1])
    (control,) = found.of_points
    assert isinstance(control, PointPrior)
    assert control.points.tolist() == [2]
    assert np.isinf(control.covariances[0, 2, 2])
    assert (found.kinds, found.not_in_model) == (("positions", "gravity", "distances"), 4)
    assert found.origin is None


def test_places_on_the_earth_become_east_north_and_up(model):
    origin = np.array([48.2, 16.37, 170.0])
    local = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 5], [-100, -100, -5]])
    on_earth = local_from_earth(origin).inverse() @ local
    places = geodetic_from_earth(on_earth)
    found = priors_of(model, Measurements(positions=positions(model, places, True)), SURE)
    (prior,) = found.of_poses
    assert isinstance(prior, PositionPrior)
    np.testing.assert_allclose(prior.positions - prior.positions[0], local - local[0], atol=2e-3)
    assert found.origin is not None
    np.testing.assert_allclose(
        local_from_earth(found.origin).inverse() @ prior.positions, earth_from_geodetic(places), atol=1e-6
    )
    places[1, 2] = np.nan
    found = priors_of(model, Measurements(positions=positions(model, places, True)), SURE)
    (prior,) = found.of_poses
    assert isinstance(prior, PositionPrior)
    assert np.isinf(prior.covariances[1, 2, 2])
    assert np.isfinite(prior.positions[1, :2]).all()


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"positions": MeasuredPositions(("photos/b0.jpg",), np.zeros((1, 3)), np.ones((1, 3)))}, "did you mean"),
        ({"positions": MeasuredPositions(("a0.jpg",), np.zeros((1, 3)), unknown(1, 3))}, "--position-sigma"),
        ({"directions": MeasuredDirections(("x",), np.eye(3)[:1], np.ones(1))}, "no direction is of an image"),
        ({"distances": MeasuredDistances((("a0.jpg", "x"),), np.ones(1), np.ones(1))}, "between two images"),
        ({"control_points": ControlPoints(("1",), np.zeros((1, 3)), np.ones((1, 3)))}, "no control point"),
    ],
)
def test_measurements_of_another_scene_or_without_certainty_are_refused(model, measured, words):
    with pytest.raises(InputError) as caught:
        priors_of(model, Measurements(**measured))
    assert words in str(caught.value)


def test_positions_bring_the_model_into_their_frame(model, new_from_world, rng):
    places = moved(model, new_from_world)
    places[2] += 100.0  # an outlier
    priors = priors_of(model, Measurements(positions=positions(model, places)), SURE)
    found = frame_from_model(model, priors, rng=rng)
    np.testing.assert_allclose(found.matrix, new_from_world.matrix, atol=1e-9)


def test_directions_make_the_z_axis_and_distances_the_unit(model, new_from_world, rng):
    centers = moved(model, new_from_world)
    measured = Measurements(
        directions=directions(model, new_from_world),
        distances=MeasuredDistances(
            ((model.image_names[0], model.image_names[1]),),
            np.linalg.norm(centers[:1] - centers[1:2], axis=1),
            np.ones(1),
        ),
    )
    found = frame_from_model(model, priors_of(model, measured), rng=rng)
    assert found.scale == pytest.approx(new_from_world.scale)
    np.testing.assert_allclose((found.rotation @ new_from_world.rotation.inverse()).matrix[:, 2], [0, 0, 1], atol=1e-9)


def test_positions_on_a_line_fix_all_but_the_roll(model, new_from_world, rng):
    line = np.arange(IMAGES)[:, None] * np.array([1.0, 2.0, -0.5]) + 3
    rotation = model.cams_from_world.rotation
    model = dataclasses.replace(model, cams_from_world=Rigid3(rotation, -(rotation @ line)))
    priors = priors_of(model, Measurements(positions=positions(model, moved(model, new_from_world))), SURE)
    found = frame_from_model(model, priors, rng=rng)
    np.testing.assert_allclose(found @ line, new_from_world @ line, atol=1e-9)


def test_positions_without_heights_fix_an_upright_model(model, new_from_world, rng):
    """All but its height, of which nothing is known."""
    places = moved(model, new_from_world)
    places[1:, 2] = np.nan
    measured = Measurements(positions=positions(model, places), directions=directions(model, new_from_world))
    found = frame_from_model(model, priors_of(model, measured, SURE), rng=rng)
    np.testing.assert_allclose((found @ model.points3D)[:, :2], (new_from_world @ model.points3D)[:, :2], atol=1e-9)
    assert found.scale == pytest.approx(new_from_world.scale)


def test_the_positions_that_have_heights_are_enough(model, new_from_world, rng):
    places = moved(model, new_from_world)
    places[3:, 2] = np.nan
    priors = priors_of(model, Measurements(positions=positions(model, places)), SURE)
    np.testing.assert_allclose(frame_from_model(model, priors, rng=rng).matrix, new_from_world.matrix, atol=1e-9)


def test_one_position_moves_the_model(model, rng):
    priors = priors_of(model, Measurements(positions=positions(model, np.ones((1, 3)))), SURE)
    found = frame_from_model(model, priors, rng=rng)
    np.testing.assert_allclose(found @ model.cams_from_world.center[:1], np.ones((1, 3)), atol=1e-12)
    assert found.scale == 1.0


def test_control_points_count_like_positions(model, new_from_world, rng):
    control = ControlPoints(labels(model)[:4], new_from_world @ model.points3D[:4], unknown(4, 3))
    found = frame_from_model(model, priors_of(model, Measurements(control_points=control), SURE), rng=rng)
    np.testing.assert_allclose(found.matrix, new_from_world.matrix, atol=1e-9)


def test_positions_of_another_scene_are_refused(model, rng):
    priors = priors_of(model, Measurements(positions=positions(model, 1e3 * rng.normal(size=(IMAGES, 3)))), SURE)
    with pytest.raises(InputError, match="contradict the model"):
        frame_from_model(model, priors, rng=rng)
    everywhere = MeasuredDirections(model.image_names[:2], np.array([[0, 0, 1.0], [0, 0, -1.0]]), unknown(2))
    turned = np.stack([model.cams_from_world.rotation.matrix[0]] * IMAGES)
    model = dataclasses.replace(
        model, cams_from_world=Rigid3.from_matrix(np.concatenate([turned, np.zeros((IMAGES, 3, 1))], 2))
    )
    with pytest.raises(InputError, match="point everywhere"):
        frame_from_model(model, priors_of(model, Measurements(directions=everywhere)), rng=rng)


def test_without_measurements_the_frame_stays(model, rng):
    found = frame_from_model(model, ModelPriors((), (), (), None, 0), rng=rng)
    np.testing.assert_array_equal(found.matrix, Sim3.identity().matrix)


def test_deviations_are_counted_in_standard_deviations(model):
    centers = model.cams_from_world.center
    off = np.zeros((IMAGES, 3))
    off[0, 0] = 1.0
    measured = Measurements(
        positions=positions(model, centers + off - 0.5),
        control_points=ControlPoints(labels(model), model.points3D, unknown(POINTS, 3)),
    )
    priors = priors_of(model, measured, dataclasses.replace(SURE, position_bias=1.0))
    told = deviations(priors, model, np.full((1, 3), 0.5))
    assert told["positions"]["count"] == IMAGES
    assert told["positions"]["unlikely"] == 1
    assert told["positions"]["rms_sigmas"] == pytest.approx(10 / np.sqrt(3 * IMAGES))
    assert told["positions"]["bias"] == [0.5, 0.5, 0.5]
    assert told["control points"]["rms_sigmas"] == 0.0


def test_photos_say_where_they_were_taken(tmp_path):
    places = {"a.jpg": (48.5, 16.25, 170.0), "b.jpg": (-33.5, 151.0, None), "c.jpg": None}
    for name, place in places.items():
        exif = Image.Exif()
        if place is not None:
            angles = {1: "S" if place[0] < 0 else "N", 2: (abs(place[0]), 0.0, 0.0), 3: "E", 4: (place[1], 0.0, 0.0)}
            exif.get_ifd(ExifTags.IFD.GPSInfo).update(angles if place[2] is None else angles | {5: b"\0", 6: place[2]})
        Image.new("RGB", (8, 8)).save(tmp_path / name, exif=exif)
    found = positions_of_photos(tmp_path, [*places, "missing.jpg"])
    assert found.names == ("a.jpg", "b.jpg")
    assert found.geodetic
    np.testing.assert_allclose(found.places, [[48.5, 16.25, 170.0], [-33.5, 151.0, np.nan]])


def test_photos_without_a_place_are_told(tmp_path):
    with pytest.raises(InputError, match="says where it was taken"):
        positions_of_photos(tmp_path, ["a.jpg"])


def test_a_similarity_moves_rigs_with_their_images(model, new_from_world):
    sensor, rig_from_world = Rigid3.exp(np.arange(6.0) / 10), model.cams_from_world[0]
    both = Rigid3.stack(
        [rig_from_world, sensor @ rig_from_world, *(model.cams_from_world[k] for k in range(2, IMAGES))]
    )
    model = dataclasses.replace(
        model,
        cams_from_world=both,
        rigs=(Rig(1, 1, {2: sensor, 3: None}),),
        frames=(Frame(1, 1, rig_from_world, {1: 1, 2: 2}),),
    )
    there = transformed(model, new_from_world)
    moved_sensor = there.rigs[0].sensors_from_rig[2]
    assert moved_sensor is not None
    np.testing.assert_allclose(
        (moved_sensor @ there.frames[0].rig_from_world).matrix, there.cams_from_world[1].matrix, atol=1e-12
    )
    in_camera = [m.cams_from_world[1] @ m.points3D for m in (model, there)]
    np.testing.assert_allclose(in_camera[1], new_from_world.scale * in_camera[0], atol=1e-12)
    assert there.rigs[0].sensors_from_rig[3] is None


@pytest.mark.parametrize("changes", [{"position_sigma": 0.0}, {"loss_scale": float("inf")}, {"position_bias": -1.0}])
def test_impossible_certainties_are_refused(changes):
    with pytest.raises(ValueError, match="positive"):
        PriorConfig(**changes)
