"""Files that do not match their schema are refused in one line with file, field and remedy."""

import errno
import json
import math
import os
import resource
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from hrc_learn.store import (
    MANIFEST,
    Count,
    Metres,
    Radians,
    changed_files,
    json_text,
    new_file,
    new_folder,
    parse_json,
    read_json,
    read_made_by,
    read_toml,
    replacing,
    require_unchanged,
    write_json,
)
from hrc_learn.store._folder import RESULTS


@dataclass(frozen=True, kw_only=True)
class Offset:
    version: Literal[1] = 1
    offset_m: tuple[Metres, Metres, Metres]
    angle_rad: Radians
    trials: Count = 0
    error_px: float | None = None


OFFSET = Offset(offset_m=(0.1, -0.2, 0.3), angle_rad=1.5, trials=3)
SOUND = {"version": 1, "offset_m": [0.1, -0.2, 0.3], "angle_rad": 1.5, "trials": 3}


def test_what_was_written_is_read(tmp_path):
    write_json(tmp_path / "new" / "offset.json", OFFSET)
    assert read_json(tmp_path / "new" / "offset.json", Offset) == OFFSET


def test_fields_of_later_versions_are_ignored(tmp_path):
    write_json(tmp_path / "offset.json", SOUND | {"colour": "blue"})
    assert read_json(tmp_path / "offset.json", Offset) == OFFSET


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"angle_rad": None}, "angle_rad: expected float, got null"),
        ({"angle_rad": True}, "angle_rad: expected float, got bool"),
        ({"angle_rad": "1.5"}, "angle_rad: expected float, got str"),
        ({"angle_rad": []}, "angle_rad: expected float, got array"),
        ({"angle_rad": 3e9}, "angle_rad: expected float <= 1000.0"),
        ({"angle_rad": math.nan}, "not valid JSON"),
        ({"angle_rad": -math.inf}, "not valid JSON"),
        ({"offset_m": [0, 0]}, "offset_m: expected array of length 3"),
        ({"offset_m": [0, 0, None]}, r"offset_m\[2\]: expected float, got null"),
        ({"version": 2}, "version: unknown value 2"),
        ({"trials": 2.5}, "trials: expected int, got float"),
        ({"trials": True}, "trials: expected int, got bool"),
        ({"trials": -1}, "trials: expected int >= 0"),
        ({"trials": 10**30}, "trials"),
    ],
)
def test_a_wrong_value_is_named(tmp_path, fields, complaint):
    path = tmp_path / "offset.json"
    path.write_text(json.dumps(SOUND | fields))
    with pytest.raises(ValueError, match=rf"offset\.json: {complaint}.*; fit it again$"):
        read_json(path, Offset, "fit it again")


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", "3e9", '{"version": 1}', "\0", "\ufeff{}"),
        '{"offset_m": [0, 0, 0], "angle_rad": 1e999}',
        '{"offset_m": [0, 0, 0], "angle_rad": 0, "more": ' + "[" * 100_000,
        "[" * 100_000,
        '{"a":' * 100_000,
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, text):
    path = tmp_path / "offset.json"
    path.write_text(text)
    for schema in (Offset, list) if text[:1] == "[" and len(text) > 2 else (Offset,):
        with pytest.raises(ValueError, match=r"^[^\n]*offset\.json[^\n]*; restore it$"):
            read_json(path, schema)


@pytest.mark.parametrize(("read", "suffix"), [(read_json, "json"), (read_toml, "toml")])
def test_text_in_another_encoding_is_called_so(tmp_path, read, suffix):
    file = tmp_path / f"offset.{suffix}"
    file.write_bytes('{"name": "Ärmel"}'.encode("latin-1"))
    with pytest.raises(ValueError, match=rf"offset\.{suffix}: not text in UTF-8"):
        read(file)


@pytest.mark.parametrize(("read", "text"), [(read_json, '{"a": "Ä"}'), (read_toml, 'a = "Ä"')])
def test_a_byte_order_mark_is_no_content(tmp_path, read, text):
    (tmp_path / "file").write_text(text, encoding="utf-8-sig")
    assert read(tmp_path / "file") == {"a": "Ä"}


