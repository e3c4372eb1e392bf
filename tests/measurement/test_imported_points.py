"""Import of points: exports of trackers, arms and cameras, in units and forms of their own."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from commands import run_orthocal

from orthocal import (
    TableOptions,
    import_readings,
    load_plan,
    load_session,
    simulate_session,
    write_import,
)
from orthocal.errors import SessionError
from orthocal.measurement.files.write_session import write_session
from orthocal.units import MM

GRID = list(itertools.product((-50, 10, 40), repeat=3))
PLAN = """robot: orthoglide
controller: {{offsets_mm: [0, 0, 0]}}
gauges: {{tracker: {{sigma_mm: 0.01}}, dial: {{sigma_mm: 0.005}}}}
postures:
{postures}
setups:
  track: {{sensor: points, target_mm: [3, -4, -40], gauge: tracker}}
{more}"""
NAMES = ("p1", "p2")
DIAL = "  yx: {leg: x, direction: y, section: {fraction: 0.5}, gauge: dial, postures: [p1, p2]}\n"


def make(folder, more=""):
    """A session without readings, and points of a machine, from its simulation, (27, 3), [mm]."""
    postures = "\n".join(f"  p{i}: {{tcp_mm: {list(p)}}}" for i, p in enumerate(GRID))
    folder.mkdir(exist_ok=True)
    (folder / "plan.yaml").write_text(PLAN.format(postures=postures, more=more))
    plan = load_plan(folder / "plan.yaml")
    shown = simulate_session(plan, {"x_slide.offset": 1e-3}, seed=4).session
    write_session(plan, folder / "session", blank=True)
    of_points = np.array([r.setup.startswith("track") for r in shown.readings])
    return folder / "session", shown.values[of_points].reshape(-1, 3) / MM, shown


@pytest.fixture
def session(tmp_path):
    return make(tmp_path)[:2]


def table(file, heading, rows, *, separator=";"):
    file.write_text("\n".join(separator.join(row) for row in (heading, *rows)) + "\n")
    return file


def numbers(point, *, unit=1.0, comma=False):
    texts = [f"{v / unit:.9f}" for v in point]
    return [t.replace(".", ",") for t in texts] if comma else texts


def read_again(session, points):
    values = load_session(session).values.reshape(-1, 3) / MM
    assert values == pytest.approx(points, abs=1e-7)


def test_names_of_postures_and_decimal_commas(session, tmp_path):
    folder, points = session
    rows = [[f"P{i}", *numbers(p, comma=True), "ok"] for i, p in enumerate(points)]
    file = table(tmp_path / "t.csv", ["Point", "X [mm]", "Y [mm]", "Z [mm]", "state"], rows[::-1])
    result = import_readings(file, folder, TableOptions(columns={"posture": "Point"}))
    assert (result.filled, result.empty) == (27, 0)
    assert result.long_table.decimal.sign == "comma"
    write_import(result)
    read_again(folder, points)
    again = import_readings(file, folder, TableOptions(columns={"posture": "Point"}))
    assert (again.changes, again.unchanged) == (False, 27)


def test_commanded_points_and_inches(session, tmp_path):
    folder, points = session
    heading = [*(f"nominal {k} (mm)" for k in "xyz"), *(f"measured {k} (inch)" for k in "xyz")]
    rows = [[*map(str, c), *numbers(p, unit=25.4)] for c, p in zip(GRID, points, strict=True)]
    file = table(tmp_path / "t.csv", heading, rows, separator="\t")
    result = import_readings(file, folder)
    assert set(result.long_table.units) == {"mm", "inch"}
    write_import(result)
    read_again(folder, points)


def test_a_workbook_of_a_measuring_machine(session, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    folder, points = session
    book = openpyxl.Workbook()
    book.active.append(["Report of the measuring machine"])
    book.active.append(["posture", "X", "Y", "Z"])
    book.active.append([None, "mm", "mm", "mm"])
    for i, point in enumerate(points):
        book.active.append([f"p{i}", *point.tolist()])
    book.save(tmp_path / "t.xlsx")
    write_import(import_readings(tmp_path / "t.xlsx", folder))
    read_again(folder, points)


def test_points_and_readings_of_a_dial_in_one_table(tmp_path):
    folder, points, shown = make(tmp_path, DIAL)
    rows = [["track", f"p{i}", "", *numbers(p)] for i, p in enumerate(points)]
    dial = [v / MM for v in shown.values[-2:]]
    rows += [["yx", name, f"{v:.9f}", "", "", ""] for name, v in zip(NAMES, dial, strict=True)]
    heading = ["setup", "posture", "reading_mm", "x_mm", "y_mm", "z_mm"]
    write_import(import_readings(table(tmp_path / "t.csv", heading, rows), folder))
    assert load_session(folder).values == pytest.approx(shown.values, abs=1e-10)


def test_a_reading_beside_a_point_is_refused(tmp_path):
    """In a row of a dial, and in a row of points."""
    folder, *_ = make(tmp_path, DIAL)
    heading = ["setup", "posture", "reading_mm", "x_mm", "y_mm", "z_mm"]
    for setup, column in (("yx", "x_mm"), ("track", "reading_mm")):
        file = table(tmp_path / "t.csv", heading, [[setup, "p1", "0.12", "1.5", "2.5", "3.5"]])
        with pytest.raises(SessionError, match=f"{column} is .* expected an empty cell") as refused:
            import_readings(file, folder)
        assert refused.value.where.endswith("t.csv:2")


def test_a_part_of_the_points_and_a_changed_one(session, tmp_path):
    folder, points = session
    rows = [[f"p{i}", *numbers(p)] for i, p in enumerate(points)]
    heading = ["posture", "x_mm", "y_mm", "z_mm"]
    result = import_readings(table(tmp_path / "t.csv", heading, rows[:20]), folder)
    assert (result.filled, result.empty) == (20, 7)
    write_import(result)
    rows[3][3] = "99.5"
    file = table(tmp_path / "t.csv", heading, rows)
    with pytest.raises(SessionError, match="--replace") as refused:
        import_readings(file, folder)
    assert refused.value.where.endswith("readings.csv:5")
    result = import_readings(file, folder, overwrite=True)
    assert (result.filled, result.replaced, result.unchanged) == (7, 1, 19)


def test_the_report_names_the_columns(session, tmp_path):
    _, points = session
    rows = [[f"p{i}", *numbers(p)] for i, p in enumerate(points)]
    table(tmp_path / "t.csv", ["posture", "x_mm", "y_mm", "z_mm"], rows)
    done = run_orthocal(tmp_path, "import", "t.csv", "session", "--json")
    report = json.loads(done.stdout)
    assert report["columns"] == {"posture": "'posture'", **{k: f"'{k}_mm'" for k in "xyz"}}
    assert report["filled"] == 27
    assert report["readings"][2]["y_mm"] == pytest.approx(points[2, 1])


NAMED, NOMINAL = ["posture", "x_mm", "y_mm", "z_mm"], [*(f"nominal {k} mm" for k in "xyz")]


@pytest.mark.parametrize(
    ("heading", "row", "line", "message"),
    [
        (NAMED, ["p1", "1.5", "2.5", ""], 2, "z_mm is empty"),
        (NAMED, ["p1", "1.5", "2.5", "high"], 2, "'high'"),
        (NAMED, ["p99", "1.5", "2.5", "3.5"], 2, "'p99' is not a posture"),
        (NAMED[:3], ["p1", "1.5", "2.5"], None, "no row has the headings"),
        (["posture", "x", "y", "z"], ["p1", "1.5", "2.5", "3.5"], 2, "--unit"),
        (
            [*NAMED, "X [mm]"],
            ["p1", "1.5", "2.5", "3.5", "1"],
            1,
            "several columns have the role x",
        ),
        ([*NOMINAL, *NAMED[1:]], [*"123", "1.5", "2.5", "3.5"], 2, "that of no posture"),
        ([*NOMINAL, *NAMED[1:]], ["1", "", "3", "1.5", "2.5", "3.5"], 2, "nominal y is empty"),
    ],
)
def test_a_wrong_table_is_refused(session, tmp_path, heading, row, line, message):
    file = table(tmp_path / "t.csv", heading, [row])
    with pytest.raises(SessionError) as refused:
        import_readings(file, session[0])
    assert message in str(refused.value)
    assert line is None or f"t.csv:{line}" in str(refused.value)


def test_points_do_not_belong_to_a_dial(root, tmp_path):
    """Columns x, y and z of a table for dials have no role: they may be commanded coordinates."""
    text = (root / "examples/raw-cycles/readings.csv").read_text().splitlines()
    rows = [text[0] + ",x,y,z", *(f"{line},1,2,3" for line in text[1:])]
    (tmp_path / "t.csv").write_text("\n".join(rows) + "\n")
    result = import_readings(tmp_path / "t.csv", root / "examples/raw-cycles")
    assert len(result.columns.extra) == 3
    assert not result.changes


def test_several_setups_need_a_column_of_setups(tmp_path):
    folder, points, _ = make(tmp_path, DIAL)
    file = table(tmp_path / "t.csv", NAMED, [[f"p{i}", *numbers(p)] for i, p in enumerate(points)])
    with pytest.raises(SessionError, match="no column has the role setup"):
        import_readings(file, folder)
