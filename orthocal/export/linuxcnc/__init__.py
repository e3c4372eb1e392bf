"""Files for LinuxCNC: offsets as HOME_OFFSET, other errors as a kinematics module."""
