"""What the machine is: description, model, error parameters, symbolic kinematics, assembly."""
