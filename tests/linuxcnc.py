"""LinuxCNC in simulation, without a display: runs programs and records the slides.

Without it (Debian's linuxcnc-uspace and -dev) tests are skipped, or fail if $ORTHOCAL_LINUXCNC is
`required`. Root runs it as `nobody`, and installs modules in its directory. One runs at a time.

A joint moves a slide at c = begin + s m, with the motor's position m and the direction s. Its home
switch closes at a position of the slide.
"""

from __future__ import annotations

import fcntl
import json
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from orthocal.export.linuxcnc import approximation

PROGRAMS = ("linuxcnc", "halcompile", "halcmd", "halsampler", "make", "gcc")

MODULES = Path("/usr/lib/linuxcnc/modules")

MODULE = "orthocal_kins"

BUSY = Path("/tmp/linuxcnc.lock")
"""Lock file of a running LinuxCNC."""

LONGEST = 60.0
"""Longest run, [s]; most take five. The driver ends one in time; a killed one leaves locks."""

USER = "nobody"

SEARCH = 8.0
"""Homing speed towards the switch, [mm/s]."""

LATCH = 0.02
"""Homing speed onto the switch, [mm/s]: 0.02 µm in a servo period of 1 ms."""

BEFORE_SWITCH = 2.0
"""Distance of the slides from their switches at power-on, [mm]."""

WINDOW = Path("/usr/bin/axis")
"""LinuxCNC's window, which filters and opens programs."""

PYTHON = "/usr/bin/python3"
"""Interpreter of LinuxCNC's window."""

OPEN = """\
import ast, json, linuxcnc, os, re, select, subprocess, sys

window, ini, program, result = sys.argv[1:]
progress = []


class Progress:
    def __init__(self, *_):
        pass

    def update(self, count, force=0):
        progress.append(count)

    def set_text(self, *_):
        pass

    done = set_text


class t:
    update = staticmethod(lambda: None)


names = {"progress_re", "filter_program", "get_filter"}
tree = ast.parse(open(window).read())
own = [
    node for node in tree.body
    if getattr(node, "name", None) in names
    or (isinstance(node, ast.Assign) and getattr(node.targets[0], "id", None) in names)
]
space = {"os": os, "re": re, "select": select, "sys": sys, "_": str, "t": t,
         "Progress": Progress, "inifile": linuxcnc.ini(ini)}
exec(compile(ast.Module(own, []), window, "exec"), space)
command = space["get_filter"](program)
code, said = (None, "") if command is None else space["filter_program"](command, program, result)
json.dump({"code": code, "said": said, "progress": progress}, sys.stdout)
"""

BASE = """\
[EMC]
VERSION = 1.1
MACHINE = simulated
[DISPLAY]
DISPLAY = ./drive.py
[RS274NGC]
PARAMETER_FILE = simulated.var
[EMCMOT]
EMCMOT = motmod
SERVO_PERIOD = 1000000
[TASK]
TASK = milltask
CYCLE_TIME = 0.005
[HAL]
HALFILE = simulated.hal
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
TOOL_TABLE = simulated.tbl
[KINS]
KINEMATICS = trivkins coordinates={letters} kinstype=BOTH
JOINTS = {joints}
[TRAJ]
COORDINATES = {letters}
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
MAX_LINEAR_VELOCITY = 200
DEFAULT_LINEAR_VELOCITY = 100
MAX_LINEAR_ACCELERATION = 2000
"""

AXIS = """\
[AXIS_{letter}]
MIN_LIMIT = -1000
MAX_LIMIT = 1000
MAX_VELOCITY = 200
MAX_ACCELERATION = 2000
"""

JOINT = """\
[JOINT_{i}]
TYPE = LINEAR
MIN_LIMIT = -1000
MAX_LIMIT = 1000
MAX_VELOCITY = 400
MAX_ACCELERATION = 8000
FERROR = 10
MIN_FERROR = 10
HOME = {home!r}
HOME_OFFSET = {home_offset!r}
HOME_SEARCH_VEL = {search!r}
HOME_LATCH_VEL = {latch!r}
HOME_FINAL_VEL = 100
HOME_USE_INDEX = NO
HOME_IGNORE_LIMITS = YES
HOME_SEQUENCE = 0
"""

