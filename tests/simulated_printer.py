"""A delta printer with errors and the firmwares that drive it, written apart from the package.

The carriages of the printer are known by their travel below the endstops alone. A firmware turns
positions into travel by its settings, which it reads from lines of its own format.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from orthocal.kinematics.loop_closure import LoopClosure

HOMED_MM = 560.0
"""Coordinates of the robot's drives at the endstops."""

ANGLES = (210.0, 330.0, 90.0)
N = r"[-+]?\d+\.?\d*"


@dataclass
class Firmware:
    """Settings in mm and degrees."""

    radius: float
    rods: np.ndarray
    angles: np.ndarray
    endstops: np.ndarray
    tilts: tuple = (0.0, 0.0)

    def travel(self, points):
        """Travel below the endstops, shape (K, 3), [mm]."""
        a = np.radians(self.angles)
        x, y, z = (np.asarray(points, float)[:, [k]] for k in range(3))
        carriages = np.sqrt(
            self.rods**2 - (x - self.radius * np.cos(a)) ** 2 - (y - self.radius * np.sin(a)) ** 2
        )
        carriages += z + x * self.tilts[0] + y * self.tilts[1]
        return self.endstops + np.sqrt(self.rods**2 - self.radius**2) - carriages


def nominal(radius=140.0, rod=280.0):
    """Settings of the printer as designed."""
    height = HOMED_MM - math.sqrt(rod**2 - radius**2)
    return Firmware(radius, np.full(3, rod), np.array(ANGLES), np.full(3, height))


def words(line):
    found = re.findall(rf"([A-Z])({N}(?::{N})*)", line)
    return {k: [float(v) for v in text.split(":")] for k, text in found}


def read_settings(firmware, text, m851=0.0):
    """Settings from lines in the format of a firmware."""
    if firmware == "klipper":
        value = {}
        for section, body in re.findall(r"\[(\w+)\]\n((?:\w+: .*\n)*)", text):
            value |= {(section, k): float(v) for k, v in re.findall(r"(\w+): (.*)", body)}
        of = lambda key: np.array([value[f"stepper_{k}", key] for k in "abc"])  # noqa: E731
        radius = value["printer", "delta_radius"]
        return Firmware(radius, of("arm_length"), of("angle"), of("position_endstop"))
    m665, m666 = (words(re.search(rf"{c} (.*)", text)[1]) for c in ("M665", "M666"))
    one = lambda found, k: found.get(k, [0.0])[0]  # noqa: E731
    angles = np.array(ANGLES) + [one(m665, k) for k in "XYZ"]
    stops = np.array([one(m666, k) for k in "XYZ"])
    height, radius = one(m665, "H"), one(m665, "R")
    if firmware in ("marlin", "marlin1"):
        assert (stops <= 0.0).all()
        assert firmware == "marlin" or not set("ABC") & m665.keys()
        rods = one(m665, "L") + np.array([one(m665, k) for k in "ABC"])
        return Firmware(radius, rods, angles, height - m851 - stops)
    rods = np.array(m665["L"]) if len(m665["L"]) == 3 else np.full(3, m665["L"][0])
    tilts = one(m666, "A") / 100.0, one(m666, "B") / 100.0
    return Firmware(radius, rods, angles, height + stops, tilts)


def write_settings(firmware, s, m851=0.0):
    """Lines of a firmware with settings that have no tilts and, for Marlin, no endstop trims."""
    x, y, z = s.angles - ANGLES
    if firmware == "klipper":
        towers = "".join(
            f"[stepper_{k}]\nposition_endstop: {e:.6f}\narm_length: {r:.6f}\nangle: {a:.6f}\n"
            "rotation_distance: 40\nmicrosteps: 16\n"
            for k, e, r, a in zip("abc", s.endstops, s.rods, s.angles, strict=True)
        )
        return f"[printer]\nkinematics: delta\ndelta_radius: {s.radius:.6f}\n{towers}"
    rods = ":".join(f"{r:.4f}" for r in s.rods)
    height = s.endstops.mean()
    if firmware in ("marlin", "marlin1"):
        top = s.endstops.min()
        a, b, c = s.rods - s.rods[0]
        trims = f"A{a:.4f} B{b:.4f} C{c:.4f}"
        if firmware == "marlin1":  # B is the radius at which G33 probes
            assert a == b == c
            trims = "B80.0000"
        lowered = " ".join(f"{k}{top - e:.4f}" for k, e in zip("XYZ", s.endstops, strict=True))
        return (
            f"echo:; Delta settings: L<diagonal_rod> R<radius>\necho:  M665 L{s.rods[0]:.4f} "
            f"R{s.radius:.4f} H{top + m851:.4f} S200.00 X{x:.4f} Y{y:.4f} Z{z:.4f} "
            f"{trims}\necho:; Endstop adjustment:\necho:  M666 {lowered}\n"
            f"echo:  M851 X0.00 Y0.00 Z{m851:.2f}\n"
        )
    stops = " ".join(f"{k}{e - height:.4f}" for k, e in zip("XYZ", s.endstops, strict=True))
    return (
        f"; config.g\nM665 L{rods} R{s.radius:.4f} H{height:.4f} B90 X{x:.4f} Y{y:.4f} Z{z:.4f}\n"
        f"M666 {stops}\nG31 P500 X0 Y0 Z{-m851:.3f} ; probe\n"
    )