def test_only_files_of_a_sensible_size_are_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*none\.json"):
        read_json(tmp_path / "none.json")
    with pytest.raises(ValueError, match="is not a file"):
        read_json(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is not a file"):
        read_json(tmp_path / "pipe")
    with (tmp_path / "large.json").open("wb") as file:
        file.truncate(64 * 2**20)
    with pytest.raises(ValueError, match="not valid JSON"):
        read_json(tmp_path / "large.json")
    for size in (64 * 2**20 + 1, 2**40):
        os.truncate(tmp_path / "large.json", size)
        with pytest.raises(ValueError, match="larger than 64 MiB"):
            read_json(tmp_path / "large.json")


def test_a_message_is_parsed_with_its_origin():
    assert parse_json(b'{"angle_rad": 1, "offset_m": [0, 0, 0]}', Offset).angle_rad == 1
    with pytest.raises(ValueError, match=r"^decision: trials: expected int, got bool$"):
        parse_json(json.dumps(SOUND | {"trials": True}), Offset, "decision")


def test_toml_is_read_with_the_same_care(tmp_path):
    path = tmp_path / "offset.toml"
    path.write_text("offset_m = [1, 2, 3]\nangle_rad = 0.5\n")
    assert read_toml(path, Offset).offset_m == (1, 2, 3)
    for text, complaint in (
        ("offset_m = [1, 2]\nangle_rad = 0.5", "offset_m: expected array of length 3"),
        ("offset_m = [1, 2, 3]\nangle_rad = nan", "nan is not a finite number"),
        ("offset_m = ", "invalid value"),
        ("a = " + "[" * 100_000, "nested too deeply"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=rf"offset\.toml: {complaint}"):
            read_toml(path, Offset)


def test_values_of_libraries_are_written_as_numbers(tmp_path):
    content = {
        "mean": np.float64(0.25),
        "count": np.int64(3),
        "loss": torch.tensor(0.5),
        "row": torch.tensor([1.0, math.nan]),
        "path": Path("outputs"),
        "infinite": math.inf,
    }
    write_json(tmp_path / "values.json", content)
    assert json.loads((tmp_path / "values.json").read_text()) == {
        "mean": 0.25,
        "count": 3,
        "loss": 0.5,
        "row": [1.0, None],
        "path": "outputs",
        "infinite": None,
    }


def test_inputs_of_results_are_an_object(tmp_path):
    with new_folder(tmp_path / "run", {"seed": 3}):
        pass
    assert read_made_by(tmp_path / "run") == {"seed": 3}
    (tmp_path / "run" / "made_by.json").write_text("[3]")
    with pytest.raises(ValueError, match=r"made_by\.json: expected object, got array"):
        read_made_by(tmp_path / "run")


def test_a_changed_file_is_noticed(tmp_path):
    with new_folder(tmp_path / "run", {}) as folder:
        (folder / "data").mkdir()
        (folder / "data" / "log").write_bytes(b"1234")
    assert not changed_files(tmp_path / "run")
    (tmp_path / "run" / "notes.txt").write_text("added later")
    require_unchanged(tmp_path / "run")
    (tmp_path / "run" / "data" / "log").write_bytes(b"1235")
    assert changed_files(tmp_path / "run") == ["data/log"]
    with pytest.raises(ValueError, match="data/log has changed since it was written"):
        require_unchanged(tmp_path / "run")
    (tmp_path / "run" / "data" / "log").unlink()
    assert changed_files(tmp_path / "run") == ["data/log"]
    (tmp_path / "run" / MANIFEST).write_text("[]")
    with pytest.raises(ValueError, match=r"manifest\.json: expected object"):
        changed_files(tmp_path / "run")
    (tmp_path / "run" / MANIFEST).unlink()
    assert not changed_files(tmp_path / "run")


@pytest.fixture
def small_files():
    """Writing more than 4 KiB into one file fails, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_named_and_nothing_is_left(tmp_path, small_files):
    def write_file() -> None:
        with new_file(tmp_path / "log") as part:
            part.write_text("x" * 5000)

    def write_folder() -> None:
        with replacing(tmp_path / "log", RESULTS) as folder:
            folder.mkdir()
            (folder / "a").write_text("x" * 5000)

    for write in (write_file, write_folder):
        with pytest.raises(OSError, match=r"tmp.*log") as error:
            write()
        assert error.value.errno == errno.EFBIG
        assert error.value.filename == str(tmp_path / "log")
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("other", ["", "elsewhere.txt"])
def test_an_error_of_the_disk_names_the_file_and_not_its_temporary_place(tmp_path, other):
    path = tmp_path / "log"
    with pytest.raises(OSError, match="No space") as error, new_file(path) as part:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), other or str(part))
    assert error.value.filename == (other or str(path))


def test_json_has_many_lines_or_one():
    assert json_text({"a": [1]}) == '{\n  "a": [\n    1\n  ]\n}\n'
    assert json_text({"a": [1]}, indent=False) == '{"a":[1]}\n'


def test_a_full_device_is_named():
    with pytest.raises(OSError, match="/dev/full"):
        write_json("/dev/full", {"a": 1})
