"""Text tables and Parquet tables become columns of numbers."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_tables import read_parquet_table, read_text_table

pytestmark = pytest.mark.simulation


def table(tmp_path, text, columns=()):
    path = tmp_path / "run.txt"
    path.write_text(text)
    found = read_text_table(path, columns)
    return {name: np.asarray(values).tolist() for name, values in found.items()}


@pytest.mark.parametrize(
    ("text", "columns", "found"),
    [
        ("a,b\n1,2\n3,4\n", (), {"a": [1, 3], "b": [2, 4]}),
        ("a;b\n1,5;2\n3;4,25\n", (), {"a": [1.5, 3], "b": [2, 4.25]}),
        ("a b\n1,5 2,0\n3,0 4,25\n", (), {"a": [1.5, 3], "b": [2, 4.25]}),
        ("a|b\n1|2\n", (), {"a": [1], "b": [2]}),
        ("a\tb\n1\t2\n", (), {"a": [1], "b": [2]}),
        ("# x y\n# t q\n1 2\n# in between\n3 4\n", (), {"t": [1, 3], "q": [2, 4]}),
        ("# a robot\n1 2 3\n3 4 5\n", (), {"array": [[1, 2, 3], [3, 4, 5]]}),
        ("1 2\n3 4\n", ("x", "y"), {"x": [1, 3], "y": [2, 4]}),
        ("% comment\n// another\na,b\n1,2\n", (), {"a": [1], "b": [2]}),
        ("a,a,a\n1,2,3\n", (), {"a": [1], "a (2)": [2], "a (3)": [3]}),
        ('"the time", b\n1, 2\n', (), {"the time": [1], "b": [2]}),
        ("a,b,\n1,2,\n3,4,\n", (), {"a": [1, 3], "b": [2, 4]}),
        ("a,b,\n1,2\n3,4,\n", (), {"a": [1, 3], "b": [2, 4]}),
        # Rows are numbered from 0 or 1, without a name or as pandas names them.
        (",a\n0,5\n1,6\n", (), {"a": [5, 6]}),
        ("a\n1,5\n2,6\n3,7\n", (), {"a": [5, 6, 7]}),
        ("index,a\n0,5\n1,6\n", (), {"a": [5, 6]}),
        ("index,a\n2,5\n3,6\n", (), {"index": [2, 3], "a": [5, 6]}),
        ("index,a\n0,5\n2,6\n", (), {"index": [0, 2], "a": [5, 6]}),
        ("index\n0\n1\n", (), {"index": [0, 1]}),
        ("a,word\n1,x\n2,y\n", (), {"a": [1, 2]}),
        (" \n;;\na;b\n\n1;2\n", (), {"a": [1], "b": [2]}),
        ("1\n", (), {"array": [[1]]}),
        ("a b\n-1e-3 2E2\n", (), {"a": [-1e-3], "b": [200]}),
        # pandas numbers columns that have no names.
        ("0,1,2,3\n5,6,7,8\n", (), {"array": [[5, 6, 7, 8]]}),
        (",0,1,2\n0,5,6,7\n1,8,9,1\n", (), {"array": [[5, 6, 7], [8, 9, 1]]}),
        ("0,1\n5,6\n", (), {"array": [[0, 1], [5, 6]]}),
        ("0,1,2,3\n5,6,7,8\n", ("a", "b", "c", "d"), {"a": [5], "b": [6], "c": [7], "d": [8]}),
        # A row of units.
        ("t,a\ns,deg\n1,2\n3,4\n", (), {"t [s]": [1, 3], "a [deg]": [2, 4]}),
        # Times of day.
        ("t,a\n00:01:02,1\n12:00:00,2\n", (), {"t": [62, 43200], "a": [1, 2]}),
        ("t,a\n00:00:01.5,1\n00:01:00.25,2\n", (), {"t": [1.5, 60.25], "a": [1, 2]}),
    ],
)
def test_text_becomes_columns_of_numbers(tmp_path, text, columns, found):
    assert table(tmp_path, text, columns) == found


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("a,b\n1,\n3,4\n", ()),
        ("a,b\n1,2\n3,\n", ()),
        (",a,b\n0,1,\n1,3,4\n", ()),
        ("a,b\n0,1,\n1,3,4\n", ()),
        ("1,\n3,4\n", ("a", "b")),
        ("# a,b\n1,\n3,4\n", ()),
    ],
)
def test_a_last_number_may_be_missing_in_any_row(tmp_path, text, columns):
    found = table(tmp_path, text, columns)
    assert list(found) == ["a", "b"]
    assert found["a"][0] == 1
    assert np.isnan(found["b"]).any()


def test_a_missing_number_is_nan(tmp_path):
    found = table(tmp_path, "b,a\n,1\nN/A,2\n4,3\n")
    np.testing.assert_array_equal(found["b"], [np.nan, np.nan, 4])
    assert found["a"] == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("", (), "is empty"),
        ("# only a comment\n", (), "is empty"),
        ("a,b\n", (), "holds a header and no numbers"),
        ("1,2\n", ("a", "b", "c"), "3 column names for 2 columns"),
        ("a,b\n1,2\n3\n", (), "line 3 does not hold 2 numbers separated by ','"),
        ("a,b\n\n1,2\n\n3,4,5\n", (), "line 5 does not hold 2 numbers separated by ','"),
        ("a,b\n1,2\n3,x\n", (), "line 3 does not hold 2 numbers separated by ',': 'x'"),
        ("a;b\n1,5;2\n1.5;2\n", (), "mixes decimal points and decimal commas"),
        ("word\nx\ny\n", (), "holds no column of numbers"),
        (",a\n7,1\n9,2\n", (), "holds a column without a name"),
        ("0,1,2,3\n", (), "holds a header and no numbers"),
        ("[INFO] t=0 q=[1, 2, 3]\n[INFO] t=1 q=[1, 2, 3]\n", (), "has text and no header"),
    ],
)
def test_tables_that_are_damaged_name_the_line(tmp_path, text, columns, message):
    with pytest.raises(DatasetError, match=message):
        table(tmp_path, text, columns)


def test_other_encodings_are_named_with_the_byte(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes("a,ü\n1,2\n".encode("latin-1"))
    with pytest.raises(DatasetError, match=r"not encoded in UTF-8 \(.* at byte 2\)"):
        read_text_table(path)


def test_columns_of_parquet(tmp_path):
    path = tmp_path / "run.parquet"
    stamps = pa.array([1_500_000, 2_000_000], pa.timestamp("us"))
    columns = {
        "t": stamps,
        "q": pa.array([[1.0, 2.0], [3.0, 4.0]]),
        "n": pa.array([3, 4], pa.int8()),
        "image": pa.array([{"bytes": b"ab", "path": "x"}, {"bytes": b"cd", "path": "y"}]),
        "large": pa.array([b"e", b"f"], pa.large_binary()),
        "texts": pa.array([["a"], ["b"]]),
        "__index_level_0__": pa.array([0, 1]),
    }
    pq.write_table(pa.table(columns), path)
    found = read_parquet_table(path)
    assert {*found} == {"t", "q", "n", "image", "large"}
    np.testing.assert_allclose(found["t"], [1.5, 2.0])
    np.testing.assert_array_equal(found["q"], [[1, 2], [3, 4]])
    assert found["n"].dtype == float
    assert found["image"].tolist() == [b"ab", b"cd"]
    ragged = pa.table({"q": pa.array([[1.0, 2.0], [3.0], None])})
    pq.write_table(ragged, path)
    with pytest.raises(DatasetError, match="holds vectors of 0 to 2 components: all must be"):
        read_parquet_table(path)
    path.write_bytes(b"PAR1")
    with pytest.raises(DatasetError, match="cannot be read as Parquet"):
        read_parquet_table(path)


@pytest.mark.parametrize("name", [" Index ", "unnamed: 0", " "])
def test_blanks_around_the_name_of_an_index_do_not_matter(tmp_path, name):
    path = tmp_path / "run.parquet"
    for counts, kept in (([0, 1], ["q"]), ([7, 9], [name, "q"])):
        pq.write_table(pa.table({name: counts, "q": [3.0, 4.0]}), path)
        if name.strip() or kept == ["q"]:
            assert [*read_parquet_table(path)] == kept
        else:
            with pytest.raises(DatasetError, match="holds a column without a name"):
                read_parquet_table(path)