HAL = """\
loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS
loadrt sum2 count={joints}
loadrt comp count={joints}
loadrt sampler depth=60000 cfg={kinds}
addf motion-command-handler servo-thread
addf motion-controller servo-thread
net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in
"""

HAL_JOINT = """\
addf sum2.{i} servo-thread
addf comp.{i} servo-thread
net motor{i} joint.{i}.motor-pos-cmd => joint.{i}.motor-pos-fb sum2.{i}.in0
setp sum2.{i}.gain0 {direction}
setp sum2.{i}.offset {begin!r}
setp comp.{i}.in0 {switch!r}
net slide{i} sum2.{i}.out => comp.{i}.in1 sampler.0.pin.{i}
net switch{i} comp.{i}.out => joint.{i}.home-sw-in
"""

DRIVE = """\
#!/usr/bin/python3
import json, linuxcnc, signal, subprocess, time

command, status, errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
runs = json.load(open("runs.json"))


def wait(done, what, seconds=30.0):
    end = time.monotonic() + seconds
    while True:
        status.poll()
        said = errors.poll()
        if said and said[0] in (linuxcnc.NML_ERROR, linuxcnc.OPERATOR_ERROR):
            raise RuntimeError(what + ": " + said[1])
        if done():
            return
        if time.monotonic() > end:
            raise RuntimeError("not in time: " + what)
        time.sleep(0.005)


def idle():
    return status.interp_state == linuxcnc.INTERP_IDLE and status.inpos


def paused():
    return status.interp_state == linuxcnc.INTERP_PAUSED and status.inpos


def mdi(lines):
    command.mode(linuxcnc.MODE_MDI)
    command.wait_complete()
    for line in lines:
        command.mdi(line)
        command.wait_complete(30.0)
        wait(idle, line)


def run(name, commands):
    pauses = []
    command.mode(linuxcnc.MODE_AUTO)
    command.wait_complete()
    command.program_open(name)
    command.auto(linuxcnc.AUTO_RUN, 1)
    wait(lambda: status.interp_state != linuxcnc.INTERP_IDLE, "to begin", 5.0)
    while True:
        wait(lambda: idle() or paused(), "the program")
        if idle():
            return pauses
        if len(pauses) < len(commands) and commands[len(pauses)]:
            subprocess.run(["halcmd", *commands[len(pauses)].split()], check=True)
            time.sleep(0.2)
            status.poll()
        pauses.append(list(status.joint_position[:status.joints]))
        command.auto(linuxcnc.AUTO_RESUME)
        wait(lambda: status.interp_state != linuxcnc.INTERP_PAUSED, "to go on", 5.0)


def main():
    command.state(linuxcnc.STATE_ESTOP_RESET)
    command.wait_complete()
    command.state(linuxcnc.STATE_ON)
    wait(lambda: status.task_state == linuxcnc.STATE_ON, "to be on")
    joints = status.joints
    command.teleop_enable(0)
    command.wait_complete()
    command.home(-1)
    wait(lambda: all(status.homed[:joints]), "to be homed")
    mdi(runs[0]["mdi"])
    recording = subprocess.Popen(["halsampler", "recorded.txt"])
    time.sleep(0.2)
    subprocess.run(["halcmd", "setp", "sampler.0.enable", "1"], check=True)
    pauses = [run(runs[0]["program"], runs[0]["halcmd"])]
    time.sleep(0.3)
    recording.terminate()
    recording.wait()
    for following in runs[1:]:
        mdi(following["mdi"])
        pauses.append(run(following["program"], following["halcmd"]))
    json.dump(pauses, open("pauses.json", "w"))


def stop(*_):
    raise RuntimeError("not finished in time")


signal.signal(signal.SIGALRM, stop)
signal.alarm(int(json.load(open("longest.json"))))
try:
    main()
except Exception as e:
    open("failed.txt", "w").write(repr(e))
"""


