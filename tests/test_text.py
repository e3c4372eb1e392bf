"""Whatever a file or a path holds is shown as characters: nothing steers a terminal or a page."""

from __future__ import annotations

import unicodedata
from dataclasses import replace

import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated

from orthocal import calibrate, draw_scene, load_calibration, load_robot, load_session, summarize
from orthocal.calibration.file import write_calibration
from orthocal.errors import ClosureError, OrthocalError
from orthocal.io.html import paragraph, table
from orthocal.output.report.page import build_report
from orthocal.output.text.layout import short_name, to_text
from orthocal.text import printable

EVIL = "a\x1b[31mb\x9b2Jc\u202ed\u2066e\u2028f\udcff\r\n\x07"
SHOWN = r"a\x1b[31mb\x9b2Jc\u202ed\u2066e\u2028f\xff\r\n\x07"


def steering(text, keep="\n"):
    """Characters that a terminal would obey, or that turn others about."""
    kinds = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
    return {c for c in text if unicodedata.category(c) in kinds and c not in keep}


def test_characters_that_are_none_to_be_seen_are_written_as_escapes():
    assert printable(EVIL) == SHOWN
    assert printable("a\nb", keep="\n") == "a\nb"
    assert printable("naïve − µm ± “x” 𝒳 日本 עברית\xa0") == "naïve − µm ± “x” 𝒳 日本 עברית\xa0"


def test_every_error_says_what_it_has_to_in_characters_to_be_seen():
    for error in (
        OrthocalError(EVIL, where=EVIL),
        ClosureError(EVIL, posture=EVIL),
    ):
        assert not steering(str(error), keep="")
    assert str(OrthocalError(EVIL, where="file")) == f"file: {SHOWN}"


@pytest.fixture
def session(root, tmp_path):
    for name in ("session.yaml", "readings.csv"):
        data = (root / "examples/table1/experiment-2" / name).read_bytes()
        (tmp_path / name).write_bytes(data)
    return tmp_path


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("readings.csv", "setup,", "set\x1b[31m\u202eup,"),
        ("readings.csv", "yx,", "y\x1b]0;x\x07\u009bx,"),
        ("session.yaml", "leg: x", 'leg: "\\u202ex"'),
        ("session.yaml", "yx:", '"y\\u202ex": 5\n  yx:'),
    ],
)
def test_names_of_files_are_escaped_in_messages(file, old, new, session):
    path = session / file
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(OrthocalError, match=r"\\u202e|\\x1b") as caught:
        load_session(session)
    assert not steering(str(caught.value), keep="")


def test_strings_in_lists_of_a_json_are_looked_at_too(session):
    calibration = calibrate(load_session(session), **UNJUDGED)
    path = write_calibration(calibration, session / "calibration.json")
    text = path.read_text(encoding="utf-8")
    assert '"resolvable": [\n   "x_slide.offset"' in text
    path.write_text(text.replace('"resolvable": [\n   "x_', '"resolvable": [\n   "\\u001b[31mx_'))
    with pytest.raises(OrthocalError, match="a text contains a control character"):
        load_calibration(session)


@pytest.mark.usefixtures("short_reports")
def test_summary_report_and_scene_show_a_title_that_turns_itself_about():
    calibration = calibrated(EXPERIMENT_2)
    odd = replace(calibration, session=replace(calibration.session, title="live\u202eexe.\x9b31m"))
    assert r"live\u202eexe.\x9b31m" in summarize(odd)
    for text in (summarize(odd), build_report(odd), draw_scene(odd).to_html(), odd._repr_html_()):
        assert not steering(text.split("<script")[0])
        assert "\u202e" not in text
        assert "\x9b31m" not in text


def test_tables_of_pages_and_of_texts_are_escaped():
    assert steering(paragraph("\u202ea") + table(["\x1b"], [["\u2066"]])) == set()
    assert to_text("a\x1b[31mb") == "a\\x1b[31mb\n"
    assert short_name("a\x1bb") == r"a\x1bb"


def test_a_name_is_one_name_in_every_form_of_its_accents(session):
    """File names and texts of one computer are composed, of another decomposed."""
    table, described = session / "readings.csv", session / "session.yaml"
    composed, apart = (unicodedata.normalize(form, "max_é") for form in ("NFC", "NFD"))
    assert composed != apart
    text = described.read_text(encoding="utf-8").replace("x_max", apart)
    described.write_text(text, encoding="utf-8")
    rows = table.read_text(encoding="utf-8").replace("x_max", composed)
    table.write_text(rows, encoding="utf-8")
    assert composed in load_session(session).postures

    twice = text.replace(f"  {apart}:", f"  {composed}: {{tcp_mm: [1, 2, 3]}}\n  {apart}:", 1)
    described.write_text(twice, encoding="utf-8")
    with pytest.raises(OrthocalError, match="the key 'max_é' occurs twice"):
        load_session(session)


def test_a_joint_is_one_joint_in_every_form_of_its_accents(root, tmp_path):
    for file in ("biglide.urdf", "biglide.yaml"):
        text = (root / "tests/robots/biglide" / file).read_text(encoding="utf-8")
        form = "NFC" if file.endswith("urdf") else "NFD"
        renamed = text.replace("x_slide", unicodedata.normalize(form, "glissière_x"))
        (tmp_path / file).write_text(renamed, encoding="utf-8")
    robot = load_robot(tmp_path)
    assert robot.drives[0].name == unicodedata.normalize("NFC", "glissière_x")
    assert robot.parameters.select([unicodedata.normalize("NFD", "glissière_x.*")])
