"""Dialects of text: read as they are meant, or refused; never another answer."""

from pathlib import Path

import numpy as np
import pytest

from jaxreg.io import InputError, read_points
from jaxreg.io.points.read import read_named


POINTS = [[1.5, 2.5, 3.5], [4.5, 5.5, 6.5]]
MEANT = {
    "decimal commas": "1,5 2,5 3,5\n4,5 5,5 6,5\n",
    "decimal commas and tabs": "1,5\t2,5\t3,5\n4,5\t5,5\t6,5\n",
    "decimal commas and semicolons": "x;y;z\n1,5;2,5;3,5\n4,5;5,5;6,5\n",
    "decimal commas in quotes": '"1,5","2,5","3,5"\n"4,5","5,5","6,5"\n',
    "points in quotes": '"x","y","z"\n"1.5","2.5","3.5"\n"4.5","5.5","6.5"\n',
    "another order": "z,y,x\n3.5,2.5,1.5\n6.5,5.5,4.5\n",
    "behind an id and an intensity": "id,intensity,x,y,z\n1,9,1.5,2.5,3.5\n"
    "2,9,4.5,5.5,6.5\n",
    "names with units": "Label;X [m];Y [m];Z [m]\n7;1,5;2,5;3,5\n8;4,5;5,5;6,5\n",
    "names of ParaView": "Points:0,Points:1,Points:2\n1.5,2.5,3.5\n4.5,5.5,6.5\n",
    "names in a comment": "#id x y z\n1 1.5 2.5 3.5\n2 4.5 5.5 6.5\n",
    "names with words around": "t pos_z pos_x pos_y\n0 3.5 1.5 2.5\n1 6.5 4.5 5.5\n",
    "names before colours without": "x y z\n1.5 2.5 3.5 9 9 9\n4.5 5.5 6.5 9 9 9\n",
    "a comment on axes": "# y and x are swapped in z\n1.5 2.5 3.5\n4.5 5.5 6.5\n",
    "a height": "height,x,y\n3.5,1.5,2.5\n6.5,4.5,5.5\n",
    "a count": "2\n1.5 2.5 3.5 9\n4.5 5.5 6.5 9\n",
    "an empty cell in the first row": "1.5,2.5,3.5,,a\n4.5,5.5,6.5,7,b\n",
    "labels of many words": "1.5 2.5 3.5 old oak\n4.5 5.5 6.5 oak\n",
    "old line ends": "1.5 2.5 3.5\r4.5 5.5 6.5\r",
}


@pytest.mark.parametrize("kind", list(MEANT))
def test_what_is_meant_is_read(tmp_path: Path, kind: str):
    path = tmp_path / "a.txt"
    path.write_bytes(MEANT[kind].encode())
    np.testing.assert_array_equal(read_points(path), POINTS)


@pytest.mark.parametrize(
    ("colors", "fields"),
    [
        ("9 120 255", ("x", "y", "z", "red", "green", "blue")),
        ("0 0 1", ()),  # normals as likely
        ("9 120 256", ()),
        ("0.5 0.2 1", ()),
        ("9 120 255 3", ()),
    ],
)
def test_colours_without_names_are_known_by_their_values(
    tmp_path: Path, colors: str, fields: tuple[str, ...]
):
    path = tmp_path / "a.xyz"
    path.write_text(f"1.5 2.5 3.5 {colors}\n4.5 5.5 6.5 {colors}\n")
    found = read_named(path)["a"]
    assert found.fields == fields
    np.testing.assert_array_equal(found.points, POINTS)


def test_utf_16_is_text(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_bytes("x,y,z\r\n1.5,2.5,3.5\r\n4.5,5.5,6.5\r\n".encode("utf-16"))
    np.testing.assert_array_equal(read_points(path), POINTS)


def test_the_names_of_two_coordinates_make_it_2d(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_text("x,y,intensity\n1,2,9\n3,4,9\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2], [3, 4]])


EYE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
REFUSED = {
    "commas of two kinds": ("1,50,2,05,3,00\n4,50,5,05,6,00\n", "separate .* decimal"),
    "three digits behind commas": ("1,500,2,500,3,250\n" * 3, "decimal points"),
    "thousands": ("1.234,5;2,0;3,0\n", "line 1: '1.234.5' is no number"),
    "exponents of Fortran": ("1.5D+03 2.5 3.5\n" * 2, "line 1: '1.5D"),
    "underscores": ("1 2 3\n1 2_0 3\n", "line 2"),
    "a NUL": ("1 2\0\0\n1 2 3\n4 5 6\n", "line 1: .*NUL"),
    "a short first row": ("1 2\n1 2 3\n4 5 6\n", "line 1: holds fewer"),
    "a word in the first row": ("1 two 3\n1 2 3\n4 5 6\n", "line 1: holds fewer"),
    "a short row with colours": ("1 2 3 9 9 9\n1 2 9 9 9\n", "line 2: wanted 6"),
    "a row too long": ("1 2 3\n1 2 3 4\n", "line 1: holds fewer"),
    "fewer than said": ("3\n1 2 3\n4 5 6\n", "3 points, but holds 2"),
    "more than said": ("1\n1 2 3\n4 5 6\n", "1 points, but holds 2"),
    "names of other things": ("id,a,b,c\n1,2,3,4\n", "none x and y"),
    "names and columns differ": ("z y x\n1 2 3 4\n", "4 columns, but names 3"),
    "a name too many": ("x,y,z\n1,2\n4,5\n", "2 columns, but names 3"),
    "a name too few": ("X,Y\n1,2,3\n4,5,6\n", "3 columns, but names 2"),
    "an open quotation": ('"1,2,3\n4,5,6\n', "line 1: a quotation mark"),
    "a coordinate of words": ("x,y,z,d\n1,2,a,4\n", "'z' holds no numbers"),
    "a log": (f"0 1 5\n{EYE}0 2 5\n{EYE}", "read_log"),
    "a matrix": (EYE, "4 x 4"),
    "information": ("0 1 5\n" + "1 0 0 0 0 0\n" * 6, "read_info"),
    "a graph": ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 1 0\n", "read_g2o"),
    "a graph of edges": ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "read_g2o"),
    "poses of KITTI": ("1 0 0 5 0 1 0 6 0 0 1 7\n" * 3, "read_kitti"),
    "poses of TUM": ("0 1 2 3 0 0 0 1\n1 2 3 4 0 0 1 0\n", "read_tum"),
    "an OBJ": ("v 1 2 3\nv 4 5 6\nv 7 8 9\nf 1 2 3\n", r"\.obj"),
}


@pytest.mark.parametrize("kind", list(REFUSED))
def test_what_may_be_wrong_is_refused(tmp_path: Path, kind: str):
    content, said = REFUSED[kind]
    path = tmp_path / "a.txt"
    path.write_text(content)
    with pytest.raises(InputError, match=said) as caught:
        read_points(path)
    assert len(str(caught.value).splitlines()) == 2


@pytest.mark.parametrize("suffix", ["log", "info", "g2o", "graph", "conf", "tum"])
def test_files_of_poses_name_their_reader(tmp_path: Path, suffix: str):
    path = tmp_path / f"a.{suffix}"
    path.write_text(f"0 1 5\n{EYE}")
    with pytest.raises(InputError, match=r"not points\.\nIt is read by: "):
        read_points(path)
