"""The report's content, without a browser."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from unittest.mock import patch

import numpy as np
import pytest
from calibrated import (
    EXPERIMENT_2,
    UNJUDGED,
    calibrated,
    identified,
    rename_setups,
    report_of,
    session_of,
)
from conftest import marked_plots
from rich.console import Group
from rich.panel import Panel
from rich.text import Text

from orthocal import Choice, calibrate, load_calibration
from orthocal.assessment.controller_entries import expanded_uncertainty
from orthocal.assessment.words.entries import describe_compensated
from orthocal.calibration.file import write_calibration
from orthocal.io.html import items, paragraph, table
from orthocal.output.report import page as report_page
from orthocal.output.report.page import _provenance, build_report
from orthocal.output.text.layout import bullets, section, table_of, to_markup

pytestmark = pytest.mark.usefixtures("without_sensor_gains")

QUICK = {"solver": "variable-projection"}
EVIL = '</script><script>alert("x")</script><img src=x onerror=alert(1)> & $x_{$'


class Reader(HTMLParser):
    """Headings, tables and visible text of a page; raises nothing, so tests must look."""

    VOID = ("meta", "link", "br", "img", "input")

    def __init__(self, page):
        super().__init__()
        self.tags, self.ids, self.open, self.text = [], [], [], {}
        self.rows: list[list[str]] = []
        self.frames: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.tags.append(tag)
        if "id" in named:
            self.ids.append(named["id"])
        if tag == "iframe":
            self.frames.append(named["srcdoc"])
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)
        if "id" in dict(attributes):
            self.ids.append(dict(attributes)["id"])

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> without its beginning"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.text.setdefault(self.open[-1], []).append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def calibration():
    return calibrated(EXPERIMENT_2)


@pytest.fixture(scope="module")
def page():
    return report_of(EXPERIMENT_2)


@pytest.fixture(scope="module")
def read(page):
    return Reader(page)


def test_order_of_the_sections(page, read):
    names = re.findall(r'<section id="(\w+)">', page)
    assert names == [
        *("verdict", "tool", "fit", "residuals", "parameters", "sensors"),
        *("scene", "words", "provenance", "research"),
    ]
    assert not read.open
    assert all(f'href="#{name}"' in page for name in names)


def test_values_to_enter_come_first(calibration, read):
    first = read.rows[1:4]
    for row, entry in zip(first, calibration.assessment.entries, strict=True):
        assert row[0] == entry.drive
        assert row[2:] == [
            f"{entry.enter * 1e3:+.3f}",
            f"{expanded_uncertainty(calibration, entry) * 1e3:.3f}",
            "mm",
        ]


def test_provenance_has_check_sums_of_files(calibration, page):
    assert calibration.session.sha256 in page
    assert calibration.robot_record.sha256 in page
    assert calibration.versions.orthocal in page
    assert "Pashkevich, Chablat, Wenger (2006)" in page


def test_provenance_lists_stated_assumptions(root, read, calibration, page):
    assert _provenance(calibration) in page
    assert ["Tolerance scale", "2.83, tolerances of legs, axes and drive scales"] in read.rows
    found = calibrate(
        root / "examples/raw-cycles",
        Choice(
            model="lengths",
            tolerances={"*.offset_m": 4e-3},
            known={"x_leg.length_m": 0.12e-3, "y_leg.length_m": (0.05e-3, 0.04e-3)},
            bounds={"z_slide.offset_m": (-1e-3, 2e-3)},
        ),
        **UNJUDGED,
    )
    rows = Reader(_provenance(found)).rows
    offsets = [f"{leg}_slide.offset 4 mm instead of 10" for leg in "xyz"]
    assert ["Tolerances", "; ".join(offsets)] in rows
    assert ["Known values", "y_leg.length 0.05 ± 0.04 mm; x_leg.length 0.12 mm"] in rows
    assert ["Bounds", "z_slide.offset -1 … 2 mm"] in rows


def test_stated_tolerances_are_those_before_their_scale(root):
    scaled = calibrate(
        root / "examples/table1/experiment-2",
        Choice(model="lengths", tolerances={"x_leg.length_m": 0.4e-3}),
        **QUICK,
    )
    assert scaled.tolerance_scale.factor == pytest.approx(2.83, abs=0.005)
    rows = Reader(_provenance(scaled)).rows
    assert ["Tolerances", "x_leg.length 0.4 mm instead of 0.2"] in rows


def test_sessions_have_their_own_offsets_and_gauges_their_own_scatter():
    joined = identified([session_of("raw-cycles"), session_of("workshop")])
    rows = Reader(_provenance(joined)).rows
    offsets = [text for name, text in rows if name == "Offsets active during the measurement"]
    assert len(offsets) == 2
    assert [name for name, _ in rows if name.startswith("Gauge")] == [
        f"Gauge {g.name}".rstrip() for g in joined.gauges
    ]


def test_plots_are_drawn_into_the_page(page, read):
    assert read.tags.count("svg") >= 9
    assert len(read.ids) == len(set(read.ids))
    own = re.sub(r'srcdoc="[^"]*"', "", page)
    links = set(re.findall(r'(?:href|src|xlink:href)="([^"]*)"', own))
    assert all(link.startswith(("#", "data:")) for link in links), links
    assert not re.findall(r"url\((?!#)", own)
    assert "://" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", own)


def test_the_scene_is_embedded(read):
    (frame,) = read.frames
    assert frame.startswith("<!DOCTYPE html>")
    assert "Leg x is furthest from parallel" in frame


def test_full_model_shows_the_error_with_offsets_entered():
    found = calibrated("sweep", "full", **UNJUDGED)
    page = build_short_report(found)
    assert "without any other correction" in page
    assert "Larger errors do not refute it" in page
    read = Reader(page)
    assert ["drive", "now", "new", "±", "identified", "unit"] in read.rows
    assert (
        len([r for r in read.rows if len(r) > 5 and r[0] in {s.name for s in found.setups}]) == 162
    )
    listed = {r[0] for r in read.rows if r}
    assert {p.name for p in found.free} <= listed


def test_loaded_calibration_makes_the_same_report(calibration, tmp_path):
    path = write_calibration(calibration, tmp_path / "calibration.json")
    loaded = load_calibration(path)
    same = replace(loaded, path=None)
    assert build_short_report(same) == build_short_report(calibration)
    new = tmp_path.parent / "experiment-2-again"  # after the name of the session
    command = f"orthocal again {tmp_path} --out {new}"
    assert f"<code>{command}</code>" in build_short_report(loaded)


def build_short_report(calibration):
    """Report with marks in place of plots and scene."""
    with marked_plots(), patch.object(report_page, "_scene", lambda _: "<!-- scene -->"):
        return build_report(calibration)


def test_texts_from_files_are_escaped(raw_cycles):
    renamed = rename_setups(raw_cycles, {name: f"{name}{EVIL}" for name in raw_cycles.setups})
    session = replace(
        renamed,
        setups={
            n: replace(s, aligned_at=f"{s.aligned_at}{EVIL}") for n, s in renamed.setups.items()
        },
        title=EVIL,
        source=EVIL,
        postures={
            f"{n}{EVIL}": replace(p, name=f"{n}{EVIL}") for n, p in raw_cycles.postures.items()
        },
        readings=tuple(replace(r, posture=f"{r.posture}{EVIL}") for r in renamed.readings),
    )
    found = calibrate(session, **UNJUDGED)
    with marked_plots():  # names in plots: `test_names_from_files_are_shown_unchanged`
        read = Reader(build_report(found))
    assert "script" not in read.tags
    assert "img" not in read.tags
    assert not read.open
    frame = Reader(read.frames[0])
    assert "img" not in frame.tags
    assert frame.tags.count("script") == 3
    for part in (found._repr_html_(), session._repr_html_()):
        seen = Reader(part)
        assert set(seen.tags) <= set("p table thead tbody tr th td ul li code".split())
        assert any(EVIL in t for t in seen.text["p"])


def test_report_without_prediction_and_noise(raw_cycles):
    """One setup with a prior has neither cross-validation nor known noise."""
    rows = tuple(r for r in raw_cycles.readings if r.setup == "yx" and r.cycle == 1)
    session = replace(raw_cycles, readings=rows).with_gauge(
        replace(raw_cycles.gauge, sigma=None, resolution=None)
    )
    found = calibrate(session, "full", **UNJUDGED)
    assert not np.isfinite([r.prediction_error for r in found.residuals]).any()
    page = build_short_report(found)
    assert "No setup can be predicted" in page
    assert not Reader(page).open


def test_robot_without_a_tool_has_a_report(experiment_2):
    bare = replace(experiment_2.robot, tcp=None)
    page = build_short_report(calibrate(replace(experiment_2, robot=bare), **UNJUDGED))
    assert "The tool error cannot be computed" in page
    assert "no tool centre point" in page


# ---- notebooks


def test_calibration_with_many_parameters_lists_what_to_enter():
    found = calibrated("sweep", "full", **UNJUDGED)
    read = Reader(found._repr_html_())
    assert read.rows[0] == ["drive", "now", "new", "±", "unit"]
    assert [r[0] for r in read.rows[1:]] == ["x_slide", "y_slide", "z_slide"]
    compensated = describe_compensated(found.assessment.tool.compensated)
    assert compensated in " ".join(read.text["p"])


def test_session_in_a_notebook(raw_cycles):
    read = Reader(raw_cycles._repr_html_())
    assert len(read.rows) == 7
    values = [r.value * 1e3 for r in raw_cycles.readings if r.setup == "yx"]
    assert read.rows[1] == [
        *("yx", "leg x, gauge in y, at 0.5 of its length from the slide", "9"),
        *(f"{min(values):+.3f}", f"{max(values):+.3f}"),
    ]


# ---- pieces of HTML


def test_pieces_of_html_are_escaped():
    assert paragraph("a < b & c", kind="x") == '<p class="x">a &lt; b &amp; c</p>'
    assert items(["<", "b"]) == "<ul><li>&lt;</li><li>b</li></ul>"
    found = table(("a", "b"), [("<i>", "1")])
    assert '<td>&lt;i&gt;</td><td class="number">1</td>' in found
    assert "thead" not in table(("", ""), [("a", "b")])
    with pytest.raises(ValueError, match="zip"):
        table(("a",), [("1", "2")])


def test_rich_renderables_become_html():
    printed = table_of(("name", "value", "unit"), [("[b]x[/b]", "1", "mm")])
    content = Group(
        section("T", Group(Text("before"), printed)), bullets(["one", "two"]), Text("end")
    )
    found = to_markup(content)
    assert "<p>T</p>" in found
    assert "<td>[b]x[/b]</td>" in found
    assert "<ul><li>one</li><li>two</li></ul>" in found
    assert found.endswith("<p>end</p>")
    with pytest.raises(TypeError, match="no HTML for a Panel"):
        to_markup(Panel("x"))
