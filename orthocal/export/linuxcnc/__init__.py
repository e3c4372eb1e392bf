"""What LinuxCNC takes: offsets as HOME_OFFSET, all other errors as a kinematics module."""
