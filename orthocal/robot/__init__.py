"""The machine: description, Pinocchio model, error parameters, reference posture."""
