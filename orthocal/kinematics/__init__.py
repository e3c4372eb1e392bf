"""Kinematics of a machine with errors: functions compiled once per robot, and loop closure."""
