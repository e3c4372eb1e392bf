"""`--tolerance` means the same as the key of session.yaml, in every command that uses priors."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
import yaml
from commands import run_orthocal
from conftest import marked_reports
from uncompared import uncompared

from orthocal import (
    Choice,
    calibrate,
    check_session,
    compare_models,
    load_calibration,
    load_plan,
    load_session,
    write_session,
)
from orthocal.output.text.answer import calibrate_command

pytestmark = pytest.mark.usefixtures("module_without_sensor_gains", "judged_sessions")

OF_JOINTS = {"*.[xyz]_mm": 0.02, "*.r?_mrad": 0.2}
STATED = OF_JOINTS | {"x_slide.offset_mm": 8.0}
OPTION = [word for key, value in STATED.items() for word in ("--tolerance", f"{key}={value:g}")]
QUICK = "--along 3 --across-mm 0 --sections 0.5 --setups 3 --starts 1 --seed 1".split()


@pytest.fixture(scope="module", autouse=True)
def without_reports():
    with marked_reports():
        yield


@pytest.fixture(scope="module")
def folder(root, tmp_path_factory, without_reports, judged_sessions):
    """Experiments 2 and 3 without and with the key, and a calibration of each."""
    folder = tmp_path_factory.mktemp("tolerances")
    for number in (2, 3):
        session = load_session(root / f"examples/table1/experiment-{number}")
        write_session(session, folder / f"plain/{number}")
        write_session(session.with_tolerances(STATED), folder / f"stated/{number}")
    for words in (["plain", *OPTION], ["stated"]):
        out = ["--out", f"{words[0]}/calibration"]
        assert run_orthocal(folder, "calibrate", f"{words[0]}/2", *words[1:], *out).returncode == 3
    return folder


def compared(text):
    """What a document says of the machine, without names of files."""
    document = json.loads(text)
    findings = [(f["kind"], f["severity"], f["numbers"]) for f in document.get("findings", ())]
    kept = ("parameters", "recommendation", "models", "excess_probability", "expected", "known")
    return document.get("decision", {}).get("verdict"), findings, [document.get(k) for k in kept]


@pytest.mark.parametrize(
    "words",
    [
        ["check", "2"],
        ["compare", "2", "--models", "offsets", "--repeat", "3"],
        ["validate", "calibration", "3"],
        ["plan", "2", *QUICK],
    ],
    ids=lambda words: " ".join(map(str, words[:4])),
)
def test_the_option_is_the_key(folder, words):
    with uncompared():
        plain, stated = (
            run_orthocal(folder / of, *words, "--json", *more)
            for of, more in (("plain", OPTION), ("stated", []))
        )
    assert plain.returncode == stated.returncode
    assert compared(plain.stdout) == compared(stated.stdout)
    if words[0] in ("check", "validate"):
        unlike = run_orthocal(folder / "plain", *words, "--json")
        of_calibration = words[0] == "validate"  # its tolerances are those of silent sessions
        assert (compared(plain.stdout) == compared(unlike.stdout)) == of_calibration


def test_a_session_of_other_tolerances_than_the_calibration_is_not_validated(folder):
    other = ["--tolerance", "*.offset_mm=1"]
    session = load_session(folder / "stated/3").with_tolerances({"*.offset_mm": 1.0})
    write_session(session, folder / "stated/narrow")
    done = run_orthocal(folder / "stated", "validate", "calibration", "narrow")
    assert done.returncode == 2
    assert "narrow/session.yaml: calibration.tolerances" in done.stderr
    done = run_orthocal(folder / "stated", "validate", "calibration", "narrow", *other)
    assert done.returncode != 2, done.stderr


def test_a_calibration_keeps_the_option(folder):
    """Its verdict, and that of its readings judged again, are those of the key."""
    by_option, by_key = (
        load_calibration(folder / of / "calibration") for of in ("plain", "stated")
    )
    assert by_option.robot.parameters.stated == by_key.robot.parameters.stated == STATED
    plain, stated = (
        (folder / of / "calibration/calibration.json").read_text() for of in ("plain", "stated")
    )
    assert compared(plain) == compared(stated)
    assert by_option.assessment.decision.verdict == "reject"
    assert by_option.assessment.of_kind("beyond tolerances")


def test_simulate_draws_by_the_option_and_states_it(folder):
    """Also where nothing is drawn: the key would be kept, too."""
    words = ["--draw", "*_slide.offset", "--seed", 4]
    truths = []
    for of, more in (("plain", OPTION), ("stated", [])):
        out = ["--out", "simulated", "--force"]
        done = run_orthocal(folder / of, "simulate", "2", *words, *more, *out)
        assert done.returncode == 0, done.stderr
        truths.append((folder / of / "simulated/truth.yaml").read_text())
        text = (folder / of / "simulated/session.yaml").read_text()
        assert yaml.safe_load(text)["calibration"]["tolerances"] == STATED
    assert truths[0] == truths[1]
    assert load_session(folder / "plain/simulated").robot.parameters.stated == STATED


def test_the_option_replaces_what_it_matches(folder):
    """Whatever unit and glob the session states it with; what it does not match stays."""
    session = load_session(folder / "stated/2")
    stated = session.with_tolerances({"*.offset_m": 1e-3}).robot.parameters
    assert stated.stated == OF_JOINTS | {"*.offset_m": 1e-3}
    assert stated["x_slide.offset"].prior_std == 0.5e-3
    narrow = session.with_tolerances({"x_fork.rx_mrad": 1.0}).robot.parameters
    assert narrow.stated == STATED | {"x_fork.rx_mrad": 1.0}
    assert narrow["x_fork.rx"].prior_std == 0.5e-3
    assert narrow["y_fork.rx"].prior_std == 0.1e-3


def test_sessions_that_state_different_tolerances_join_by_the_option(folder):
    write_session(
        load_session(folder / "stated/3").with_tolerances({"x_slide.offset_mm": 1.0}),
        folder / "stated/other",
    )
    words = ["check", "stated/2", "stated/other"]
    assert run_orthocal(folder, *words).returncode == 2
    assert run_orthocal(folder, *words, "--tolerance", "*.offset_mm=8").returncode != 2


def test_a_session_made_again_states_the_option(folder):
    """The sessions of a joined calibration do not; nor does their robot."""
    joined = ["2", "3", *OPTION, "--solver", "linearised"]
    assert run_orthocal(folder / "plain", "calibrate", *joined, "--out", "both").returncode == 3
    done = run_orthocal(folder / "plain", "again", "both", "--anyway", "--out", "next")
    assert done.returncode == 0, done.stderr
    assert load_plan(folder / "plain/next").robot.parameters.stated == STATED
    assert load_plan(folder / "plain/3").robot.parameters.stated == {}


def test_the_printed_calibration_of_all_sessions_repeats_the_option():
    words = shlex.split(calibrate_command([Path("one day"), Path("two")], STATED))
    assert words == ["orthocal", "calibrate", "one day", "two", *OPTION, "--out", "two-calibration"]


def test_in_python_the_argument_is_the_key(folder):
    plain, stated = (load_session(folder / of / "2") for of in ("plain", "stated"))
    expected = [f.to_document()["numbers"] for f in check_session(stated).findings]
    found = calibrate(plain, Choice("offsets", tolerances=STATED)).assessment
    judged = [f.to_document()["numbers"] for f in found.findings]
    assert all(numbers in judged for numbers in expected)
    assert (
        compare_models(plain, models=["offsets"], tolerances=STATED).judgement.verdict == "reject"
    )


@pytest.mark.parametrize(
    ("session", "typed_in", "expected"),
    [
        ("mill/first", None, "mill/first --out mill/first-calibration"),
        ("mill/first/session.yaml", None, "mill/first/session.yaml --out mill/first-calibration"),
        (".", None, ". --out ../first-calibration"),
        ("session.yaml", None, "session.yaml --out ../first-calibration"),
        ("mill/first", "mill/first", ". --out ../first-calibration"),
        ("mill/first", "mill/sheets", "../first --out ../first-calibration"),
    ],
)
def test_a_calibration_is_beside_its_session(tmp_path, monkeypatch, session, typed_in, expected):
    """The printed commands are equal inside and outside of the session's directory."""
    (tmp_path / "mill/first").mkdir(parents=True)
    monkeypatch.chdir(tmp_path if session.startswith("mill") else tmp_path / "mill/first")
    folder = None if typed_in is None else Path(typed_in)
    assert calibrate_command([Path(session)], {}, folder=folder) == f"orthocal calibrate {expected}"
