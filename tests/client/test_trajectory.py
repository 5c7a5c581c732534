"""A trajectory from a file: what lies between its rows, and what is wrong about a file, by line and column."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate_client import ConfigurationError
from palpate_client.trajectory import Trajectory, read_trajectory

HEADER = "t_s,x_m,y_m,z_m\n"


def read(tmp_path: Path, text: str) -> Trajectory:
    file = tmp_path / "path.csv"
    file.write_text(text)
    return read_trajectory(file)


def test_between_two_rows_the_tip_moves_on_a_straight_line(tmp_path: Path) -> None:
    trajectory = read(tmp_path, HEADER + "0,0,0,0\n1,0.1,0,0\n3,0.1,-0.2,0.4\n")
    assert trajectory.duration_s == 3
    for t, position, velocity in (
        (0.0, (0, 0, 0), (0.1, 0, 0)),
        (0.25, (0.025, 0, 0), (0.1, 0, 0)),
        (1.0, (0.1, 0, 0), (0, -0.1, 0.2)),
        (2.0, (0.1, -0.1, 0.2), (0, -0.1, 0.2)),
        (3.0, (0.1, -0.2, 0.4), (0, 0, 0)),
        (9.0, (0.1, -0.2, 0.4), (0, 0, 0)),
    ):
        at = trajectory.at(t)
        assert at[0] == pytest.approx(position)
        assert at[1] == pytest.approx(velocity)


def test_columns_stand_in_any_order_and_others_are_ignored(tmp_path: Path) -> None:
    text = "\ufeffz_m, t_s ,note,y_m,x_m\r\n3,0,start,2,1\r\n\r\n6,1,,5,4\r\n"
    trajectory = read(tmp_path, text)
    assert list(trajectory.positions_m) == [(1, 2, 3), (4, 5, 6)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: expected one column t_s, one x_m, one y_m, one z_m"),
        ("t_s,x_m,y_m\n", "line 1: expected one column z_m"),
        ("t_s,x_m,y_m,z_m,x_m\n", "line 1: expected one column x_m"),
        (HEADER, "0 rows of numbers, expected two at least"),
        (HEADER + "0,0,0,0\n", "1 rows of numbers"),
        (HEADER + "0,0,0,0\n1,0,0\n", "line 3: 3 fields, expected 4"),
        (HEADER + "0,0,0,0\n1,0,nan,0\n", "line 3, y_m: 'nan', expected a finite number"),
        (HEADER + '0,0,0,0\n1,0,0,"0,5"\n', "line 3, z_m: '0,5', expected a finite number"),
        (HEADER + "0.5,0,0,0\n1,0,0,0\n", "line 2, t_s: 0.5, expected 0 in the first row"),
        (HEADER + "0,0,0,0\n1,0,0,0\n1,0,0,0\n", "line 4, t_s: 1, expected more than 1"),
    ],
)
def test_a_bad_file_is_refused_with_line_and_column(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path}/path.csv: ")
    assert says in str(caught.value)


def test_a_file_that_is_not_there_or_no_text_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        read_trajectory(tmp_path / "none.csv")
    (tmp_path / "path.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match=r"path\.csv"):
        read_trajectory(tmp_path / "path.csv")
