"""Files: read within bounds, written whole or not at all, whatever is there and however it ends."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from orthocal import import_readings, load_calibration, load_plan, load_robot, load_session
from orthocal.errors import OrthocalError, OutputError, RobotError, SessionError
from orthocal.io.files import (
    read_file,
    require_writable,
    require_writable_file,
    write_file,
    write_files,
)
from orthocal.io.journal import open_journal_file

NO_FILE = "is a device, a pipe or a socket; expected a file"


@pytest.fixture
def session(root, tmp_path):
    text = (root / "examples/table1/experiment-2/session.yaml").read_text(encoding="utf-8")
    (tmp_path / "session.yaml").write_text(text.replace("readings.csv", "table"), encoding="utf-8")
    return tmp_path


def leftovers(folder):
    return [p.name for p in folder.iterdir() if p.name.startswith(".orthocal-")]


# ---- reading


def test_a_pipe_is_refused_and_nothing_waits_for_its_writer(session):
    os.mkfifo(session / "table")
    with pytest.raises(SessionError, match=NO_FILE):
        load_session(session)


def test_a_device_is_refused_before_it_is_read(session):
    (session / "table").symlink_to("/dev/zero")
    began = time.process_time()
    with pytest.raises(SessionError, match=NO_FILE):
        load_session(session)
    assert time.process_time() - began < 3.0


@pytest.mark.parametrize("load", [load_session, load_calibration])
def test_every_kind_of_file_must_be_one(load, tmp_path):
    name = {load_session: "session.yaml", load_calibration: "calibration.json"}[load]
    os.mkfifo(tmp_path / name)
    with pytest.raises(OrthocalError, match=NO_FILE):
        load(tmp_path)


@pytest.mark.parametrize("suffix", ["yaml", "urdf"])
def test_a_robots_files_must_be_some(suffix, root, tmp_path):
    folder = tmp_path / "biglide"
    folder.mkdir()
    for kind in ("yaml", "urdf"):
        data = (root / f"tests/robots/biglide/biglide.{kind}").read_bytes()
        (folder / f"biglide.{kind}").write_bytes(data)
    (folder / f"biglide.{suffix}").unlink()
    os.mkfifo(folder / f"biglide.{suffix}")
    with pytest.raises(OrthocalError, match=f"(?s){NO_FILE}|found biglide"):
        load_robot(folder)


def test_a_file_is_read_up_to_its_bound_and_no_further(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 100)
    assert read_file(path, largest=100) == b"x" * 100
    with pytest.raises(OrthocalError, match="expected at most"):
        read_file(path, largest=99)


def test_what_says_that_it_is_empty_is_read_within_bounds_too():
    path = Path("/proc/self/maps")
    assert path.stat().st_size == 0
    with pytest.raises(OrthocalError, match="has more; expected at most"):
        read_file(path, largest=50)


def test_the_hash_of_a_session_is_of_what_was_read(root, tmp_path, monkeypatch):
    """Nothing is read a second time: what changes between is not what was checked."""
    source = root / "examples/table1/experiment-2"
    for name in ("session.yaml", "readings.csv"):
        (tmp_path / name).write_bytes((source / name).read_bytes())
    opened = []
    original = os.open

    def note(path, *args, **kwargs):
        opened.append(str(path))
        return original(path, *args, **kwargs)

    monkeypatch.setattr(os, "open", note)
    assert load_session(tmp_path).sha256 == load_session(source).sha256
    assert opened.count(str(tmp_path / "readings.csv")) == 1
    assert opened.count(str(tmp_path / "session.yaml")) == 1


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "file/inside", "\udcff"])
def test_a_name_that_is_none_is_refused(name, tmp_path):
    (tmp_path / "file").write_text("")
    for act in (read_file, lambda p: write_file(p / "x" if name == "file/inside" else p, "")):
        if name == "\udcff" and act is not read_file:
            continue  # a byte that is no UTF-8 makes a name like any other
        with pytest.raises(OrthocalError) as caught:
            act(tmp_path / name)
        assert caught.value.exit_code == 2
        assert str(caught.value).isprintable()


# ---- writing


def test_a_new_file_has_the_mode_that_the_mask_gives(tmp_path):
    for mask, mode in ((0o077, 0o600), (0o002, 0o664)):
        before = os.umask(mask)
        try:
            write_file(tmp_path / f"file-{mask}", "text")
        finally:
            os.umask(before)
        assert stat.S_IMODE((tmp_path / f"file-{mask}").stat().st_mode) == mode


def test_a_file_that_is_there_keeps_its_mode(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(0o640)
    write_file(path, "new")
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_written_through(there, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere/file", tmp_path / "link"
    if there:
        target.write_text("old")
    link.symlink_to(target)
    write_file(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_no_device_is_written_over(tmp_path):
    (tmp_path / "file").symlink_to("/dev/null")
    with pytest.raises(OrthocalError, match="is a device"):
        write_file(tmp_path / "file", "text")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


@pytest.mark.parametrize("folder", ["/proc/orthocal", "/proc", "/sys/kernel"])
def test_an_output_that_cannot_be_written_is_found_before_the_work(folder):
    if not Path("/proc/self").exists():
        pytest.skip("no /proc")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        require_writable(Path(folder))
    assert caught.value.exit_code == 1
    with pytest.raises(OutputError):
        require_writable_file(Path(folder) / "report.html", kinds=(".html",))


def test_looking_whether_a_folder_can_be_written_leaves_nothing(tmp_path):
    require_writable(tmp_path / "new/folder")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_cleaned_up_does_not_prevent_writing(tmp_path):
    """As the file of another user in /tmp; a directory, because the tests may run as root."""
    left = tmp_path / f".orthocal-{2**22}-{16 * '0'}.tmp"
    left.mkdir()
    write_file(tmp_path / "file", "text")
    assert sorted(f.name for f in tmp_path.iterdir()) == [left.name, "file"]


def test_what_a_killed_run_left_is_cleaned_up_by_the_next(tmp_path):
    done = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"],
                          capture_output=True, text=True, check=True)  # fmt: skip
    dead, alive = int(done.stdout), os.getpid()
    for pid in (dead, alive):
        (tmp_path / f".orthocal-{pid}-0123456789abcdef.tmp").write_text("")
    (tmp_path / ".orthocal-mine.tmp").write_text("")
    write_file(tmp_path / "file", "text")
    assert sorted(leftovers(tmp_path)) == [
        f".orthocal-{alive}-0123456789abcdef.tmp",
        ".orthocal-mine.tmp",
    ]


def test_all_or_none_where_one_cannot_be(tmp_path):
    (tmp_path / "b").mkdir()
    with pytest.raises(OrthocalError, match="is a directory"):
        write_files(tmp_path, {"a": "new", "b": "new"})
    assert not (tmp_path / "a").exists()
    assert leftovers(tmp_path) == []


def test_old_files_stay_where_the_first_cannot_be_replaced(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / name).write_text("old")
    original = os.replace

    def refuse(source, target):
        if Path(target).name == "a":
            raise OSError(5, "Input/output error")
        original(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="Input/output error"):
        write_files(tmp_path, {"a": "new", "b": "new"})
    assert [(tmp_path / n).read_text() for n in ("a", "b")] == ["old", "old"]
    assert leftovers(tmp_path) == []


STOP = """
import os, signal, sys
from pathlib import Path
import orthocal.io.files as files
steps, original = int(sys.argv[2]), os.replace
def replace(source, target):
    global steps
    steps -= 1
    if steps < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    original(source, target)