@dataclass(frozen=True)
class Joint:
    """A joint of the controller and the slide that it moves, [mm]."""

    direction: int
    """1 if the slide's coordinate grows with the joint, -1 if it falls."""
    switch: float
    """Encoder coordinate of the slide at which the home switch closes."""
    home_offset: float
    home: float
    """Joint coordinate after homing."""
    latched: int = 0
    """Sign of HOME_LATCH_VEL; 0 for that in which the slide's coordinate grows."""


def require_linuxcnc():
    """Skip the test without LinuxCNC, or fail if it is required."""
    missing = [p for p in PROGRAMS if shutil.which(p) is None]
    if missing:
        _without(f"no LinuxCNC to run: there is no {' and no '.join(missing)}")


def _without(reason):
    if os.environ.get("ORTHOCAL_LINUXCNC") == "required":
        pytest.fail(f"LinuxCNC is required here: {reason}")
    pytest.skip(reason)


@contextmanager
def only_one():
    """Hold the lock of LinuxCNC across all workers."""
    with open(Path(tempfile.gettempdir()) / "orthocal-linuxcnc.lock", "a") as lock:
        with suppress(PermissionError):  # of another user
            os.chmod(lock.fileno(), 0o666)
        fcntl.flock(lock, fcntl.LOCK_EX)
        if BUSY.exists():
            _without(f"a LinuxCNC runs already: {BUSY} exists")
        yield


def build_module(folder, *, install=False):
    """Compile the exported module in its directory, or install it."""
    words = ["halcompile", "--install" if install else "--compile", f"{MODULE}.c"]
    # it calls make, which warns if it does not find the processes of another make
    environment = {k: v for k, v in os.environ.items() if k != "MAKEFLAGS"}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "warning" not in said


@contextmanager
def few_nodes(degree=3):
    """Modules of polynomials up to a lower degree, which are fitted and checked at fewer points."""
    few_checks = partial(approximation.check_points, count=250)
    with (
        patch.dict(approximation.MAX_DEGREE, {3: degree}),
        patch.object(approximation, "check_points", few_checks),
    ):
        yield


@contextmanager
def installed(folder):
    """Install an exported module for the duration of a run."""
    target = MODULES / f"{MODULE}.so"
    if os.geteuid() != 0:
        _without("modules are installed by root")
    if target.exists():
        _without(f"somebody has installed {target}")
    try:
        build_module(folder, install=True)
        yield
    finally:
        target.unlink(missing_ok=True)


def run_program(program, joints, **options):
    """Slides in every servo period, shape (K, n_joints), [mm]; see `run_programs`."""
    return run_programs([(program[:1], [*program, "M2"])], joints, **options)[0]