@dataclass
class Printer:
    """A machine with errors over a bed."""

    robot: object
    errors: dict
    tilt: tuple = (0.0, 0.0)
    """Slope of the bed along x and y."""
    trigger: float = 0.0
    """Height of the nozzle above the bed where the probe triggers, [mm]."""

    def __post_init__(self):
        self.closure = LoopClosure(self.robot, fixed=self.errors)

    def nozzle(self, travel):
        """Real position of the nozzle, shape (K, 3), [mm]."""
        return self.closure.forward((HOMED_MM - np.asarray(travel)) * 1e-3) * 1e3

    def above_bed(self, travel):
        """Height of the nozzle above the bed, shape (K,), [mm]."""
        p = self.nozzle(travel)
        normal = np.array([-self.tilt[0], -self.tilt[1], 1.0])
        return p @ normal / np.linalg.norm(normal)

    def probe(self, firmware, xy, *, noise=0.0, rng=None):
        """What a firmware reads as height where the probe triggers, shape (K,), [mm]."""
        z = np.full(len(xy), self.trigger)
        for _ in range(8):  # the height above the bed follows the commanded one nearly 1:1
            off = self.above_bed(firmware.travel(np.column_stack([xy, z]))) - self.trigger
            z -= off
            if np.abs(off).max() < 1e-6:  # [mm]; the next one is a hundredth of it
                break
        return z if rng is None else z + noise * rng.normal(size=len(z))


def printed_ends(scale=1.0):
    """Both ends of the distances on Klipper's calibration object, shape (12, 2, 3), [mm].

    From the pillar in the middle to the outer ones, then around; ridges 4.5 mm beside the pillars.
    """
    ends = []
    directions = np.radians([210.0, 270.0, 330.0, 30.0, 90.0, 150.0])
    for a in directions:
        ends.append([[r * math.cos(a), r * math.sin(a), 0.0] for r in (69.5, 4.5)])
    for a, b in zip(directions, np.concatenate([directions[2:], directions[:2]]), strict=True):
        pillar = 65.0 * math.cos(a), 65.0 * math.sin(a)
        ends.append(
            [[pillar[0] + r * math.cos(b), pillar[1] + r * math.sin(b), 0.0] for r in (69.5, 4.5)]
        )
    return scale * np.array(ends)


def distances(locate, settings, scale=1.0):
    """Distances on the print, shape (12,), [mm]; `locate` maps travel to positions."""
    p, q = (locate(settings.travel(printed_ends(scale)[:, k])) for k in (0, 1))
    return np.sqrt(((p - q) ** 2).sum(axis=1))


WIDTHS = np.array([8.89, 8.89, 8.98, 8.90, 8.98, 8.99, 8.98, 8.89, 9.04])
"""Widths of the pillars in #5567, those in the middle first, [mm]."""

CENTRE_WIDTHS = (0, 2, 1, 0, 2, 1)


def write_analysis(lengths, widths=WIDTHS):
    """`DELTA_ANALYZE` with the distances between ridges, [mm]."""
    of = [*(widths[k] for k in CENTRE_WIDTHS), *widths[3:]]
    shown = [f"{v + w:.2f}" for v, w in zip(lengths, of, strict=True)]
    width = [f"{w:.2f}" for w in widths]
    parts = {"CENTER_DISTS": shown[:6], "CENTER_PILLAR_WIDTHS": width[:3]}
    parts |= {"OUTER_DISTS": shown[6:], "OUTER_PILLAR_WIDTHS": width[3:]}
    return "".join(f"DELTA_ANALYZE {k}={','.join(v)}\n" for k, v in parts.items())


def rings():
    """41 points on the bed, shape (41, 2), [mm]."""
    points = [(0.0, 0.0)]
    for radius, count in ((22, 6), (44, 10), (64, 12), (80, 12)):
        angles = 2.0 * np.pi * np.arange(count) / count + 0.1 * radius
        points += [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    return np.array(points)


def write_log(firmware, settings, xy, z, m851=0.0):
    """Log of a probing as the firmware prints it, with its settings."""
    head = write_settings(firmware, settings, m851)
    if firmware == "klipper":
        steps = settings.travel(np.column_stack([xy, z])) / (40.0 / 3200.0)
        saved = "".join(
            f"#*# height{i} = {-m851}\n#*# height{i}_pos = {a:.3f},{b:.3f},{c:.3f}\n"
            for i, (a, b, c) in enumerate(steps)
        )
        return (
            f"{head}\n[probe]\nz_offset: {-m851}\n\n#*# <---- SAVE_CONFIG ---->\n#*#\n"
            f"#*# [delta_calibrate]\n{saved}"
        )
    if firmware in ("marlin", "marlin1"):
        lines = [
            f"Bed X: {x:.4f} Y: {y:.4f} Z: {h:.4f}" for (x, y), h in zip(xy, z + m851, strict=True)
        ]
        return head + "\n".join(["G29 V4", "G29 Auto Bed Leveling", *lines, "ok"]) + "\n"
    points = [f"G30 P{i} X{x:.4f} Y{y:.4f} Z-99999" for i, (x, y) in enumerate(xy)]
    heights = " ".join(f"{h:.4f}" for h in z + m851)
    report = f"G32 bed probe heights: {heights}, mean 0.1, deviation from mean 0.1\n"
    return head + "\n".join(points) + f" S-1\n{report}"
