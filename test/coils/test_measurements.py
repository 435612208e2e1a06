"""Probe measurements from a CSV file."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.coils.calibration import read_measurements
from magnetosuture_thread.settings.errors import InvalidInputError

HEADER = "coil,current,x,y,bx,by\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "probe.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_may_stand_in_any_order_and_comments_are_passed_over(tmp_path: Path):
    text = "# by hand\nbx, by, coil, current, x, y\n\n1e-3, 2e-3, 1, 2.0, 0.003, 0.004\n-1e-3, 0, coil_0, -2, 0, 0\n"
    read = read_measurements(written(tmp_path, text))
    assert read.names == ("coil_0", "coil_1")
    assert read.coil.tolist() == [1, 0]
    assert read.current.tolist() == [2.0, -2.0]
    assert read.points.tolist() == [[0.003, 0.004], [0.0, 0.0]]
    assert read.field.tolist() == [[1e-3, 2e-3], [-1e-3, 0.0]]
    assert read.lines.tolist() == [4, 5]


def test_coils_with_names_have_the_order_in_which_they_come(tmp_path: Path):
    rows = "".join(f"{name},1,0,0,0,0\n" for name in ("west", "east", "west"))
    assert read_measurements(written(tmp_path, HEADER + rows)).names == ("west", "east")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADER + "0," + "1" * 140_000 + ",0,0,0,0\n", "probe.csv, line 2: got field larger than field limit"),
        ("", "probe.csv: got nothing, expected the columns coil,current,x,y,bx,by"),
        (HEADER, "a header only"),
        (HEADER + "0,1,0,0,0,0\n0,1,0,0,0\n", "line 3: got 5 values, expected 6"),
        (HEADER + "\n0,two,0,0,0,0\n", "line 3, current: got two, expected a number from -1000 to 1000 A"),
        (HEADER + "0,1,0,0,1000,0\n", "line 2, bx: got 1000, expected a number from -1 to 1 T"),
        (HEADER + "0,1,0,0,0,inf\n", "line 2, by: got inf"),
        (HEADER + "0,1,0,,0,0\n", "line 2, y: got nothing"),
        (HEADER + "0,1,0,0,0,0\n2,1,0,0,0,0\n", "coil: got nothing of coil_1"),
        (HEADER + "".join(f"c{k},1,0,0,0,0\n" for k in range(65)), "65 coils, expected at most 64"),
    ],
)
def test_what_is_no_measurement_is_refused_with_its_line(tmp_path: Path, text: str, words: str):
    path = written(tmp_path, text)
    with pytest.raises(InvalidInputError, match=words) as caught:
        read_measurements(path)
    assert str(caught.value).startswith(str(path))