def run_programs(
    runs, joints, *, letters="XYZ", lines="", module=None, files=None, halcmd=(), output=False
):
    """Home the machine, then run programs one after the other, each after its lines in MDI.

    `lines` replace those of the INI, `files` are beside it, `module` is a folder of kinematics, and
    `halcmd` are commands at the pauses of the first program. `output` records digital output 0.
    Returns the slides of the first program, (K, n_joints), and the joints at all pauses, [mm].
    """
    require_linuxcnc()
    with only_one(), nullcontext() if module is None else installed(module):
        folder = Path(tempfile.mkdtemp(prefix="orthocal-linuxcnc-"))
        try:
            for name, text in (files or {}).items():
                (folder / name).write_text(text)
            _write(folder, runs, joints, letters=letters, lines=lines, halcmd=halcmd, output=output)
            return _run(folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def play(screws, backlash):
    """Slides behind screws with play, shape (K, n): each moves when its play is used up."""
    slides = np.array(screws)
    for i, half in enumerate(0.5 * backlash):
        at = slides[0, i]
        for k, screw in enumerate(screws[:, i].tolist()):
            slides[k, i] = at = min(max(at, screw - half), screw + half)
    return slides


def filter_program(ini, program, result):
    """Filter a program with the functions of LinuxCNC's window.

    Returns the filter's exit code (None if the INI has none), its messages and its progress, [%].
    """
    require_linuxcnc()
    if not WINDOW.exists():
        _without(f"no window of LinuxCNC's: there is no {WINDOW}")
    with tempfile.TemporaryDirectory(prefix="orthocal-linuxcnc-") as name:
        folder = Path(name)
        (folder / "filtered.ini").write_text(ini)
        (folder / "open.py").write_text(OPEN)
        words = [PYTHON, "open.py", str(WINDOW), "filtered.ini", str(program), str(result)]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    return result["code"], result["said"], result["progress"]


def _write(folder, runs, joints, *, letters, lines, halcmd, output):
    n = len(joints)
    ini = BASE.format(joints=n, letters=letters)
    ini += "".join(AXIS.format(letter=letter) for letter in letters)
    hal_joints = ""
    for i, joint in enumerate(joints):
        way = joint.direction
        ini += JOINT.format(
            i=i,
            home=joint.home,
            home_offset=joint.home_offset,
            search=way * SEARCH,
            latch=(joint.latched or way) * LATCH,
        )
        hal_joints += HAL_JOINT.format(
            i=i, direction=way, begin=joint.switch - BEFORE_SWITCH, switch=joint.switch
        )
    sections = _sections(ini, lines)
    if sections["[KINS]"]["KINEMATICS"].startswith("trivkins"):  # axes are joints
        for i, letter in enumerate(letters):
            for limit in ("MIN_LIMIT", "MAX_LIMIT"):
                sections[f"[AXIS_{letter}]"][limit] = sections[f"[JOINT_{i}]"][limit]
    hal = HAL.format(joints=n, kinds="f" * n + "b" * output) + hal_joints
    hal += f"net trigger motion.digital-out-00 => sampler.0.pin.{n}\n" if output else ""
    hal += "addf sampler.0 servo-thread\nsetp sampler.0.enable 0\n"
    files = {
        "simulated.ini": _as_text(sections),
        "simulated.hal": hal,
        "simulated.tbl": "",
        "drive.py": DRIVE,
        "longest.json": json.dumps(LONGEST - 10.0),
        "runs.json": json.dumps(
            [
                {"mdi": mdi, "program": f"{i}.ngc", "halcmd": [] if i else list(halcmd)}
                for i, (mdi, _) in enumerate(runs)
            ]
        ),
        **{f"{i}.ngc": "\n".join([*program, ""]) for i, (_, program) in enumerate(runs)},
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    (folder / "drive.py").chmod(0o755)
    folder.chmod(0o755)


def enter_lines(ini, lines):
    """An INI with lines entered into their sections; equal names are replaced."""
    return _as_text(_sections(ini, lines))


def _sections(*texts):
    sections, current = {}, None
    for text in texts:
        for line in text.splitlines():
            bare = line.strip()
            if bare.startswith("["):
                current = sections.setdefault(bare, {})
            elif bare and not bare.startswith("#"):
                name, _, value = bare.partition("=")
                current[name.strip()] = value.strip()
    return sections


def _as_text(sections):
    return "".join(
        f"{section}\n" + "".join(f"{k} = {v}\n" for k, v in keys.items())
        for section, keys in sections.items()
    )


def _run(folder):
    who = {}
    if os.geteuid() == 0:
        user = pwd.getpwnam(USER)
        who = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
        for path in (folder, *folder.iterdir()):
            os.chown(path, user.pw_uid, user.pw_gid)
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "PYTHONPATH")}
    environment |= {"HOME": str(folder), "LANG": "C", "TMPDIR": str(folder)}
    with open(folder / "said.txt", "w") as said:
        process = subprocess.Popen(
            ["linuxcnc", "-r", "simulated.ini"],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
            **who,
        )
        try:
            process.wait(LONGEST)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            subprocess.run(["halrun", "-U"], cwd=folder, env=environment, check=False, **who)
    failed, recorded = folder / "failed.txt", folder / "recorded.txt"
    reason = failed.read_text() if failed.exists() else "nothing was recorded"
    if failed.exists() or not recorded.exists():
        pytest.fail(f"{reason}\n{(folder / 'said.txt').read_text()[-3000:]}")
    rows = np.loadtxt(recorded, ndmin=2, comments="o")  # `overrun` marks lost samples
    assert len(rows) > 100
    return rows, [np.array(places) for places in json.loads((folder / "pauses.json").read_text())]
