"""How a machine with errors moves: functions compiled once a robot, and its loops closed."""
