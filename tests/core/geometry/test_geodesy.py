import numpy as np
import pytest

from sfm.core.geometry.geodesy import earth_from_geodetic, geodetic_from_earth, local_from_earth


def test_known_places_on_the_axes():
    places = np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 100.0], [90.0, 0.0, 0.0], [-90.0, 0.0, -10.0]])
    expected = [[6378137.0, 0, 0], [0, 6378237.0, 0], [0, 0, 6356752.314245], [0, 0, -6356742.314245]]
    np.testing.assert_allclose(earth_from_geodetic(places), expected, atol=1e-6)


def test_geodetic_coordinates_survive_the_way_there_and_back(rng):
    places = np.stack([rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500), rng.uniform(-1e4, 1e6, 500)], 1)
    places[:2, 0] = 90.0, -90.0
    back = geodetic_from_earth(earth_from_geodetic(places))
    np.testing.assert_allclose(back[:, 0], places[:, 0], atol=1e-8)
    np.testing.assert_allclose(back[2:, 1], places[2:, 1], atol=1e-8)
    np.testing.assert_allclose(back[:, 2], places[:, 2], atol=1e-6)


@pytest.mark.parametrize("latitude", [-80.0, -1.0, 0.0, 48.2, 89.0])
def test_the_local_frame_has_east_north_and_up(latitude):
    place = np.array([latitude, 16.4, 170.0])
    local = local_from_earth(place)
    np.testing.assert_allclose(local @ earth_from_geodetic(place), 0, atol=1e-8)
    step = 1e-6
    for axis, change in enumerate(([0, step, 0], [step, 0, 0], [0, 0, step])):
        moved = local @ earth_from_geodetic(place + change)
        assert moved[axis] == pytest.approx(np.linalg.norm(moved), rel=1e-3)


def test_a_metre_is_a_metre(rng):
    """A degree of latitude is a little less than 111.2 km in Vienna."""
    places = np.array([[48.0, 16.0, 0.0], [48.001, 16.0, 0.0]])
    local = local_from_earth(places[0])[None] @ earth_from_geodetic(places)
    assert local[1, 1] == pytest.approx(111.2, abs=0.05)
    assert abs(local[1, 0]) < 1e-6


def test_places_that_do_not_exist_are_refused():
    for place in ([91.0, 0.0, 0.0], [np.nan, 0.0, 0.0]):
        with pytest.raises(ValueError, match="latitude"):
            local_from_earth(np.array(place))
