import numpy as np
import pytest

from sfm.core.errors import FormatError, InputError
from sfm.io.measurements import read_control_points, read_directions, read_distances, read_marks, read_positions


@pytest.fixture
def table(tmp_path):
    def write(text, encoding="utf-8"):
        path = tmp_path / "table.csv"
        path.write_bytes(text.encode(encoding))
        return path

    return write


def test_positions_are_read_with_and_without_sigmas(table):
    read = read_positions(table("name,x,y,z\na.jpg,1,2,3\n\n# b.jpg,0,0,0\nc d.jpg, -4.5 ,5e-1,\n"))
    assert read.names == ("a.jpg", "c d.jpg")
    np.testing.assert_array_equal(read.places, [[1, 2, 3], [-4.5, 0.5, np.nan]])
    assert np.isnan(read.sigmas).all()
    assert not read.geodetic
    read = read_positions(table("SX, sy, sz, z, y, x, name\n0.1,0.2,,3,2,1,a\n"))
    np.testing.assert_array_equal(read.places, [[1, 2, 3]])
    np.testing.assert_array_equal(read.sigmas, [[0.1, 0.2, np.nan]])


def test_geodetic_positions_may_lack_the_altitude(table):
    read = read_positions(table("name,latitude,longitude\na,48.1,-16.3\n"))
    assert read.geodetic
    np.testing.assert_array_equal(read.places, [[48.1, -16.3, np.nan]])
    assert read_positions(table("name,latitude,longitude,altitude\na,48.1,16.3,170\n")).places[0, 2] == 170


def test_names_may_hold_commas_in_quotes_and_files_a_byte_order_mark(table):
    read = read_positions(table('name,x,y,z\n"a, b.jpg",1,2,3\n', encoding="utf-8-sig"))
    assert read.names == ("a, b.jpg",)


def test_directions_are_normalised(table):
    read = read_directions(table("name,x,y,z,sigma_deg\na,0,2,0,0.5\nb,0,0,-9.81,\n"))
    np.testing.assert_array_equal(read.directions, [[0, 1, 0], [0, 0, -1]])
    np.testing.assert_array_equal(read.sigmas_deg, [0.5, np.nan])


def test_distances_and_control_points_are_read(table):
    read = read_distances(table("name1,name2,distance,sigma\na,b,2.5,0.01\na,c,0,\n"))
    assert read.names == (("a", "b"), ("a", "c"))
    np.testing.assert_array_equal(read.distances, [2.5, 0])
    points = read_control_points(table("point,x,y,z,sx,sy,sz\n12,1,2,3,1,1,1\n7,0,0,0,,,\n"))
    assert points.labels == ("12", "7")
    assert points.positions.shape == (2, 3)


def test_marks_are_read(table):
    marks = read_marks(table("point,name,x,y\nA,a.jpg,1,2\nA,b.jpg,3,4\nB,a.jpg,5,6.5\n"))
    assert marks.labels == ("A", "A", "B")
    assert marks.names == ("a.jpg", "b.jpg", "a.jpg")
    np.testing.assert_array_equal(marks.points2D, [[1, 2], [3, 4], [5, 6.5]])


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_positions, "", "is empty"),
        (read_positions, "name,x,y,z\n", "no line below"),
        (read_positions, "name,x,y\na,1,2\n", "lacks z"),
        (read_positions, "x,y,z\n1,2,3\n", "lacks name"),
        (read_positions, "a.jpg,1,2,3\n", "unknown column 'a.jpg'"),
        (read_positions, "name,x,y,z,latitude,longitude\na,1,2,3,4,5\n", "two kinds"),
        (read_positions, "name,lattitude,longitude\na,1,2\n", "did you mean 'latitude'"),
        (read_positions, "name,x,x,y,z\na,1,1,2,3\n", "a column twice"),
        (read_positions, "name,x,y,z\na,1,2,3,4\n", "line 2 has 5 values for 4 columns"),
        (read_positions, "name,x,y,z\n# c\na,1,,3\n", "line 3: y is no number: ''"),
        (read_positions, "name,x,y,z\na,1,nan,3\n", "y is no number: 'nan'"),
        (read_positions, "name,x,y,z\na,1,2,inf\n", "z is no number: 'inf'"),
        (read_positions, "name,x,y,z\na,1,2,3\nb,1,2,3\na,4,5,6\n", "lines 2 and 4 are both of 'a'"),
        (read_positions, "name,x,y,z,sx,sy,sz\na,1,2,3,0,1,1\n", "line 2: sx is '0'; a standard deviation is positive"),
        (read_positions, "name,latitude,longitude\na,91,0\n", "within 90 degrees"),
        (read_positions, 'name,x,y,z\n"a,1,2,3\nb,1,2,3\n', "line 2 has 1 values"),
        (read_directions, "name,x,y,z\na,0,0,0\n", "has a length"),
        (read_distances, "name1,name2,distance\na,a,1\n", "between two photos"),
        (read_distances, "name1,name2,distance\na,b,-1\n", "not negative"),
        (read_marks, "point,name,x,y\nA,a,1,2\nA,a,1,2\n", "line 3: point is 'A'; it is marked twice in this photo"),
        (read_control_points, "point,x,y,z\n1,1,2,3\n1,1,2,3\n", "lines 2 and 3"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(table, read, text, words):
    with pytest.raises(FormatError) as caught:
        read(table(text))
    assert words in str(caught.value)


def test_files_that_are_no_text_or_not_there_are_told(table, tmp_path):
    with pytest.raises(FormatError, match="UTF-8"):
        read_positions(table("name,x,y,z\nä,1,2,3\n", encoding="latin-1"))
    with pytest.raises(InputError):
        read_positions(tmp_path / "nothing.csv")