os.replace = replace
files.write_files(Path(sys.argv[1]), {"calibration.json": "new", "report.html": "new"})
"""


@pytest.mark.parametrize(
    ("steps", "left"),
    [
        (0, {"calibration.json": "old", "report.html": "old"}),
        (1, {"calibration.json": "old"}),
        (2, {"calibration.json": "new"}),
        (3, {"calibration.json": "new", "report.html": "new"}),
    ],
)
def test_killed_between_two_renames_there_is_one_generation(steps, left, tmp_path):
    for name in ("calibration.json", "report.html"):
        (tmp_path / name).write_text("old")
    subprocess.run([sys.executable, "-c", STOP, str(tmp_path), str(steps)], check=False)
    found = {p.name: p.read_text() for p in tmp_path.iterdir() if not p.name.startswith(".")}
    assert found == left
    write_files(tmp_path, {"calibration.json": "", "report.html": ""})
    assert leftovers(tmp_path) == []


# ---- files that a document names


SECRET = "the combination is 17-42-23"


@pytest.fixture
def secret(tmp_path):
    """A file outside the session."""
    path = tmp_path / "elsewhere" / "secret.txt"
    path.parent.mkdir()
    path.write_text(f"{SECRET}\n" * 3)
    return path


@pytest.mark.parametrize("place", ["absolute", "parent", "link", "inside"])
@pytest.mark.parametrize("head", ["", "setup,posture,reading_mm\n", "setup;posture;mm\n"])
def test_content_of_a_table_is_quoted_only_inside_the_session(place, head, root, secret, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(root / "examples/table1/experiment-2", folder)
    table = (folder / "readings.csv").rename(tmp_path / "table.csv")
    secret.write_text(head + secret.read_text())
    name = {"absolute": str(secret), "parent": "../elsewhere/secret.txt"}.get(place, "inside.csv")
    if place == "inside":
        shutil.copy(secret, folder / name)
    elif place == "link":
        (folder / name).symlink_to(secret)
    file = folder / "session.yaml"
    file.write_text(file.read_text().replace("readings.csv", name))
    for act in (load_session, load_plan, lambda path: import_readings(table, path)):
        with pytest.raises(OrthocalError) as caught:
            act(folder)
        assert ("combination" in str(caught.value)) == (place == "inside" and not head)
        assert re.fullmatch(f"{re.escape(str(folder / name))}:[12]", caught.value.where)


@pytest.mark.parametrize("kind", ["yaml", "urdf"])
def test_content_of_a_robot_file_behind_a_link_is_not_quoted(kind, root, secret, tmp_path):
    folder = tmp_path / "orthoglide"
    shutil.copytree(root / "robots/orthoglide", folder)
    file = folder / f"orthoglide.{kind}"
    file.unlink()
    secret.write_text(f"{SECRET}: 1\n")
    file.symlink_to(secret)
    with pytest.raises(RobotError) as caught:
        load_robot(folder)
    assert "combination" not in str(caught.value)
    assert caught.value.where.startswith(str(file))


def test_a_line_that_does_not_fit_leaves_nothing_in_a_journal(tmp_path, monkeypatch):
    """The disk is full in the middle of the line, and has space for the next one."""
    write = os.write

    def write_the_beginning(descriptor, data):
        if len(data) < 10:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data[:5])

    with open_journal_file(tmp_path / "journal", busy="busy") as journal:
        journal.append({"a": 1})
        with monkeypatch.context() as patched:
            patched.setattr(os, "write", write_the_beginning)
            with pytest.raises(OutputError, match="No space left"):
                journal.append({"b": "long"})
        journal.append({"c": 2})
    assert (tmp_path / "journal").read_text() == '{"a": 1}\n{"c": 2}\n'
