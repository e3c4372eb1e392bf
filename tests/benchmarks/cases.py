"""Sessions of every size, and what it takes to identify a machine from them."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocal import load_plan, simulate_session
from orthocal.estimation.fit import build_program
from orthocal.estimation.options import SolverKind, SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.program import Program, Solution
from orthocal.kinematics.backend import llvm
from orthocal.measurement.joining import join_sessions
from orthocal.observation.simulate import draw_errors
from orthocal.session.session import Gauge, Session

sys.path.append(str(Path(__file__).parents[1]))

import plans
from gauges import exact

Array = NDArray[np.float64]

MODEL = "full"
SIGMA = 5e-6
"""Standard deviation of a reading, [m]."""

OFFSET_SIGMA = 2e-3
"""Offsets are drawn with this standard deviation, [m]; all other errors with their tolerance."""

SWEEP = 27
"""Postures of `plans.sweep`; sessions of other sizes are made by `spread_plan`."""

LARGEST_PLAN = 2000
"""Postures of one plan; more are several sessions in one problem, as no file may be that large."""

SECTIONS = [0.36, 0.425, 0.5, 0.575, 0.64]
"""Fractions of a leg that the gauge touches between -100 and 60 mm: 0.323 are left at the root
and 0.193 at the tip, and a lateral displacement shortens the leg's shadow."""


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """What one identification took."""

    postures: int
    readings: int
    seconds_build: float
    """Until the program can be solved."""
    seconds_solve: float
    """For the first solution, with all that is only built when it is first needed."""
    seconds_again: float
    """For the solution of other readings with the same program."""
    iterations: int
    """Of the first solution."""
    iterations_again: int
    peak_before: float
    """Most memory that the process held before it built anything, [MB]."""
    peak: float
    """Most memory until the first solution, [MB]."""

    @property
    def seconds(self) -> float:
        """From a session to its solution."""
        return self.seconds_build + self.seconds_solve

    @property
    def seconds_iterated(self) -> float:
        """For building and one iteration: sessions differ in how many they need."""
        return self.seconds_build + self.seconds_solve / self.iterations

    @property
    def microseconds_per_reading(self) -> float:
        """From a session to its solution."""
        return 1e6 * self.seconds / self.readings


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """A program, its first two solutions and what they took."""

    program: Program
    first: Solution
    again: Solution
    timing: Timing


def spread_plan(n_postures: int, *, seed: int = 0) -> dict:
    """A plan of any size: each leg read in ten setups, in postures of its own.

    Args:
        n_postures: A multiple of 3; a third for each leg, anywhere from -100 to 60 mm along its
            axis and within ±20 mm across it.
        seed: Of the postures.
    """
    rng = np.random.default_rng(seed)
    postures, read = {}, {a: [] for a in plans.AXES}
    for k, axis in enumerate(plans.AXES):
        for i in range(n_postures // 3):
            point = rng.uniform(-20.0, 20.0, 3)
            point[k] = rng.uniform(-100.0, 60.0)
            postures[f"{axis}{i}"] = {"tcp_mm": point.tolist()}
            read[axis].append(f"{axis}{i}")
    return {"robot": "orthoglide", "postures": postures, "setups": plans.setups(read, SECTIONS)}


def sweep() -> Session:
    """The plan of the sweep, its gauges known as they usually are."""
    with tempfile.TemporaryDirectory() as folder:
        plan = load_plan(plans.write(Path(folder), plans.sweep()))
    return plan.with_gauge(Gauge(SIGMA, None, None))


def simulate(n_postures: int, *, seed: int = 1) -> Session:
    """Readings of a machine with all errors of the model: 6 a posture in the sweep, else 10.

    Args:
        n_postures: SWEEP, or a multiple of 3.
        seed: Of errors, noise and gauge zeros.
    """
    parts = -(-n_postures // LARGEST_PLAN)
    sizes = [3 * len(part) for part in np.array_split(np.arange(n_postures // 3), parts)]
    if n_postures == SWEEP:
        found = [plans.sweep()]
    else:
        found = [spread_plan(size, seed=i) for i, size in enumerate(sizes)]
    sessions = []
    for plan in found:
        with tempfile.TemporaryDirectory() as folder:
            sessions.append(load_plan(plans.write(Path(folder), plan)))
    # gauges known exactly, as the peer takes them
    return resimulate(exact(join_sessions(sessions)), seed=seed)


def resimulate(session: Session, *, seed: int) -> Session:
    """The same readings of another machine.

    Args:
        session: What is read.
        seed: Of errors, noise and gauge zeros.
    """
    parameters = session.robot.parameters
    errors = draw_errors(
        session.robot,
        parameters.patterns(MODEL),
        seed=seed,
        tolerances={f"{axis}_slide.offset_m": 2.0 * OFFSET_SIGMA for axis in plans.AXES},
    )
    return simulate_session(session, errors, seed=seed, sigma=SIGMA).session


def identify(session: Session, other: Session, *, solver: SolverKind = "ipopt") -> Identification:
    """Build a program for a session, solve it, and solve it again for other readings.

    Args:
        session: The session.
        other: The same readings of another machine.
        solver: Which one.
    """
    before = peak_memory()
    began = time.process_time()
    problem = build_problem(session, model=MODEL)
    program = build_program(problem, SolverOptions(solver=solver))
    built = time.process_time()
    first = program.solve(sigma=SIGMA)
    solved = time.process_time()
    peak = peak_memory()
    values = problem.observations.values(other.values)
    restarted = time.process_time()
    again = program.solve(sigma=SIGMA, values=values)
    ended = time.process_time()
    timing = Timing(
        postures=problem.n_states,
        readings=len(session.readings),
        seconds_build=built - began,
        seconds_solve=solved - built,
        seconds_again=ended - restarted,
        iterations=first.iterations,
        iterations_again=again.iterations,
        peak_before=before,
        peak=peak,
    )
    return Identification(program, first, again, timing)


def load_libraries() -> None:
    """Load what is loaded when first needed: SciPy, as for the peer, and LLVM where it is."""
    for name in ("scipy.linalg", "scipy.sparse"):
        import_module(name)
    for lanes in llvm.LANES if llvm.is_installed() else ():
        llvm.compile_interpreter(lanes)


def measure(n_postures: int, solver: SolverKind = "ipopt") -> Timing:
    """Time one identification, libraries loaded.

    Args:
        n_postures: As for `simulate`.
        solver: Which one.
    """
    load_libraries()
    session = simulate(n_postures)
    return identify(session, resimulate(session, seed=2), solver=solver).timing


def measure_apart(n_postures: int, solver: SolverKind = "ipopt") -> Timing:
    """Time one identification in a fresh process, whose peak of memory is its own.

    With ORTHOCAL_CACHE=off it builds all that a robot needs, too.
    """
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure, n_postures, solver).result()


def measure_first(values: Array, other: Array) -> Timing:
    """Time one identification of the sweep in a process that has not moved the robot before.

    Args:
        values: Its readings, [m]: simulated elsewhere, for that builds functions of the robot.
        other: Those of another machine.
    """
    session = exact(sweep()).with_values(values)
    return identify(session, session.with_values(other)).timing


def measure_first_apart(values: Array, other: Array) -> Timing:
    """The same in a fresh process; with ORTHOCAL_CACHE=off it builds all that a robot needs."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure_first, values, other).result()


def peak_memory() -> float:
    """Most memory that this process held so far, [MB].

    Not from getrusage where Linux tells it: there `ru_maxrss` of a child begins with the peak of
    the process that started it.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1024.0**2
